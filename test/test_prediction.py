# SPDX-License-Identifier: Apache-2.0
"""The score of record, compared with an integration and the explicit formula."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from equations import AIRCRAFT, flight_equations, matrix, with_down
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from uav_ident_ros.identification import prediction
from uav_ident_ros.identification.model import LARGEST_RATE
from uav_ident_ros.identification.structure import STRUCTURES, Structure

Array = NDArray[np.float64]
START_NS = 1_700_000_000_000_000_000
ACCURACY = {"rtol": 1e-8, "atol": 1e-10, "max_step": 0.05}
"""Tolerances of the reference integration; the inputs have a corner every 0.05 s."""

BASELINE, AUGMENTED = STRUCTURES["baseline"], STRUCTURES["augmented"]
FLIGHT = STRUCTURES["flight_dynamics"]
AIRSPEED = 18.0
NO_ARM = np.zeros(3)


@dataclass(frozen=True)
class Record(prediction.Flown):
    """Measurements of a flight, and the published coefficients."""

    ticks_ns: NDArray[np.int64]
    coefficients: Array
    structure: Structure
    flow: Array | None = None

    @property
    def published(self) -> prediction.Published:
        return prediction.Published(self.ticks_ns, self.coefficients, self.structure, self.flow)

    def samples(self, which: NDArray[np.bool_]) -> Record:
        """Return the record with some of the gyro samples only."""
        measured = (self.t_ns[which], self.rates[which], self.force[which])
        return replace(self, **dict(zip(("t_ns", "rates", "force"), measured, strict=True)))

    def everything(self) -> prediction.PredictionFit:
        """Return the fit over all windows."""
        errors = prediction.window_errors(self, self.published)
        return prediction.fit(errors, np.ones(len(errors.t_ns), dtype=bool))


def force_of(t: Array) -> Array:
    """Return a smooth ay, az at the centre of gravity."""
    return np.stack([np.sin(2.1 * t) + 0.3, 9.8 + 1.5 * np.cos(1.7 * t)], axis=-1)


def motion(structure: Structure, a: Array, state: Array, u: Array, force: Array) -> Array:
    """Return the derivatives of p, q, r; with flow angles also of beta, alpha, roll and pitch."""
    if structure is not FLIGHT:
        return a @ structure.regressor(state, u, force)
    return flight_equations(a, state, u, AIRSPEED)


def line(t: Array, values: Array, at: float) -> Array:
    """Interpolate linearly between samples; hold the first and last value beyond."""
    k = min(max(int(t.searchsorted(at)), 1), len(t) - 1)
    share = (at - t[k - 1]) / (t[k] - t[k - 1])
    return values[k - 1] + min(max(share, 0.0), 1.0) * (values[k] - values[k - 1])


def path(
    derivative: Callable[[float, Array], Array], begin: float, t: Array, state: Array
) -> Array:
    """Return the states at some times after the start."""
    return solve_ivp(derivative, (begin, t[-1]), state, t_eval=t, **ACCURACY).y.T


def fly(
    structure: Structure = BASELINE,
    duration: float = 8.0,
    rate: float = 100.0,
    delay: float = 0.0,
    time_constant: float = 0.0,
    lever_arm: Array = NO_ARM,
    jitter: float = 0.0,
) -> Record:
    """Integrate a plant with an independent form of servo lag and delay."""
    rng = np.random.default_rng(0)
    a = matrix(structure, AIRCRAFT | {"qdot/dth": 0.3, "pdot/dth": 0.2, "rdot/dth": -0.1})
    tu = np.arange(-0.2, duration + 0.2, 0.05)
    u = rng.uniform(-0.1, 0.1, (len(tu), 4))
    t = np.arange(0.0, duration, 1.0 / rate)
    t[1:-1] += rng.uniform(-jitter, jitter, len(t) - 2) / rate
    t_ns = START_NS + np.rint(t * 1e9).astype(np.int64)
    tu_ns = START_NS + np.rint(tu * 1e9).astype(np.int64)

    def commanded(at: float) -> Array:
        return line(tu, u, at - delay)

    start = np.array([0.1, -0.05, 0.02])
    if structure is FLIGHT:
        start = np.concatenate([start, [0.03, 0.12, 0.1, 0.02]])
    width = len(start)

    def derivative(at: float, state: Array) -> Array:
        x, servo = state[:width], state[width:]
        command = commanded(at)
        actual = servo if time_constant else command
        xdot = motion(structure, a, x, actual, force_of(np.array(at)))
        xdot = xdot if at >= 0.0 else np.zeros(width)  # before the start only the servos move
        lag = (command - servo) / time_constant if time_constant else np.zeros(4)
        return np.concatenate([xdot, lag])

    states = path(derivative, tu[0] + delay, t, np.concatenate([start, u[0]]))
    x, flow, servo = states[:, :3], states[:, 3:width], states[:, width:]
    actual = servo if time_constant else np.array([commanded(v) for v in t])
    regressors = structure.regressor(x, actual, flow[:, :2] if structure is FLIGHT else force_of(t))
    force = regressors @ a[3:5].T if structure is FLIGHT else force_of(t)
    swing = np.cross(regressors @ a[:3].T, lever_arm) + np.cross(x, np.cross(x, lever_arm))
    force = force + swing[:, 1:]
    first_tick = -(-int(t_ns[0]) // 50_000_000)
    ticks_ns = 50_000_000 * np.arange(first_tick, int(t_ns[-1]) // 50_000_000 + 1)
    known = slice(int((duration + 0.2) / 0.05))
    signal = prediction.InputSignal(tu_ns[known], u[known], delay, time_constant)
    coefficients = np.broadcast_to(a, (len(ticks_ns), *a.shape))
    flow_states = None
    if structure is FLIGHT:
        at_ticks = [np.interp(ticks_ns - START_NS, t_ns - START_NS, part) for part in flow.T]
        speed = np.full((len(ticks_ns), 1), AIRSPEED)
        flow_states = np.hstack([with_down(np.transpose(at_ticks)), speed])
    return Record(t_ns, x, signal, force, lever_arm, ticks_ns, coefficients, structure, flow_states)


@pytest.mark.parametrize(
    ("flown", "limit"),
    [
        ({"rate": 37.0}, 99.0),  # rates between samples are interpolated linearly
        ({"delay": 0.033, "time_constant": 0.06}, 99.995),
        ({"structure": FLIGHT, "rate": 200.0, "delay": 0.033, "time_constant": 0.06}, 99.0),
    ],
    ids=["slow gyro", "delay and lag", "flight dynamics, delay and lag"],
)
def test_true_coefficients_have_a_fit_near_100_percent(flown: dict[str, Any], limit: float) -> None:
    result = fly(duration=3.2, **flown).everything()
    assert result.windows >= 40
    assert (result.free[:2] > limit).all()
    assert (result.free[:2] <= 100.0).all()
    assert (result.hold < 60.0).all()
    np.testing.assert_array_equal(
        (result.model, result.hold), (result.free[0], result.free_hold[0])
    )
    # a horizon longer than every window has no score
    assert np.isnan((result.free[2], result.free_hold[2])).all()


@pytest.mark.parametrize("structure", [AUGMENTED, FLIGHT])
def test_measured_force_fit_is_corrected_for_the_lever_arm(structure: Structure) -> None:
    arm = np.array([0.3, -0.05, 0.1])
    record = fly(structure, duration=2.5, rate=200.0, lever_arm=arm)
    assert (record.everything().measured_force > 99.8).all()
    assert (replace(record, lever_arm=NO_ARM).everything().measured_force < 95.0).any()


def inside(record: Record, tick: int, horizon: float = 1.0) -> NDArray[np.bool_]:
    """Return flags of the gyro samples in a window."""
    start = record.ticks_ns[tick]
    return (record.t_ns > start) & (record.t_ns <= start + round(horizon * 1e9))


def predicted(
    record: Record, tick: int, *, free: bool, horizon: float = 1.0
) -> tuple[Array, Array]:
    """Return prediction and measurement at the gyro samples of a window."""
    t = (record.t_ns - START_NS) * 1e-9
    t0 = (record.ticks_ns[tick] - START_NS) * 1e-9
    window = inside(record, tick, horizon)
    tu = (record.inputs.t_ns - START_NS) * 1e-9
    structure, a = record.structure, record.coefficients[tick]

    force = line(t, record.force, t0)

    def derivative(at: float, state: Array) -> Array:
        u = line(tu, record.inputs.u, at)
        if free:
            return motion(structure, a, state, u, force)
        last = line(t, record.force, at)
        if structure is FLIGHT:  # the flow angles at which the rows give the measured forces
            without = a @ structure.regressor(state, u)
            slopes = [a[structure.index(name)] for name in ("ay/beta", "az/alpha")]
            last = (last - without[3:5]) / slopes
        return a[:3] @ structure.regressor(state, u, last)

    state = line(t, record.rates, t0)
    if free and record.flow is not None:
        beta, alpha, *down, _ = record.flow[tick]
        attitude = [np.arctan2(down[1], down[2]), -np.arcsin(down[0])]
        state = np.concatenate([state, [beta, alpha, *attitude]])
    return path(derivative, t0, t[window], state)[:, :3], record.rates[window]


def percent(model: list[Array], measured: list[Array]) -> Array:
    """Return the fit by the formula of the contract."""
    m, x = np.concatenate(model), np.concatenate(measured)
    distance = np.linalg.norm(m - x, axis=0)
    return 100.0 * (1.0 - distance / np.linalg.norm(x - x.mean(axis=0), axis=0))


@pytest.mark.parametrize("structure", [AUGMENTED, FLIGHT])
@pytest.mark.parametrize("horizon", [1.0, 0.05])
def test_predictions_equal_the_end_of_an_integration(structure: Structure, horizon: float) -> None:
    record = fly(structure, duration=3.0)
    factors = np.random.default_rng(3).uniform(0.5, 1.5, (len(record.ticks_ns), 1, 1))
    record = replace(record, coefficients=record.coefficients * factors)
    t_ns, ahead = prediction.predict_ahead(record, record.published, horizon)
    horizon_ns = round(horizon * 1e9)
    count = int((record.ticks_ns + horizon_ns <= record.t_ns[-1]).sum())
    np.testing.assert_array_equal(t_ns, record.ticks_ns[:count] + horizon_ns)
    for tick in (0, count // 2, count - 1):
        model, _ = predicted(record.samples(record.t_ns <= t_ns[tick]), tick, free=True)
        # error of the Runge-Kutta method at its largest step, for these modes
        np.testing.assert_allclose(ahead[tick], model[-1], rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("structure", "duration", "every"), [(AUGMENTED, 3.0, 8), (FLIGHT, 5.2, 24)]
)
def test_fit_equals_the_formula_with_wrong_and_changing_coefficients(
    structure: Structure, duration: float, every: int
) -> None:
    """Each horizon includes only the windows of at least its length."""
    record, rng = fly(structure, duration=duration, jitter=0.3), np.random.default_rng(3)
    noisy = record.rates + 0.02 * rng.normal(size=record.rates.shape)
    wrong = record.coefficients * rng.uniform(0.7, 1.4, (len(record.ticks_ns), 1, 1))
    record = replace(
        record, rates=noisy, ticks_ns=record.ticks_ns[::every], coefficients=wrong[::every],
        flow=None if record.flow is None else record.flow[::every],
    )  # fmt: skip
    result = record.everything()
    ends = record.ticks_ns[:, None] + np.rint(1e9 * np.array(prediction.HORIZONS)).astype(int)
    covered = (ends <= record.t_ns[-1]).sum(axis=0)
    assert covered[0] == result.windows
    for i, horizon in enumerate(prediction.HORIZONS[: np.count_nonzero(covered)]):
        runs = [predicted(record, k, free=True, horizon=horizon) for k in range(covered[i])]
        measured = [m for _, m in runs]
        expected, t = percent([p for p, _ in runs], measured), record.t_ns - START_NS
        at_start = (line(t, record.rates, tick) for tick in record.ticks_ns - START_NS)
        held = [np.tile(x, (len(m), 1)) for x, m in zip(at_start, measured, strict=False)]
        np.testing.assert_allclose(result.free[i], expected, atol=2e-4 if i == 0 else 2e-3)
        np.testing.assert_allclose(result.free_hold[i], percent(held, measured), atol=1e-8)
        if i == 0:
            assert result.samples == sum(map(len, measured))
            forced = [predicted(record, k, free=False)[0] for k in range(covered[0])]
            expected = percent(forced, measured)
            np.testing.assert_allclose(result.measured_force, expected, atol=2e-4)
            assert not np.allclose(result.measured_force, result.model, atol=1.0)


def test_windows_of_the_score_of_record_have_the_counts_of_the_contract() -> None:
    t_ns = START_NS + 10_000_000 * np.arange(6001)  # 60 s at 100 Hz
    rates = np.random.default_rng(0).normal(size=(6001, 3))
    ticks = START_NS + 50_000_000 * np.arange(1, 1201)
    inputs = prediction.InputSignal(t_ns, np.zeros((6001, 4)))
    coefficients = np.zeros((1200, 3, BASELINE.size))
    flown = prediction.Flown(t_ns, rates, inputs, np.zeros((6001, 2)), NO_ARM)
    errors = prediction.window_errors(flown, prediction.Published(ticks, coefficients, BASELINE))
    result = prediction.score_windows(errors, int(t_ns[0]), int(t_ns[-1]))
    assert list(result) == list(prediction.SELECTIONS) == ["last_40_percent", "after_30_s"]
    # starts at 36 s, and at 30 s, to 59 s inclusive
    assert result["last_40_percent"].windows == 23 * 20 + 1
    assert result["after_30_s"].windows == 29 * 20 + 1
    assert result["after_30_s"].samples == (29 * 20 + 1) * 100
    # a model without coefficients holds the initial rate
    np.testing.assert_allclose(result["after_30_s"].free, result["after_30_s"].free_hold)
    assert np.isnan(result["after_30_s"].measured_force).all()


def test_divergent_prediction_is_clipped() -> None:
    record = fly(duration=3.0)
    runaway = np.zeros_like(record.coefficients)
    runaway[:, 1, 3] = 1e9  # qdot = 1e9 p^2
    result = replace(record, coefficients=runaway).everything()
    measured = np.concatenate([record.rates[inside(record, k), 1] for k in range(result.windows)])
    expected = np.linalg.norm(LARGEST_RATE - measured) / np.linalg.norm(measured - measured.mean())
    assert result.model[1] == pytest.approx(100.0 * (1.0 - expected), rel=1e-2)
    assert np.abs(record.rates).max() < LARGEST_RATE / 10.0
    for value, limit in ((1e200, LARGEST_RATE), (np.nan, -LARGEST_RATE)):
        filled = np.full_like(record.coefficients, value)
        result = replace(record, coefficients=filled).everything()
        measured = [record.rates[inside(record, k)] for k in range(result.windows)]
        at_limit = [np.full_like(rates, limit) for rates in measured]
        np.testing.assert_allclose(result.model, percent(at_limit, measured), rtol=1e-4)


def test_no_window_spans_a_gap_or_needs_unknown_inputs() -> None:
    record = fly(duration=8.0)
    t = (record.t_ns - START_NS) * 1e-9
    cut = record.samples((t < 3.0) | (t > 3.5))
    errors = prediction.window_errors(cut, cut.published)
    starts = (errors.t_ns - START_NS) * 1e-9
    assert not ((starts > 1.995) & (starts < 3.505)).any()
    assert (errors.count[:, 0] >= 99).all()
    beyond = (errors.count == 0) == (
        starts[:, None] + prediction.HORIZONS > np.where(starts < 3.0, 2.995, 7.985)[:, None]
    )
    assert beyond.all()
    known = replace(record.inputs, t_ns=record.inputs.t_ns[50:90], u=record.inputs.u[50:90])
    errors = prediction.window_errors(replace(record, inputs=known), record.published)
    assert errors.t_ns[0] == pytest.approx(known.t_ns[0])
    # the last inputs hold until the timeout
    assert (errors.t_ns[-1] - known.t_ns[-1]) * 1e-9 == pytest.approx(0.5 - 1.0)
