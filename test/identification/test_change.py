# SPDX-License-Identifier: Apache-2.0
"""The change detector: changes of the aircraft are detected; noise and model errors are not."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flying import SURFACES, identified, light_errors, light_measured, since
from numpy.typing import ArrayLike
from scipy.signal import lfilter

from uav_ident_ros.identification.estimators.change import Change, ChangeDetector, _whitened
from uav_ident_ros.identification.regression import Regression, layout
from uav_ident_ros.identification.residuals import UNKNOWN_ANSWER
from uav_ident_ros.identification.structure import CONSTANT_COLUMN, ROWS, STRUCTURES, FloatArray
from uav_ident_ros.simulation.flight import CoefficientChange

STRUCTURE = STRUCTURES["augmented"]
ELEVATOR = np.zeros((3, STRUCTURE.size))
ELEVATOR[1, 8] = -20.0
TICK = 0.05
NO_ERROR, FREE = np.zeros((2, 3))
"""No model error; inputs that answer no disturbances."""


def detector(name: str = STRUCTURE.name) -> ChangeDetector:
    return ChangeDetector(STRUCTURES[name].mask, layout(STRUCTURES[name]), 15.0)


def looked(
    y: FloatArray,
    f: FloatArray,
    coefficients: FloatArray = ELEVATOR,
    structure: str = STRUCTURE.name,
    sigma: ArrayLike = 0.0,
    outlying: ArrayLike = False,  # Whether the residual of qdot is far outside its usual size
    error: FloatArray = NO_ERROR,
    answers: FloatArray = UNKNOWN_ANSWER,
) -> list[tuple[int, Change]]:
    """Return the changes detected in accelerations and regressors of each tick, and their ticks."""
    own, found, shape = detector(structure), [], STRUCTURES[structure].mask.shape
    sigma, far = (np.broadcast_to(v, len(y)) for v in (sigma, outlying))
    for k in range(len(y)):
        tick = slice(k, k + 1)
        if own.add(Regression.of(y[tick], f[tick], f[tick], TICK)):
            spread, rows = np.full(shape, sigma[k]), np.array([False, far[k], False])
            found += [(k, c) for c in own.look(coefficients, spread, rows, error, answers)]
    return found


def moved(
    u: FloatArray, more: FloatArray, noise: ArrayLike = 0.05, **known: Any
) -> list[tuple[int, Change]]:
    """Return the changes detected with elevator `u` and disturbance `more` of qdot, per tick."""
    f = np.zeros((len(u), STRUCTURE.size))
    f[:, 8], f[:, CONSTANT_COLUMN] = u, 1.0
    scatter = np.random.default_rng(1).normal(size=(len(u), 3))
    y = f @ ELEVATOR.T + np.broadcast_to(noise, len(u))[:, None] * scatter
    y[:, 1] += more
    return looked(y, f, **known)


def assert_first(found: list[tuple[int, Change]], since: int, column: int = 8) -> None:
    """Assert that the first detection is within 100 ticks after `since`, and in this column."""
    k, change = found[0]
    assert since <= k < since + 100 and (change.row, change.column) == (1, column)


def swaying(ticks: int, seed: int = 2) -> tuple[FloatArray, FloatArray]:
    """Return tick numbers, and elevator deflections of that many ticks, rad."""
    k = np.arange(ticks)
    return k, 0.03 * np.sin(0.1 * k) + 0.01 * np.random.default_rng(seed).normal(size=ticks)


def smoothed(signal: FloatArray) -> FloatArray:
    """Return the signal of each tick behind the regression's filter."""
    value, slope, out = 0.0, 0.0, []
    for now in np.repeat(signal, 10).tolist():
        bend = 15.0**2 * (now - value) - np.sqrt(2.0) * 15.0 * slope
        value, slope = value + 0.1 * TICK * slope, slope + 0.1 * TICK * bend
        out.append(value)
    return np.array(out[9::10])


def test_the_window_is_refilled_after_a_gap() -> None:
    """The next test is due 5 s after the gap."""
    chance, own, due = np.random.default_rng(1), detector(), []
    for k in range(240):
        f, y = chance.normal(size=(10, STRUCTURE.size)), chance.normal(size=(10, 3))
        due.append(own.add(Regression.of(y, f, f, 0.005, restarted=k == 120).means()))
    assert due[110:120] == [True] * 10  # a test stays due until `look`
    assert due.index(True, 120) - 120 == pytest.approx(100, abs=2)


@pytest.mark.parametrize(
    ("first", "noise", "sigma", "detected"),
    [
        (1200, 0.05, 0.0, True),
        (1200, 0.3, 0.0, False),  # feedback in a storm: the input explains little of the residual
        (400, 0.05, 3.0, True),  # soon after the start
        (1200, 0.05, 5.0, False),  # within three sigma: still being learned
        (1200, 0.05, 30.0, False),  # an unknown coefficient cannot change detectably
        # the residual of a change resembles feedback to a disturbance, which increases sigma
        (1200, 0.05, 3.0 + 0.1 * np.clip(np.arange(-1200, 200), 0, None), True),
    ],
)
def test_a_lost_surface_is_detected_unless_noise_or_sigma_is_large(
    first: int, noise: float, sigma: ArrayLike, detected: bool
) -> None:
    """The effect changes by 12 of -20 rad/s^2 per rad."""
    k, u = swaying(first + 200)
    found = moved(u, 12.0 * u * (k >= first), noise, sigma=sigma)
    if detected:
        assert_first(found, first)
    else:
        assert found == []


@pytest.mark.parametrize(
    ("answers", "error", "detected"), [(0.0, 0.0, True), (0.003, 0.0, False), (0.0, 0.15, False)]
)
def test_noise_hides_a_lost_surface_only_if_it_may_answer_or_its_model_be_wrong(
    answers: float, error: float, detected: bool
) -> None:
    """The change explains a third of the residual; a sixth is significant.

    In the gusts of this flight the elevator may answer with two thirds of its motion.
    """
    k, u = swaying(1400)
    more = 12.0 * u * (k >= 1200)
    found = moved(u, more, 0.2, error=error + NO_ERROR, answers=answers + FREE)
    if detected:
        assert_first(found, 1200)
        assert found[0][1].size == pytest.approx(12.0, rel=0.3)
    else:
        assert found == []


@pytest.mark.parametrize("seed", [0, 2, 3, 4])
def test_a_change_has_the_size_and_the_time_that_explain_most(seed: int) -> None:
    """It is found before it fills the window: the slope over all of it would be a fraction."""
    k, u = swaying(1400, seed)
    found, change = moved(u, 12.0 * u * (k >= 1200), answers=FREE)[0]
    assert found < 1250
    assert change.size == pytest.approx(12.0, rel=0.2)
    assert change.after.time == pytest.approx((found - 1200) * TICK, abs=0.5)


@pytest.mark.parametrize(
    ("change", "detected"), [(0.5, True), (2.0, True), (3.0, False), (-3.0, False)]
)
def test_a_change_beyond_a_reversed_surface_is_not_detected(change: float, detected: bool) -> None:
    """Feedback of a yaw damper in gusts resembles a change of many times the rudder's effect.

    After the excitation it explains first a fifth of the residual, then half, then more.
    """
    k = np.arange(2400)
    excited = k < 1200
    u = np.where(excited, 0.2, 0.03) * np.random.default_rng(2).normal(size=len(k))
    noise = 0.05 + 3.0 * change**2 * np.where(excited, 0.05, 4e-4 * (2400 - k))
    found = moved(u, change * 20.0 * u * ~excited, noise, sigma=1.0)
    assert [(c.row, c.column) for _, c in found[:1]] == [(1, 8)] * detected


def test_a_change_in_one_row_does_not_hide_that_in_another() -> None:
    """A rudder changes in both rows. The later one is found before its sigma has grown."""
    rows = ELEVATOR.copy()
    rows[0, 10] = 20.0
    (k, de), (_, da) = swaying(1400), swaying(1400, seed=4)
    f = np.zeros((len(k), STRUCTURE.size))
    f[:, 8], f[:, 10], f[:, CONSTANT_COLUMN] = de, da, 1.0
    y = f @ rows.T + 0.05 * np.random.default_rng(1).normal(size=(len(k), 3))
    y[:, 1] += 12.0 * de * (k >= 1200)
    y[:, 0] -= 12.0 * da * (k >= 1230)
    found = looked(y, f, rows, sigma=2.0 + 0.1 * np.maximum(k - 1200, 0))
    assert [(c.row, c.column) for _, c in found[:2]] == [(1, 8), (0, 10)]


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_a_change_shows_in_the_force_of_a_surface(share: float) -> None:
    """A rudder's moment is nearly all by its side force, which is measured beside it."""
    problem, chance = layout(STRUCTURES["flight_dynamics"]), np.random.default_rng(5)
    moved_force = problem.index[3, problem.surfaces[1, 3]]
    rows = np.zeros((problem.rows, problem.size))
    rows[2, 9], rows[3, moved_force] = -2.0, 5.0
    dr = lfilter([1.0], [1.0, -0.8], 0.03 * chance.normal(size=1400))
    f = np.zeros((1400, problem.size))
    f[:, 9], f[:, moved_force] = dr, np.diff(dr, prepend=0.0) / TICK
    y = f @ rows.T * np.where(np.arange(1400) >= 1200, share, 1.0)[:, None]
    y += 0.3 * chance.normal(size=y.shape)
    found = looked(y, f, rows, "flight_dynamics")
    assert bool(found) == (share < 1.0)
    for detected, change in found[:1]:
        assert 1200 < detected < 1300
        assert (change.row, change.column) == (2, 9)
        assert change.size == pytest.approx(1.0, rel=0.3)


@pytest.mark.parametrize("share", [0.6, 1.5])
def test_a_change_of_a_whole_row_by_one_factor_is_detected(share: float) -> None:
    """A change of inertia does so; no control derivative explains a change of the damping."""
    row, f = ELEVATOR.copy(), np.zeros((1400, STRUCTURE.size))
    row[1, 6] = -5.0
    f[:, 8], f[:, 6], *noise = np.random.default_rng(3).normal(size=(1400, 5)).T * [
        [0.03], [0.15], [0.05], [0.05], [0.05],
    ]  # fmt: skip
    y = f @ row.T * np.where(np.arange(1400) >= 1200, share, 1.0)[:, None] + np.transpose(noise)
    (detected, change), *_ = looked(y, f, row)
    assert (change.row, change.column) == (1, None)
    assert change.size == pytest.approx(share - 1.0, rel=0.1)
    assert 1200 < detected < 1300


def test_a_change_of_inertia_corrects_control_derivatives_and_damping() -> None:
    """The damping is reset with the row, before forgetting would correct it."""
    heavier = (CoefficientChange(34.0, dict.fromkeys(ROWS, 1.4)),)
    flight = {"bank": 20.0, "gust": 0.1, "seed": 2, "changes": heavier}
    m = light_measured(49.0, SURFACES, noise_seed=2, **flight)
    flown, (*_, last) = identified(m)
    assert {c.name for c in flown.supervisor.changed} == {"pdot/da", "qdot/de", "rdot/dr"}
    off, _ = light_errors(last, "pdot/da", "pdot/p", "qdot/de", "qdot/q", "rdot/dr", factor=1.4)
    assert (off < 0.15).all()


def test_a_recurring_model_error_is_not_detected_but_a_lost_surface_is() -> None:
    k, u = swaying(1600)
    found = moved(u, np.where(k >= 1400, 18.0, 4.0 * np.sin(0.013 * k)) * u)
    assert_first([(tick, change) for tick, change in found if tick > 400], 1400)


def test_a_step_of_the_moment_is_attributed_to_the_constant() -> None:
    """The controller compensates it 40 ms later, so that the input correlates with the moment."""
    k, u = swaying(1400, seed=4)
    moment = smoothed(4.0 * (k >= 1200))
    keep = np.exp(-TICK / 0.04)
    late = lfilter([1.0 - keep], [1.0, -keep], moment)
    assert_first(moved(u + late / 20.0, moment), 1200, CONSTANT_COLUMN)


def test_half_of_a_surface_that_pulses_is_no_step_of_the_constant() -> None:
    """A 3-2-1-1 holds the elevator: what is missing of its moment begins as a step does."""
    k, pulses = np.arange(1600), np.zeros(1600)
    for start in range(1000, 1600, 300):
        pulses[start : start + 70] = np.repeat([0.1, -0.1, 0.1, -0.1], [30, 20, 10, 10])
    held = smoothed(pulses)
    for seed in range(8):
        u = held + 0.002 * np.random.default_rng(seed).normal(size=len(k))
        assert_first(moved(u, 12.0 * u * (k >= 1250), 0.08), 1250)


@pytest.mark.parametrize("ramp", [1, 40])
def test_another_trim_is_a_change_of_the_constant_where_the_row_does_not_learn(ramp: int) -> None:
    """A moment of 2 rad/s^2 builds up over that many ticks, as by flaps."""
    k, u = swaying(1600)
    moment = 2.0 * np.clip((k - 1200) / ramp, 0.0, 1.0)
    assert moved(u, moment) == []
    assert_first(moved(u, moment, outlying=k >= 1210), 1200 + ramp, CONSTANT_COLUMN)


@pytest.mark.parametrize("tau", [0.3, 1.0])
def test_gusts_outside_their_usual_size_are_no_other_trim(tau: float) -> None:
    """Gusts of 2 rad/s^2 with this correlation time, s."""
    _, u = swaying(2400)
    keep = np.exp(-TICK / tau)
    noise = np.random.default_rng(6).normal(size=len(u))
    gusts = 2.0 * np.sqrt(1.0 - keep**2) * lfilter([1.0], [1.0, -keep], noise)
    assert moved(u, gusts, outlying=True) == []


@pytest.mark.parametrize(("row", "surface"), [("qdot", 0), ("pdot", 2)])
def test_a_row_learns_on_after_another_trim(row: str, surface: int) -> None:
    """A trim that the channels do not show, as by flaps, had stopped the row for good."""
    m = light_measured(56.0, bank=20.0, noise_seed=3)
    time = (m.actuator_t_ns - m.actuator_t_ns[0]) * 1e-9
    actuators = m.actuators.copy()
    actuators[:, surface] += 0.1 * np.clip((time - 38.0) / 2.0, 0.0, 1.0)
    identifier, estimates = identified(replace(m, actuators=actuators))
    assert {change.name for change in identifier.supervisor.changed} == {f"{row}/1"}
    usable = [e.usable_rows[ROWS.index(row)] for e in since(estimates, 50.0, 56.0)]
    assert all(usable)
    assert max(light_errors(estimates[-1], "pdot/da", "qdot/de")[1]) < 3.0


def test_prewhitening_whitens_gusts_with_a_correlation_time_of_0_3_s() -> None:
    keep = np.exp(-TICK / 0.3)
    gusts = lfilter([1.0], [1.0, -keep], np.random.default_rng(1).normal(size=20_000))
    white = _whitened(gusts[:, None], TICK)[:, 0]
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.03
