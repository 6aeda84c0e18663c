# SPDX-License-Identifier: Apache-2.0
"""The score of record, held against SciPy's integration and the formula written out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from uav_ident_ros.identification.model import LARGEST_RATE
from uav_ident_ros.identification.prediction import (
    LARGEST_STEP_NS,
    SELECTIONS,
    InputSignal,
    WindowErrors,
    fit,
    predict_ahead,
    score,
    window_errors,
)
from uav_ident_ros.identification.structure import STRUCTURES, Structure

Array = NDArray[np.float64]
START_NS = 1_700_000_000_000_000_000
TIGHT = {"rtol": 1e-9, "atol": 1e-11, "method": "DOP853"}
BASELINE, AUGMENTED = STRUCTURES["baseline"], STRUCTURES["augmented"]
EVERYTHING = {"all": lambda t, first, last: np.ones(len(t), dtype=bool)}


def true_coefficients(structure: Structure) -> Array:
    a = np.zeros(structure.mask.shape)
    for name, value in {
        "pdot/pq": 0.05, "pdot/qr": -0.6, "pdot/p": -7.0, "pdot/r": 1.4, "pdot/dr": 3.0,
        "pdot/da": 30.0, "qdot/pr": 0.7, "qdot/pp": -0.02, "qdot/rr": 0.02, "qdot/q": -5.0,
        "qdot/de": -25.0, "qdot/dth": 0.3, "rdot/pq": -0.5, "rdot/qr": -0.05, "rdot/p": -0.3,
        "rdot/r": -0.9, "rdot/dr": -4.5, "rdot/da": -0.3,
    }.items():  # fmt: skip
        a[structure.index(name)] = value
    if structure is AUGMENTED:
        for name, value in {
            "pdot/1": 0.2, "qdot/1": -0.1, "rdot/1": 0.05, "pdot/ay": 0.4, "qdot/az": 0.3,
            "rdot/ay": -0.5, "pdot/dth": 0.2, "rdot/dth": -0.1,
        }.items():  # fmt: skip
            a[structure.index(name)] = value
    return a


@dataclass
class Record:
    """A flight as measured."""

    t_ns: NDArray[np.int64]
    rates: Array
    inputs: InputSignal
    force: Array
    ticks_ns: NDArray[np.int64]
    coefficients: Array
    structure: Structure
    lever_arm: Array | None = None

    def score(self) -> dict[str, Array]:
        return {k: v.model for k, v in score(*self.arguments(), **self.options()).items()}

    def arguments(self) -> tuple:
        return (
            self.t_ns, self.rates, self.inputs, self.force, self.ticks_ns, self.coefficients,
            self.structure,
        )  # fmt: skip

    def options(self) -> dict:
        return {"lever_arm": self.lever_arm}

    def everything(self):
        return score(*self.arguments(), **self.options(), selections=EVERYTHING)["all"]


def force_of(t: Array) -> Array:
    """Some smooth ay, az at the centre of gravity."""
    return np.stack([np.sin(2.1 * t) + 0.3, 9.8 + 1.5 * np.cos(1.7 * t)], axis=-1)


def fly(
    structure: Structure = BASELINE,
    duration: float = 8.0,
    rate: float = 100.0,
    delay: float = 0.0,
    time_constant: float = 0.0,
    interpolation: str = "linear",
    lever_arm: Array | None = None,
    jitter: float = 0.0,
    seed: int = 0,
) -> Record:
    """Integrate a plant with SciPy; servo lag and delay are written down independently."""
    rng = np.random.default_rng(seed)
    a = true_coefficients(structure)
    tu = np.arange(-0.2, duration + 0.2, 0.05)
    u = rng.uniform(-0.1, 0.1, (len(tu), 4))
    t = np.arange(0.0, duration, 1.0 / rate)
    t[1:-1] += rng.uniform(-jitter, jitter, len(t) - 2) / rate
    t_ns = START_NS + np.rint(t * 1e9).astype(np.int64)
    tu_ns = START_NS + np.rint(tu * 1e9).astype(np.int64)

    def commanded(at: float) -> Array:
        if interpolation == "hold":
            return u[np.searchsorted(tu, at - delay + 1e-12, side="right") - 1]
        return np.array([np.interp(at - delay, tu, column) for column in u.T])

    def derivative(at: float, state: Array) -> Array:
        x, servo = state[:3], state[3:]
        command = commanded(at)
        actual = servo if time_constant else command
        xdot = a @ structure.regressor(x, actual, force_of(np.array(at)))
        xdot = xdot if at >= 0.0 else np.zeros(3)  # before the start only the servos move
        lag = (command - servo) / time_constant if time_constant else np.zeros(4)
        return np.concatenate([xdot, lag])

    corners = np.unique(np.concatenate([t, tu + delay]))
    corners = corners[(corners >= tu[0] + delay) & (corners <= t[-1])]
    state = np.concatenate([[0.1, -0.05, 0.02], u[0]])
    states = [state]
    for begin, end in pairwise(corners):
        # piecewise, so that no corner of the input lies within a step
        inner = (begin + 1e-9, end - 1e-9) if interpolation == "hold" else (begin, end)
        state = solve_ivp(derivative, inner, state, **TIGHT).y[:, -1]
        states.append(state)
    at_samples = np.isin(corners, t)
    x = np.array(states)[at_samples, :3]
    force = force_of(t)
    if lever_arm is not None:
        servo = np.array(states)[at_samples, 3:]
        actual = servo if time_constant else np.array([commanded(v) for v in t])
        wdot = structure.regressor(x, actual, force) @ a.T
        swing = np.cross(wdot, lever_arm) + np.cross(x, np.cross(x, lever_arm))
        force = force + swing[:, 1:]
    first_tick = -(-int(t_ns[0]) // 50_000_000)
    ticks_ns = 50_000_000 * np.arange(first_tick, int(t_ns[-1]) // 50_000_000 + 1)
    signal = InputSignal(
        tu_ns[: int((duration + 0.2) / 0.05)], u[: int((duration + 0.2) / 0.05)],
        delay, time_constant, interpolation,
    )  # fmt: skip
    coefficients = np.broadcast_to(a, (len(ticks_ns), *a.shape))
    return Record(t_ns, x, signal, force, ticks_ns, coefficients, structure, lever_arm)


CASES = {
    "plain": {},
    "irregular stamps": {"jitter": 0.4},
    "slow gyro": {"rate": 37.0},
    "delay": {"delay": 0.033},
    "delay and lag": {"delay": 0.033, "time_constant": 0.06},
    "held inputs": {"interpolation": "hold", "delay": 0.021},
    "held and lagged inputs": {"interpolation": "hold", "time_constant": 0.05},
    "augmented": {"structure": AUGMENTED, "rate": 200.0},
}


@pytest.mark.parametrize("case", CASES)
def test_true_coefficients_predict_everything(case: str) -> None:
    record = fly(duration=4.0, **CASES[case])
    result = record.everything()
    assert result.windows >= 55
    # Where a straight line between samples has to stand for the initial rates or the specific
    # force, the measurement itself is not quite the truth.
    exact = record.structure is BASELINE and not case.startswith(("irregular", "slow"))
    assert (result.model > (99.995 if exact else 99.0)).all()
    assert (result.model <= 100.0).all()
    assert (result.hold < 60.0).all()


def test_lever_arm_is_accounted_for() -> None:
    arm = np.array([0.3, -0.05, 0.1])
    record = fly(AUGMENTED, duration=4.0, rate=200.0, lever_arm=arm)
    assert (record.everything().model > 99.8).all()
    assert (replace(record, lever_arm=None).everything().model < 95.0).any()


def inside(record: Record, tick: int) -> NDArray[np.bool_]:
    """Flags of the gyro samples in a window."""
    start = record.ticks_ns[tick]
    return (record.t_ns > start) & (record.t_ns <= start + 1_000_000_000)


def predicted(record: Record, tick: int, held_force: bool = False) -> tuple[Array, Array]:
    """Prediction and measurement at the gyro samples of a window, by SciPy.

    Integrated from corner to corner of the piecewise linear signals: a step across a corner has
    an error of its own, of 1e-5, which differs with the machine.
    """
    t = (record.t_ns - START_NS) * 1e-9
    t0 = (record.ticks_ns[tick] - START_NS) * 1e-9
    window = inside(record, tick)
    tu = (record.inputs.t_ns - START_NS) * 1e-9

    def force_at(at: float) -> Array:
        return np.array([np.interp(at, t, column) for column in record.force.T])

    def derivative(at: float, x: Array) -> Array:
        u = np.array([np.interp(at, tu, column) for column in record.inputs.u.T])
        f = record.structure.regressor(x, u, force_at(t0 if held_force else at))
        return record.coefficients[tick] @ f

    state = np.array([np.interp(t0, t, column) for column in record.rates.T])
    last = t[window][-1]
    corners = np.unique(np.concatenate([[t0, last], t, tu]))
    at_samples = []
    for begin, end in pairwise(corners[(corners >= t0) & (corners <= last)]):
        state = solve_ivp(derivative, (begin, end), state, rtol=1e-8, atol=1e-10).y[:, -1]
        if end in t:
            at_samples.append(state)
    return np.array(at_samples), record.rates[window]


def runge_kutta_error(record: Record, tick: int) -> float:
    """Error of the classical fourth-order method at its largest step, rad/s, as a bound.

    A step h of a mode s starts with an error of (s h)^5 / 120 of its amplitude, and the mode
    forgets within 1 / (s h) steps.
    """
    structure, a = record.structure, record.coefficients[tick]
    damping = a[:, [structure.regressors.index(rate) for rate in "pqr"]]
    modes = np.abs(np.linalg.eigvals(damping))
    return float((modes.max() * LARGEST_STEP_NS * 1e-9) ** 4 / 120.0 * np.abs(record.rates).max())


def percent(model: list[Array], measured: list[Array]) -> Array:
    """Fit by the formula as it is written in the contract."""
    m, x = np.concatenate(model), np.concatenate(measured)
    distance = np.linalg.norm(m - x, axis=0)
    return 100.0 * (1.0 - distance / np.linalg.norm(x - x.mean(axis=0), axis=0))


@pytest.mark.parametrize("horizon_ns", [1_000_000_000, 50_000_000])
def test_predictions_ahead_are_where_an_integration_ends(horizon_ns: int) -> None:
    record = fly(AUGMENTED, duration=3.0)
    factors = np.random.default_rng(3).uniform(0.5, 1.5, (len(record.ticks_ns), 1, 1))
    record = replace(record, coefficients=record.coefficients * factors)
    t_ns, ahead = predict_ahead(*record.arguments(), horizon_ns=horizon_ns)
    count = int((record.ticks_ns + horizon_ns <= record.t_ns[-1]).sum())
    np.testing.assert_array_equal(t_ns, record.ticks_ns[:count] + horizon_ns)
    for tick in (0, count // 2, count - 1):
        shorter = replace(record, t_ns=record.t_ns[record.t_ns <= t_ns[tick]])
        model, _ = predicted(
            replace(
                shorter,
                rates=record.rates[: len(shorter.t_ns)],
                force=record.force[: len(shorter.t_ns)],
            ),
            tick,
        )
        allowed = runge_kutta_error(record, tick)
        assert allowed < 1e-6
        np.testing.assert_allclose(ahead[tick], model[-1], rtol=0.0, atol=allowed)


def test_fit_equals_the_formula_with_wrong_and_changing_coefficients() -> None:
    record = fly(AUGMENTED, duration=3.0, jitter=0.3)
    rng = np.random.default_rng(3)
    noisy = record.rates + 0.02 * rng.normal(size=record.rates.shape)
    factors = rng.uniform(0.5, 1.5, (len(record.ticks_ns), 1, 1))
    record = replace(
        record,
        rates=noisy,
        ticks_ns=record.ticks_ns[::4],
        coefficients=(record.coefficients * factors)[::4],
    )
    result = record.everything()
    windows = range(result.windows)
    runs = [predicted(record, k) for k in windows]
    held = [predicted(record, k, held_force=True) for k in windows]
    measured = [m for _, m in runs]
    t = (record.t_ns - START_NS) * 1e-9
    at = (record.ticks_ns[: len(measured)] - START_NS) * 1e-9
    x0 = np.stack([np.interp(at, t, column) for column in record.rates.T], axis=1)
    hold = [np.tile(x, (len(m), 1)) for x, m in zip(x0, measured, strict=True)]
    assert result.samples == sum(map(len, measured))
    np.testing.assert_allclose(result.model, percent([p for p, _ in runs], measured), atol=2e-4)
    np.testing.assert_allclose(
        result.held_force, percent([p for p, _ in held], measured), atol=2e-4
    )
    np.testing.assert_allclose(result.hold, percent(hold, measured), atol=1e-8)
    assert not np.allclose(result.held_force, result.model, atol=1.0)


def test_windows_of_the_record_and_their_counts() -> None:
    t_ns = START_NS + 10_000_000 * np.arange(6001)  # 60 s at 100 Hz
    rates = np.random.default_rng(0).normal(size=(6001, 3))
    ticks = START_NS + 50_000_000 * np.arange(1, 1201)
    inputs = InputSignal(t_ns, np.zeros((6001, 4)))
    coefficients = np.zeros((1200, 3, BASELINE.size))
    result = score(t_ns, rates, inputs, None, ticks, coefficients, BASELINE)
    assert list(result) == list(SELECTIONS) == ["last_40_percent", "after_30_s"]
    # starts from 36 s, and from 30 s, to 59 s, both included
    assert result["last_40_percent"].windows == 23 * 20 + 1
    assert result["after_30_s"].windows == 29 * 20 + 1
    assert result["after_30_s"].samples == (29 * 20 + 1) * 100
    # a model without coefficients holds the initial rate
    np.testing.assert_allclose(result["after_30_s"].model, result["after_30_s"].hold)
    assert np.isnan(result["after_30_s"].held_force).all()


def test_divergent_prediction_is_clipped() -> None:
    record = fly(duration=3.0)
    runaway = np.zeros_like(record.coefficients)
    runaway[:, 1, 3] = 1e9  # qdot = 1e9 p^2
    result = replace(record, coefficients=runaway).everything()
    x = record.rates[1:]
    assert np.isfinite(result.model).all()
    measured = np.concatenate([record.rates[inside(record, k), 1] for k in range(result.windows)])
    expected = np.linalg.norm(LARGEST_RATE - measured) / np.linalg.norm(measured - measured.mean())
    assert result.model[1] == pytest.approx(100.0 * (1.0 - expected), rel=1e-2)
    assert np.abs(x).max() < LARGEST_RATE / 10.0
    enormous = replace(record, coefficients=np.full_like(record.coefficients, 1e200)).everything()
    assert np.isfinite(enormous.model).all()
    unknown = replace(record, coefficients=np.full_like(record.coefficients, np.nan)).everything()
    np.testing.assert_allclose(unknown.model, enormous.model, rtol=0.05)


def test_no_window_spans_a_gap_or_needs_unknown_inputs() -> None:
    record = fly(duration=8.0)
    t = (record.t_ns - START_NS) * 1e-9
    keep = (t < 3.0) | (t > 3.5)
    cut = replace(
        record, t_ns=record.t_ns[keep], rates=record.rates[keep], force=record.force[keep]
    )
    errors = window_errors(*cut.arguments())
    starts = (errors.t_ns - START_NS) * 1e-9
    assert not ((starts > 1.995) & (starts < 3.505)).any()
    assert (errors.count >= 99).all()
    known = replace(record.inputs, t_ns=record.inputs.t_ns[50:90], u=record.inputs.u[50:90])
    starts = (window_errors(*replace(record, inputs=known).arguments()).t_ns - START_NS) * 1e-9
    first, last = ((known.t_ns[i] - START_NS) * 1e-9 for i in (0, -1))
    assert starts[0] == pytest.approx(first)
    assert starts[-1] == pytest.approx(last + 0.5 - 1.0)  # held for the timeout after the last


def test_stretches_can_be_joined() -> None:
    record = fly(duration=6.0)
    whole = window_errors(*record.arguments())
    half = record.ticks_ns < START_NS + 3_000_000_000
    parts = [
        window_errors(
            *replace(
                record, ticks_ns=record.ticks_ns[k], coefficients=record.coefficients[k]
            ).arguments()
        )
        for k in (half, ~half)
    ]
    joined = WindowErrors.join(parts)
    everything = np.ones(len(whole.t_ns), dtype=bool)
    np.testing.assert_allclose(
        fit(joined, everything).model, fit(whole, everything).model, atol=1e-6
    )


def test_too_short_a_flight_has_no_score() -> None:
    record = fly(duration=0.9)
    result = record.everything()
    assert result.windows == result.samples == 0
    assert np.isnan(result.model).all()
    assert np.isnan(result.hold).all()


def test_without_inputs_there_is_no_window() -> None:
    record = fly(duration=2.0)
    nothing = InputSignal(np.empty(0, dtype=np.int64), np.empty((0, 4)))
    assert replace(record, inputs=nothing).everything().windows == 0


def test_wrong_arguments_are_named() -> None:
    record = fly(duration=2.0)
    for change, words in (
        ({"t_ns": record.t_ns[::-1]}, "stamps of the rates do not rise"),
        ({"ticks_ns": record.ticks_ns * 0}, "stamps of the ticks do not rise"),
        ({"rates": record.rates[1:]}, "differ in number"),
        ({"structure": AUGMENTED}, r"shape .* is needed for the ticks and structure 'augmented'"),
    ):
        with pytest.raises(ValueError, match=words):
            window_errors(*replace(record, **change).arguments())


def test_lagged_input_is_the_solution_of_its_equation() -> None:
    rng = np.random.default_rng(5)
    t_ns = START_NS + np.cumsum(rng.integers(5_000_000, 60_000_000, 20))
    u = rng.normal(size=(20, 4))
    for interpolation in ("linear", "hold"):
        signal = InputSignal(t_ns, u, 0.01, 0.04, interpolation)
        command = InputSignal(t_ns, u, 0.01, 0.0, interpolation)
        step = 20_000
        at = np.arange(t_ns[0] + 10_000_000, t_ns[-1] + 200_000_000, step)
        y, v = signal.at(at), command.at(at + step // 2)
        ydot = np.diff(y, axis=0) / (step * 1e-9)
        smooth = ~np.isin(np.arange(len(ydot)), np.searchsorted(at, t_ns + 10_000_000) - 1)
        expected = (v[:-1] - 0.5 * (y[1:] + y[:-1])) / 0.04
        np.testing.assert_allclose(ydot[smooth], expected[smooth], atol=1e-4)
        np.testing.assert_allclose(y[0], u[0])
        np.testing.assert_allclose(y[-1], u[-1], atol=0.05)
