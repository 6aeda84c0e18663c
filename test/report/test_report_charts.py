# SPDX-License-Identifier: Apache-2.0
"""The data of the report's charts."""

import base64
import gzip
import json
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bokeh.models import CrosshairTool, HoverTool, VArea
from excerpts import SECOND_NS, START_NS, excerpt, parameters

from uav_ident_ros.files.truth_file import read_truth
from uav_ident_ros.identification.identifier import State
from uav_ident_ros.identification.structure import INPUTS, STRUCTURES
from uav_ident_ros.offline.run import run_over
from uav_ident_ros.report.charts import (
    GRAVEST,
    coefficient_charts,
    rate_charts,
    signal_charts,
    state_chart,
)
from uav_ident_ros.report.diagrams import SAMPLE_RATE, autocorrelation, spectrum_charts, welch
from uav_ident_ros.report.flight import ReplayedFlight, predict
from uav_ident_ros.report.page import _embed
from uav_ident_ros.report.style import COLORS, HUES
from uav_ident_ros.report.timeline import Chart, Timeline, columns, thin


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> ReplayedFlight:
    bag = excerpt(tmp_path_factory.mktemp("flight") / "bag", 40.0)
    return ReplayedFlight(run_over(bag, parameters()))


# --- lines -----------------------------------------------------------------------------------


def test_a_thinned_line_keeps_every_peak() -> None:
    rng = np.random.default_rng(1)
    t = np.sort(rng.uniform(0.0, 100.0, 20_000))
    y = rng.normal(size=len(t))
    y[rng.integers(0, len(t), 5)] = 50.0
    thinned = thin(t, {"y": y, "z": -2.0 * y}, 300)
    thin_t, thin_y = thinned["t"], thinned["y"]
    assert 500 < len(thin_t) <= 600
    assert (np.diff(thin_t) >= 0.0).all()
    assert (thin_y.min(), thin_y.max()) == (y.min(), y.max())
    assert (thinned["z"].min(), thinned["z"].max()) == (-2.0 * y.max(), -2.0 * y.min())
    # Within every bin the extremes of the coarse line enclose the fine line.
    for low, high in pairwise(np.linspace(0.0, 100.0, 31)):
        fine, coarse = y[(t >= low) & (t < high)], thin_y[(thin_t >= low - 1) & (thin_t < high + 1)]
        assert coarse.min() <= fine.min()
        assert coarse.max() >= fine.max()


def test_a_gap_breaks_the_line() -> None:
    t = np.concatenate([np.arange(0.0, 5.0, 0.01), np.arange(8.0, 20.0, 0.01)])
    thinned = thin(t, {"y": np.ones_like(t)}, 50)
    (gap,) = np.flatnonzero(np.isnan(thinned["y"]))
    assert thinned["t"][gap - 1] == pytest.approx(4.99)
    assert thinned["t"][gap + 1] == pytest.approx(8.0)


# --- predictions -----------------------------------------------------------------------------


def test_the_residual_of_the_predictions_is_small(flight: ReplayedFlight) -> None:
    for horizon in (1.0, 0.05):
        ahead = predict(flight, horizon)
        settled = ahead.t > 20.0
        # gyro noise of the bag: 0.02 rad/s at both ends
        assert (ahead.residual[settled].std(axis=0) < 0.05).all()


# --- inputs ----------------------------------------------------------------------------------


def test_the_power_of_a_multisine_lies_in_its_band(flight: ReplayedFlight) -> None:
    inputs, _ = spectrum_charts(flight)
    data = inputs.model.renderers[0].data_source.data
    frequency = data["x"]
    inside = frequency <= 2.1 * 2.0 ** (1.0 / 3.0)  # a density is a mean over a third of an octave
    for name in INPUTS:
        assert data[name][~inside].max() < 1e-2 * data[name][inside].max()


def test_the_power_density_equals_that_of_scipy() -> None:
    values = np.random.default_rng(3).standard_normal(5000).cumsum()
    from scipy import signal  # takes half of the tests' import time

    _, expected = signal.welch(
        values, SAMPLE_RATE, window=np.hanning(1000), noverlap=500, detrend="linear"
    )
    np.testing.assert_allclose(welch(values, 1000), expected, rtol=1e-6)


def test_autocorrelation_is_zero_if_white_and_decays_if_coloured() -> None:
    rng = np.random.default_rng(4)
    white = rng.standard_normal((20_000, 2))
    coloured = white.copy()
    for k in range(1, len(coloured)):  # an autoregression of order 1
        coloured[k] += 0.8 * coloured[k - 1]
    assert np.abs(autocorrelation(white, 10)).max() < 5.0 / np.sqrt(len(white))
    expected = 0.8 ** np.arange(1, 11)
    np.testing.assert_allclose(autocorrelation(coloured, 10)[:, 0], expected, atol=0.05)


# --- truth -------------------------------------------------------------------------------------


def test_a_derivative_at_fixed_flow_angles_is_true_with_these_angles_alone(tmp_path: Path) -> None:
    (tmp_path / "truth.yaml").write_text("local_derivatives: {pdot/beta: -15.0}")
    assert read_truth(tmp_path, STRUCTURES["augmented"]) == {}
    with_angles = replace(STRUCTURES["augmented"], regressors=("p", "beta", "alpha"))
    assert read_truth(tmp_path, with_angles) == {"pdot/beta": -15.0}


@pytest.mark.parametrize(
    "content", ["", "- a", "coefficients: 3", "a: [", "coefficients: {pdot/p: [1]}"]
)
def test_a_foreign_truth_file_gives_no_true_values(tmp_path: Path, content: str) -> None:
    assert read_truth(tmp_path, STRUCTURES["baseline"]) == {}
    (tmp_path / "truth.yaml").write_text(content)
    assert read_truth(tmp_path, STRUCTURES["baseline"]) == {}


# --- pictures --------------------------------------------------------------------------------


def test_all_charts_over_time_share_axis_and_crosshair(flight: ReplayedFlight) -> None:
    line = Timeline(flight.span, [3.0])
    charts = [
        *rate_charts(flight, line, predict(flight, 0.05)),
        *signal_charts(flight, line),
        *coefficient_charts(flight, line, {"pdot/p": -4.0}),
        state_chart(flight, line, ["too little excitation"]),
    ]
    assert len({id(chart.model.x_range) for chart in charts}) == 1
    overlays = {id(tool.overlay) for c in charts for tool in c.model.select(CrosshairTool)}
    assert len(overlays) == 1
    shown = [c.heading for c in charts if c.identity.startswith("coefficient")]
    assert shown == list(flight.structure.names)
    for chart in charts:
        names = {tool.tooltips[-1][0] for tool in chart.model.select(HoverTool)}
        assert names, chart.identity


def test_a_second_time_base_continues_the_time_axis(tmp_path: Path) -> None:
    def later(topic: str, log_ns: int, message: Any) -> None:
        """Shift every stamp by a day from six seconds on."""
        message.header.stamp.sec += 86_400 * (log_ns > START_NS + 6 * SECOND_NS)

    bag = excerpt(tmp_path / "bag", 12.0, change=later)
    two = ReplayedFlight(run_over(bag, parameters()))
    assert two.restarts == pytest.approx([7.0], abs=0.1)  # after a pause of a second
    chart = state_chart(two, Timeline(two.span, two.restarts), [])
    low, high = chart.model.x_range.bounds
    assert low == 0.0 and 11.0 <= high <= 14.0


def test_a_band_is_one_sigma_to_either_side(flight: ReplayedFlight) -> None:
    chart, *_ = coefficient_charts(flight, Timeline(flight.span, []), {})
    (drawn,) = [r for r in chart.model.renderers if isinstance(r.glyph, VArea)]
    data = drawn.data_source.data
    index = flight.structure.index("pdot/pq")
    kept = np.searchsorted(flight.tick_t, data["t"].astype(float) - 1e-3)
    sigma = flight.estimates.history(index)[1][kept]
    np.testing.assert_allclose(data["high"] - data["value"], sigma, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(data["value"] - data["low"], sigma, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (-10.0219, 0.0254, "-10.022 ± 0.025"),
        (59.94, 0.13, "59.94 ± 0.13"),
        (31.2, 12.0, "31 ± 12"),
        (0.5, 0.0, "0.5"),
        (0.5, float("inf"), "0.5"),
    ],
)
def test_a_value_has_the_figures_of_its_sigma(value: float, sigma: float, text: str) -> None:
    # imports matplotlib, unnecessary in most workers
    from uav_ident_ros.report.picture import with_sigma

    assert with_sigma(value, sigma) == text


def test_measured_predicted_and_regressors_differ_in_colour() -> None:
    colours = [COLORS["measured"], COLORS["ahead"], *HUES.values()]
    assert len(set(colours)) == len(colours)


def test_every_state_has_a_colour_and_a_rank() -> None:
    words = {state.value for state in State}
    assert words == set(GRAVEST)
    assert words <= COLORS.keys()


def test_scripts_of_equal_charts_are_equal_and_keep_their_numbers() -> None:
    numbers = np.frombuffer(bytes(range(256)) * 40, dtype=np.float32)

    def drawn() -> tuple[str, dict[str, str]]:
        line = Timeline((0.0, 1.0), [])
        chart = line.figure("<!--<script>", 100)  # nothing would end it in a page
        line.line(chart, columns({"t": numbers, "y": numbers}), "y", "tick")
        return _embed([Chart("one", "One", chart)])

    (script, divs), (again, other) = drawn(), drawn()
    assert divs == other
    assert script == again
    assert "<" not in script
    assert "<!--<script>" in str(json.loads(script))
    packed = re.findall(r'"data":"(H4sI[^"]+)"', script)
    assert numbers.tobytes() in {gzip.decompress(base64.b64decode(part)) for part in packed}
