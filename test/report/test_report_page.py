# SPDX-License-Identifier: Apache-2.0
"""`report.html`: complete, self-contained, and with the numbers of the replay."""

import hashlib
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from excerpts import BAGS, excerpt, replay
from excerpts import summary as summary_of
from html_page import one, parse, rows_of, table, words

import uav_ident_ros
from uav_ident_ros.commandline import NOT_USABLE
from uav_ident_ros.files.meanings import MEANINGS
from uav_ident_ros.identification.delay import DelayEstimate
from uav_ident_ros.identification.settings import declarations
from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.offline.tables import coefficients_table
from uav_ident_ros.report.page import _delay_section

LARGEST_FILE = 3_000_000
"""Limit in bytes, for e-mails."""

SECTIONS = [
    "fit", "learning", "rates", "coefficients", "modes", "inputs", "delay", "messages", "settings",
    "origin",
]  # fmt: skip
CHARTS = [
    "states", "rates-p", "residual-p", "rates-q", "residual-q", "rates-r", "residual-r",
    "whiteness", "mode-plane", "input-de", "input-dr", "input-da", "input-dth", "force-ay",
    "force-az",
    "state-alpha", "state-beta", "state-roll", "state-pitch", "spectra-inputs", "spectra-rates",
    "coverage-da-dr", "coverage-de-dth", "coverage-p-r", "coverage-q-p", "delay-curve",
]  # fmt: skip
"""All charts but those of the coefficients."""


def charts(page: ET.Element) -> list[str]:
    names = [figure.attrib["id"] for figure in page.iter("figure")]
    return [name for name in names if not name.startswith("coefficient-")]


@pytest.fixture(scope="module")
def page(replayed_example: Path) -> ET.Element:
    return parse((replayed_example / "report.html").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def summary(replayed_example: Path) -> dict[str, Any]:
    return summary_of(replayed_example)


def exact(cell: ET.Element) -> float | None:
    """Return the exact number of a cell; None if there is none."""
    found = list(cell.iter("data"))
    return float(found[0].attrib["value"]) if found else None


# --- content ---------------------------------------------------------------------------------


def test_every_section_and_chart_exists_and_is_linked(page: ET.Element) -> None:
    assert [section.attrib["id"] for section in page.iter("section")] == SECTIONS
    assert charts(page) == CHARTS
    coefficients = [n.attrib["id"] for n in one(page, "section[@id='coefficients']").iter("figure")]
    assert len(coefficients) == len(rows_of(page, "Coefficients, SI"))
    assert [a.attrib["href"] for a in one(page, "nav").iter("a")] == [f"#{s}" for s in SECTIONS]
    assert words(one(page, "h1")) == "c172p"
    drawn = "".join(words(script) for script in page.iter("script"))
    (end,) = {float(found) for found in re.findall(r'"bounds":\[0\.0,([\d.]+)\]', drawn)}
    assert end == pytest.approx(75.0, abs=0.1)


def test_charts_and_tables_are_labelled_for_screen_readers(page: ET.Element) -> None:
    assert (page.tag, page.attrib["lang"]) == ("html", "en")
    assert one(page, "meta[@name='viewport']").attrib["content"].startswith("width=device-width")
    for figure in page.iter("figure"):
        assert words(one(figure, "h3"))
        chart = one(figure, "div[@class='chart']")
        assert chart.attrib["role"] == "img"
        assert len(chart.attrib["aria-label"]) > 15
    for found in page.iter("table"):
        assert words(one(found, "caption"))
        for heading in found.iter("th"):
            assert heading.attrib["scope"] in ("row", "col")


# --- numbers ---------------------------------------------------------------------------------


def test_coefficients_are_those_of_the_summary(page: ET.Element, summary: dict[str, Any]) -> None:
    rows = rows_of(page, "Coefficients, SI")
    assert list(rows) == list(summary["coefficients"])
    for name, (value, _true, sigma, ratio, meaning) in rows.items():
        entry = summary["coefficients"][name]
        assert exact(value) == entry["value"]
        assert exact(sigma) == entry["sigma"]
        assert exact(ratio) == pytest.approx(abs(entry["value"]) / entry["sigma"])
        assert float(words(value).replace("−", "-")) == pytest.approx(entry["value"], rel=1e-3)
        assert words(meaning) == MEANINGS[name]


def test_fixed_and_unknown_coefficients_have_no_t_ratio() -> None:
    entries = {
        "pdot/p": {"value": -6.0, "sigma": 0.0},
        "pdot/da": {"value": 30.0, "sigma": None},
        "pdot/r": {"value": 0.5, "sigma": 0.25},
    }
    found = coefficients_table({"coefficients": entries})
    cells = [[str(cell) for cell in row.cells[:3]] for row in found.rows]
    assert cells == [["-6", "fixed", "-"], ["30", "-", "-"], ["0.5", "0.25", "2.0"]]
    assert [row.weak for row in found.rows] == [False, False, True]
    known = coefficients_table({"coefficients": entries}, {"pdot/p": -6.5})
    assert list(known.head[:3]) == ["coefficient", "value", "true"]
    assert [str(row.cells[1]) for row in known.rows] == ["-6.5", "-", "-"]


def test_shares_of_the_flight_add_up_to_100_percent(page: ET.Element) -> None:
    shares = {k: exact(cell) for k, (cell,) in rows_of(page, "Where the flight went").items()}
    assert list(shares)[-1] == "learned"
    assert shares["learned"] > 90.0
    assert sum(shares.values()) == pytest.approx(100.0)


def test_correlations_of_coefficients_and_inputs_are_shown(page: ET.Element) -> None:
    rows = rows_of(page, "Correlation of the coefficients of q")
    # pitch damping and elevator effect come from one flight, so their errors correlate
    assert 0.3 < abs(exact(rows["de"][3])) <= 1.0
    inputs = rows_of(page, "Correlation with the inputs")
    assert [exact(inputs[name][k]) for k, name in enumerate(INPUTS[:3])] == pytest.approx([1.0] * 3)


@pytest.mark.parametrize(
    "caption, windows", [("Last 40 %", "last_40_percent"), ("After 30 s", "after_30_s")]
)
def test_fits_are_those_of_the_summary(
    page: ET.Element, summary: dict[str, Any], caption: str, windows: str
) -> None:
    fit = summary["prediction_fit"][windows]
    assert f"{fit['windows']} windows of 1 s" in words(one(table(page, caption), "caption"))
    rows = {name: [*map(exact, cells)] for name, cells in rows_of(page, caption).items()}
    for ahead, free in fit["free"].items():
        assert rows[f"free prediction, {ahead}"] == list(free["model"].values())
        assert rows[f"holding the rates for {ahead}"] == list(free["hold"].values())
    assert len(fit["free"]) == 3
    measured = list(fit["model_with_measured_forces"].values())
    assert rows["with measured forces, 1 s"] == measured


def test_cards_show_the_fit_beside_held_rates(page: ET.Element, summary: dict[str, Any]) -> None:
    fit = summary["prediction_fit"]["last_40_percent"]
    cards = list(one(page, "ul[@class='cards']").iter("li"))
    for axis, card in zip("pqr", cards, strict=True):
        assert fit["model"][axis] in [exact(part) for part in card.iter("span")]
        assert exact(one(card, "span[@class='beside']")) == fit["hold"][axis]


def test_verdict_and_advice_are_those_of_the_summary(
    page: ET.Element, summary: dict[str, Any]
) -> None:
    verdict = one(page, f"div[@class='{'verdict usable' if summary['usable'] else 'verdict'}']")
    assert words(one(verdict, "strong")) == "Usable."
    assert summary["state"] in words(verdict)
    printed = [words(item) for item in verdict.iter("li")]
    printed[:0] = [
        words(first).removeprefix("First: ") for first in verdict.iterfind(".//p[@class='first']")
    ]
    expected = [entry["text"] for entry in summary["advice"]] + summary["notes"]
    assert [text.lower() for text in printed] == [f"{text.lower()}." for text in expected]


def test_messages_and_settings_are_those_of_the_summary(
    page: ET.Element, summary: dict[str, Any]
) -> None:
    for stream, (topic, msgtype, received, _dropped) in rows_of(page, "Messages").items():
        entry = summary["inputs"][stream]
        assert [words(topic), words(msgtype)] == [entry["topic"], entry["type"]]
        assert exact(received) == entry["received"]
    changed, kept = rows_of(page, "Settings that differ"), rows_of(page, "Settings at")
    given = yaml.safe_load((BAGS / "c172p" / "identifier.yaml").read_text())
    assert changed.keys() <= given["/**"]["ros__parameters"].keys()
    assert sorted([*changed, *kept]) == sorted(s.name for s in declarations())


def test_the_origin_section_has_the_hash_of_the_bag_and_the_versions(page: ET.Element) -> None:
    content = (BAGS / "c172p" / "c172p.mcap").read_bytes()
    files = {name: [*map(words, cells)] for name, cells in rows_of(page, "Bag").items()}
    digest = hashlib.sha256(content).hexdigest()
    assert files == {"c172p.mcap": [str(len(content)), digest]}
    versions = {name: words(cell) for name, (cell,) in rows_of(page, "Software").items()}
    assert versions["uav_ident_ros"] == uav_ident_ros.__version__
    assert versions["numpy"] == np.__version__


# --- self-contained --------------------------------------------------------------------------


def test_the_page_loads_no_resource_and_the_file_is_small(
    page: ET.Element, replayed_example: Path
) -> None:
    assert (replayed_example / "report.html").stat().st_size < LARGEST_FILE
    tags = {node.tag for node in page.iter()}
    assert not tags & {"link", "iframe", "object", "embed", "base", "form", "img"}
    assert "@import" not in words(one(page, "style"))
    assert "url(" not in words(one(page, "style"))
    for node in page.iter():
        for name, value in node.attrib.items():
            assert not name.startswith("on")
            if name in ("src", "href", "srcset", "action", "data"):
                assert value.startswith("#"), value


# --- another flight --------------------------------------------------------------------------


def test_a_very_short_flight_with_an_odd_name_has_a_report(tmp_path: Path) -> None:
    name = "a <b> & \"c\" 'd'"
    bag, output = excerpt(tmp_path / name, 1.5), tmp_path / "out"
    assert replay(bag, output, "--report") == NOT_USABLE
    page = parse((output / "report.html").read_text(encoding="utf-8"))
    assert words(one(page, "h1")) == name
    assert [words(b) for b in page.iter("b")] == ["First:"]
    verdict = one(page, "div[@class='verdict']")
    assert words(one(verdict, "strong")).startswith("Not usable: ")
    assert words(one(verdict, "p[@class='first']")).startswith("First: The aircraft hardly flew")
    assert [a["name"] for a in summary_of(output)["advice"]] == ["never_flew", "short_flight"]
    assert not summary_of(output)["modes"], "nothing was learned"
    assert words(one(verdict, "ol")).strip().startswith("The flight is short, 2 s")
    fits, *_ = rows_of(page, "After 30 s").values()
    assert [*map(exact, fits)] == [None] * 3
    shown = charts(page)
    assert "rates-p" in shown
    assert not {"spectra-rates", "whiteness", "delay-curve"} & set(shown)
    assert words(one(one(page, "section[@id='delay']"), "p")).startswith("Too little")


def test_a_servo_lag_is_reported_without_errors_of_the_delay_bank() -> None:
    found = DelayEstimate(0.02, 0.005, 0.07, 0.005, 9.0, lag=0.05, lag_sigma=0.008)
    for errors in (np.zeros((0, 3)), np.zeros((5, 3)), np.ones((5, 3))):  # none, zero, all equal
        bank: Any = SimpleNamespace(estimate=found, delays=np.arange(len(errors)), errors=errors)
        section = _delay_section(bank, 0.02)
        assert "a lag of 50 ms, sigma 8 ms, after a delay of 20 ms" in section.texts[0]
        assert not section.charts
