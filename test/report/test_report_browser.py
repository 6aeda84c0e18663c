# SPDX-License-Identifier: Apache-2.0
"""The report in a real browser: telephone, desk and paper, light and dark."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import CHROMIUM, Browser

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on this machine")

TELEPHONE, TABLET, DESK = 375, 768, 1280
"""Widths of windows, CSS pixels."""

SMALLEST_TEXT = 7.5
"""Height of the smallest letters in a chart, CSS pixels."""

PAPER_WIDTH, PAPER_HEIGHT = 688, 1016
"""Printed part of an A4 page with margins of 14 mm, CSS pixels."""

COMPLAINTS = {"Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"}

OVERFLOWING = """
[...document.querySelectorAll('body *')]
    .filter(e => !e.closest('.scroll') && e.getBoundingClientRect().width > 0
        && e.getBoundingClientRect().right > innerWidth + 1 && !e.closest('svg'))
    .map(e => e.tagName + '.' + e.className)
"""

TEXT_SIZES = """
[...document.querySelectorAll('svg text')].filter(e => e.getClientRects().length)
    .map(e => parseFloat(getComputedStyle(e).fontSize)
        * Math.hypot(e.getScreenCTM().a, e.getScreenCTM().b))
"""

CHART_SIZES = """
[...document.querySelectorAll('figure')].map(e => e.getBoundingClientRect())
    .map(r => [r.width, r.height])
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module")
def report(replayed: Path) -> Path:
    return replayed / "report.html"


def shown_formats(browser: Browser) -> set[str]:
    """Classes of the charts that are to be seen."""
    seen = "[...document.querySelectorAll('svg')].filter(e => e.getClientRects().length)"
    return set(browser.value(f"{seen}.map(e => e.getAttribute('class'))"))


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [TELEPHONE, TABLET, DESK])
def test_it_fits_the_window_and_asks_for_nothing(
    browser: Browser, report: Path, width: int, scheme: str
) -> None:
    browser.open(report, width, scheme=scheme)
    assert browser.value("document.documentElement.scrollWidth") == width
    assert browser.value(OVERFLOWING) == []
    assert shown_formats(browser) == {"narrow" if width == TELEPHONE else "wide"}
    assert min(browser.value(TEXT_SIZES)) >= SMALLEST_TEXT
    assert [event for event in browser.events if event["method"] in COMPLAINTS] == []
    requests = [e for e in browser.events if e["method"] == "Network.requestWillBeSent"]
    urls = [request["params"]["request"]["url"] for request in requests]
    assert urls[0] == report.as_uri()
    assert all(url.startswith("data:image/png;base64,") for url in urls[1:])


def test_the_night_is_dark(browser: Browser, report: Path) -> None:
    def brightness(scheme: str) -> int:
        browser.open(report, DESK, scheme=scheme)
        paper = browser.value("getComputedStyle(document.body).backgroundColor")
        return sum(map(int, re.findall(r"\d+", paper)[:3]))

    assert brightness("dark") < 150 < 600 < brightness("light")


def test_headings_can_be_reached_from_the_contents(browser: Browser, report: Path) -> None:
    browser.open(report, DESK)
    count = browser.value("document.querySelectorAll('nav a').length")
    assert count == browser.value("document.querySelectorAll('section > h2').length")
    for k in range(count):
        browser.value(f"document.querySelectorAll('nav a')[{k}].click()")
        target = browser.value("document.querySelector(':target').tagName")
        assert target == "SECTION"


def test_no_chart_is_cut_in_print_and_nothing_is_left_out(browser: Browser, report: Path) -> None:
    browser.open(report, PAPER_WIDTH)
    browser.call("Emulation.setEmulatedMedia", media="print", features=[])
    assert shown_formats(browser) == {"wide"}
    sizes = browser.value(CHART_SIZES)
    # Whole charts go to the next page, if they fit on one.
    assert all(width <= PAPER_WIDTH and height < PAPER_HEIGHT for width, height in sizes)
    kept = "getComputedStyle(document.querySelector('figure')).breakInside"
    assert browser.value(kept) == "avoid"
    folded = "document.querySelector('details table').getBoundingClientRect().height"
    assert browser.value(folded) > 500.0
    assert browser.value("getComputedStyle(document.querySelector('nav')).display") == "none"


def test_the_printed_pages_are_a4_and_a_handful(browser: Browser, report: Path) -> None:
    browser.open(report, DESK)
    printed = browser.pdf()
    assert printed.startswith(b"%PDF-")
    assert 5 <= len(re.findall(rb"/Type\s*/Page\b", printed)) <= 14
    boxes = set(re.findall(rb"/MediaBox \[([^\]]+)\]", printed))
    assert boxes
    for box in boxes:
        _, _, width, height = map(float, box.split())
        assert (width, height) == pytest.approx((595.0, 842.0), abs=1.5)
