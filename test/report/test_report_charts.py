# SPDX-License-Identifier: Apache-2.0
"""What the charts of the report are made from."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.estimators.excitation import WINDOW_TIME
from uav_ident_ros.identification.identifier import State
from uav_ident_ros.identification.structure import INPUTS, ROWS, STRUCTURES
from uav_ident_ros.offline.run import OfflineRun, choose_inputs
from uav_ident_ros.pictures import PictureError
from uav_ident_ros.report.activity import activity
from uav_ident_ros.report.coefficients_chart import order
from uav_ident_ros.report.coverage import SIGNALS, correlations
from uav_ident_ros.report.drawing import COLORS, FORMATS, color, draw_svg
from uav_ident_ros.report.envelope import envelope
from uav_ident_ros.report.flight import Clock, Flight, collect
from uav_ident_ros.report.predictions import Predictions, predict
from uav_ident_ros.report.rates_chart import DETAIL_TIME, detail_span
from uav_ident_ros.report.spectra import spectra
from uav_ident_ros.report.strip import GRAVEST
from uav_ident_ros.report.style import style_sheet

BAGS = Path(__file__).parents[2] / "bags"
Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def run() -> OfflineRun:
    values = load_parameters(BAGS / "multisine" / "identifier.yaml", "identifier")
    with Bag(BAGS / "multisine") as bag:
        run = OfflineRun(choose_inputs(bag, values))
        run.run(bag, lambda messages, total: messages)
    return run


@pytest.fixture(scope="module")
def flight(run: OfflineRun) -> Flight:
    return collect("multisine", run)


# --- lines -----------------------------------------------------------------------------------


def test_a_thinned_line_keeps_every_peak() -> None:
    rng = np.random.default_rng(1)
    t = np.sort(rng.uniform(0.0, 100.0, 20_000))
    y = rng.normal(size=len(t))
    y[rng.integers(0, len(t), 5)] = 50.0
    thin_t, thin_y = envelope(t, y, 300)
    assert len(thin_t) <= 600
    assert (np.diff(thin_t) >= 0.0).all()
    assert (thin_y.min(), thin_y.max()) == (y.min(), y.max())
    # Within every bin of the coarse line the fine one does not leave it.
    for low, high in pairwise(np.linspace(0.0, 100.0, 31)):
        fine, coarse = y[(t >= low) & (t < high)], thin_y[(thin_t >= low - 1) & (thin_t < high + 1)]
        assert coarse.min() <= fine.min()
        assert coarse.max() >= fine.max()


def test_a_slope_stays_a_slope_and_a_short_line_stays_as_it_is() -> None:
    t = np.linspace(0.0, 10.0, 5001)
    for y in (t**2, -(t**2)):
        _, thin = envelope(t, y, 100)
        steps = np.diff(thin)
        assert (steps >= 0.0).all() or (steps <= 0.0).all()
    np.testing.assert_array_equal(envelope(t[:50], y[:50], 100)[1], y[:50])
    assert len(envelope(t[:0], t[:0], 100)[0]) == 0


def test_a_gap_breaks_the_line() -> None:
    t = np.concatenate([np.arange(0.0, 5.0, 0.01), np.arange(8.0, 20.0, 0.01)])
    thin_t, thin_y = envelope(t, np.ones_like(t), 50)
    (gap,) = np.flatnonzero(np.isnan(thin_y))
    assert thin_t[gap - 1] == pytest.approx(4.99)
    assert thin_t[gap + 1] == pytest.approx(8.0)


# --- time ------------------------------------------------------------------------------------


def test_time_bases_follow_one_another() -> None:
    clock = Clock({0: (5_000_000_000, 9_000_000_000), 1: (10**18, 10**18 + 2_000_000_000)})
    assert clock.restarts == [5.0]
    np.testing.assert_allclose(clock.seconds(0, np.array([5_000_000_000])), [0.0])
    np.testing.assert_allclose(clock.seconds(1, np.array([10**18 + 500_000_000])), [5.5])


def test_the_flight_is_all_there(flight: Flight, run: OfflineRun) -> None:
    t_ns, rates, force = run.measured()
    np.testing.assert_array_equal(flight.rates, rates)
    np.testing.assert_array_equal(flight.force, force)
    np.testing.assert_allclose(flight.t, (t_ns - t_ns[0]) * 1e-9)
    assert len(flight.tick_t) == len(run.estimates)
    expected = [(e.t_ns - t_ns[0]) * 1e-9 for e in run.estimates]
    np.testing.assert_allclose(flight.tick_t, expected)


def test_the_detail_is_the_liveliest_part_of_the_end(flight: Flight) -> None:
    begin, end = detail_span(flight)
    assert end - begin == pytest.approx(DETAIL_TIME)
    assert begin >= 0.6 * flight.span[1] - 1e-6
    assert end <= flight.span[1]


# --- predictions -----------------------------------------------------------------------------


def test_predictions_are_beside_what_was_measured(flight: Flight) -> None:
    for horizon in (1.0, 0.05):
        ahead = predict(flight, horizon)
        settled = ahead.t > 20.0
        np.testing.assert_allclose(ahead.residual, ahead.measured - ahead.predicted)
        # gyro noise of the bag: 0.02 rad/s at either end
        assert (ahead.residual[settled].std(axis=0) < 0.05).all()
        measured = np.interp(ahead.t, flight.t, flight.rates[:, 0])
        np.testing.assert_allclose(ahead.measured[:, 0], measured, atol=1e-9)
        before = np.interp(ahead.t - horizon, flight.t, flight.rates[:, 0])
        np.testing.assert_allclose(ahead.before[:, 0], before, atol=1e-9)
        model, hold = ahead.fit(flight.span[1])
        assert (model > hold + 10.0).all()


def test_fit_is_the_formula_over_the_last_part() -> None:
    rng = np.random.default_rng(2)
    t = np.linspace(1.0, 100.0, 2000)
    measured, error = rng.normal(size=(2000, 3)) + 5.0, rng.normal(size=(2000, 3))
    ahead = Predictions(1.0, t, measured - error, measured, measured - 2.0 * error)
    chosen = t - 1.0 >= 60.0
    centred = measured[chosen] - measured[chosen].mean(axis=0)
    share = np.linalg.norm(error[chosen], axis=0) / np.linalg.norm(centred, axis=0)
    model, hold = ahead.fit(100.0)
    np.testing.assert_allclose(model, 100.0 * (1.0 - share))
    np.testing.assert_allclose(hold, 100.0 * (1.0 - 2.0 * share))
    assert np.isnan(ahead.fit(1000.0)).all()


# --- inputs ----------------------------------------------------------------------------------


def test_activity_is_the_spread_about_each_time() -> None:
    rng = np.random.default_rng(3)
    t = np.sort(rng.uniform(0.0, 60.0, 3000))
    u = rng.normal(size=(3000, 4)) + 1e3
    at = np.array([1.0, 30.0, 59.5, 500.0])
    found = activity(t, u, at)
    for row, middle in zip(found[:3], at[:3], strict=True):
        near = np.abs(t - middle) <= 0.5 * WINDOW_TIME
        np.testing.assert_allclose(row, u[near].std(axis=0), rtol=1e-6)
    np.testing.assert_array_equal(found[3], 0.0)


def test_the_band_of_a_multisine_is_found(flight: Flight) -> None:
    found = spectra(flight)
    assert found is not None
    for density in found.inputs.T:
        low, high = found.band(density)
        assert 0.1 <= low <= 0.5
        assert 1.5 <= high <= 2.1
    assert np.isnan(found.band(np.zeros(len(found.frequency)))).all()


def test_power_is_the_variance(flight: Flight) -> None:
    found = spectra(flight)
    assert found is not None
    power = found.rates.sum(axis=0) * (found.frequency[1] - found.frequency[0])
    settled = flight.rates[flight.t > 5.0]
    np.testing.assert_allclose(power, settled.var(axis=0), rtol=0.1)


def test_correlations(flight: Flight) -> None:
    found = correlations(flight)
    assert found.shape == (len(INPUTS), len(SIGNALS))
    np.testing.assert_allclose(np.diag(found), 1.0)
    for k, u in enumerate(flight.u.T):
        for axis in range(3):
            expected = np.corrcoef(u, flight.rates[:, axis])[0, 1]
            assert found[k, 4 + axis] == pytest.approx(expected)
    # orthogonal multisines
    assert (np.abs(found[:, :4] - np.eye(4)) < 0.1).all()


# --- pictures --------------------------------------------------------------------------------


@pytest.mark.parametrize("structure", STRUCTURES)
def test_every_coefficient_has_a_panel(structure: str, flight: Flight) -> None:
    other = replace(flight, structure=STRUCTURES[structure])
    for row in range(len(ROWS)):
        columns = [j for i, j in other.structure.free if i == row]
        shown = order(other, row)
        assert sorted(shown) == columns
        assert other.structure.regressors[shown[0]] in "pqr"


def test_every_state_has_a_colour_and_a_rank() -> None:
    words = {state.value for state in State}
    assert words == set(GRAVEST)
    assert words <= COLORS.keys()


def luminance(shade: str) -> float:
    """Relative luminance, as the Web Content Accessibility Guidelines define it."""
    parts = [int(shade[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(a: str, b: str) -> float:
    high, low = sorted((luminance(a), luminance(b)), reverse=True)
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("paper", [0, 1], ids=["light", "dark"])
def test_text_and_lines_stand_out_from_the_paper(paper: int) -> None:
    shades = {name: pair[paper] for name, pair in COLORS.items()}
    for name in ("ink", "muted", "tick"):  # tick: links
        assert contrast(shades[name], shades["paper"]) >= 4.5, name
    assert contrast(shades["muted"], shades["shade"]) >= 4.5
    for name in ("ahead", "third", "fourth", "measured"):
        assert contrast(shades[name], shades["paper"]) >= 3.0, name


def test_each_colour_to_draw_with_has_one_name() -> None:
    assert len({light for light, _ in COLORS.values()}) == len(COLORS)


def test_a_drawing_has_no_colours_names_or_links_of_its_own() -> None:
    def draw(figure: object, form: object) -> None:
        panel = figure.add_subplot()  # type: ignore[attr-defined]
        panel.plot([0.0, 1.0], [0.0, 1.0], color=color("ahead"), marker="o")
        panel.set_title("<&>")

    names: list[str] = []
    for form in FORMATS:
        svg = draw_svg(draw, form, 2.0, f"chart-{form.name}")
        assert svg.tag == "svg"
        assert "width" not in svg.attrib
        width = float(svg.attrib["viewBox"].split()[2])
        assert width == pytest.approx(72.0 * form.width)
        styles = " ".join(element.attrib.get("style", "") for element in svg.iter())
        assert "var(--ahead)" in styles
        assert "font-family" not in styles
        names += [element.attrib["id"] for element in svg.iter() if "id" in element.attrib]
        assert "<&>" in [element.text for element in svg.iter("text")]
    assert names
    assert len(names) == len(set(names))


def test_without_matplotlib_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(PictureError, match="the report needs matplotlib"):
        draw_svg(lambda figure, form: None, FORMATS[0], 1.0, "chart")


@pytest.mark.parametrize("width", ["wide", "narrow"])
def test_formats_are_told_apart_by_the_style_sheet(width: str) -> None:
    assert width in {form.name for form in FORMATS}
    assert f"svg.{width}{{display:none}}" in style_sheet()
