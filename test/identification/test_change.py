# SPDX-License-Identifier: Apache-2.0
"""The change detector: changes of the aircraft are detected; noise and model errors are not."""

from dataclasses import replace

import numpy as np
import pytest
from flying import SURFACES, identified, light_errors, light_measured, since
from numpy.typing import ArrayLike
from scipy.signal import lfilter

from uav_ident_ros.identification.estimators.change import ChangeDetector, _whitened
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


def detector() -> ChangeDetector:
    return ChangeDetector(STRUCTURE.mask, layout(STRUCTURE), 15.0)


def swaying(ticks: int, seed: int = 2) -> tuple[FloatArray, FloatArray]:
    """Return tick numbers, and elevator deflections of that many ticks, rad."""
    k = np.arange(ticks)
    return k, 0.03 * np.sin(0.1 * k) + 0.01 * np.random.default_rng(seed).normal(size=ticks)


def filtered(state: FloatArray, signal: float) -> FloatArray:
    """Return value and slope, (2,), after a tenth of a tick of the regression's filter."""
    slope = 15.0**2 * (signal - state[0]) - np.sqrt(2.0) * 15.0 * state[1]
    return np.asarray(state + 0.1 * TICK * np.array([state[1], slope]))


class Monitor:
    """The detector after a flight with elevator `u` and disturbance `more` of qdot, per tick."""

    def __init__(
        self,
        u: FloatArray,
        more: FloatArray,
        noise: ArrayLike = 0.05,
        sigma: ArrayLike = 0.0,
        outlying: ArrayLike = False,  # Whether the residual of qdot is far outside its usual size
        error: FloatArray = NO_ERROR,
        answers: FloatArray = UNKNOWN_ANSWER,
    ) -> None:
        own, self.found, self.changes = detector(), [], []
        far = np.broadcast_to(outlying, len(u))
        scatter = np.random.default_rng(1).normal(size=(len(u), 3))
        noise, sigma = (np.broadcast_to(v, len(u)) for v in (noise, sigma))
        for k in range(len(u)):
            f = np.zeros((10, STRUCTURE.size))
            f[:, 8], f[:, CONSTANT_COLUMN] = u[k], 1.0
            y = f @ ELEVATOR.T + noise[k] * scatter[k]
            y[:, 1] += more[k]
            if own.add(Regression.of(y, f, f, TICK / 10).means()):
                rows = np.array([False, far[k], False])
                changes = own.look(
                    ELEVATOR, np.full(ELEVATOR.shape, sigma[k]), rows, error, answers
                )
                self.changes += changes
                self.found += [(k, change.row, change.column) for change in changes]

    def assert_first(self, since: int, column: int = 8) -> None:
        """Assert that the first detection is within 100 ticks after `since`, and in this column."""
        k, *place = self.found[0]
        assert since <= k < since + 100 and place == [1, column]


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
    ],
)
def test_a_lost_surface_is_detected_unless_noise_or_sigma_is_large(
    first: int, noise: float, sigma: float, detected: bool
) -> None:
    """The effect changes by 12 of -20 rad/s^2 per rad."""
    k, u = swaying(first + 200)
    flown = Monitor(u, 12.0 * u * (k >= first), noise, sigma)
    if detected:
        flown.assert_first(first)
    else:
        assert flown.found == []


@pytest.mark.parametrize(
    ("answers", "error", "detected"),
    [(0.0, 0.0, True), (0.003, 0.0, False), (0.0, 0.15, False)],
)
def test_noise_hides_a_lost_surface_only_if_it_may_answer_or_its_model_be_wrong(
    answers: float, error: float, detected: bool
) -> None:
    """The change explains a third of the residual; a sixth is significant.

    In the gusts of this flight the elevator may answer with two thirds of its motion.
    """
    k, u = swaying(1400)
    more = 12.0 * u * (k >= 1200)
    flown = Monitor(u, more, 0.2, error=error + NO_ERROR, answers=answers + FREE)
    if detected:
        flown.assert_first(1200)
        assert flown.changes[0].size == pytest.approx(12.0, rel=0.3)
    else:
        assert flown.found == []


@pytest.mark.parametrize("seed", [0, 2, 3, 4])
def test_a_change_has_the_size_and_the_time_that_explain_most(seed: int) -> None:
    """It is found before it fills the window: the slope over all of it would be a fraction."""
    k, u = swaying(1400, seed)
    flown = Monitor(u, 12.0 * u * (k >= 1200), 0.05, answers=FREE)
    (found, *_), change = flown.found[0], flown.changes[0]
    assert found < 1250
    assert change.size == pytest.approx(12.0, rel=0.2)
    assert change.after.time == pytest.approx((found - 1200) * TICK, abs=0.5)


def test_a_change_is_detected_although_its_residual_increases_sigma() -> None:
    """The residual of a change resembles feedback to a disturbance, which increases sigma."""
    k, u = swaying(1400)
    Monitor(u, 12.0 * u * (k > 1200), sigma=3.0 + 0.1 * np.maximum(k - 1200, 0)).assert_first(1200)


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
    found = Monitor(u, change * 20.0 * u * ~excited, noise, 1.0).found
    assert [place for _, *place in found[:1]] == [[1, 8]] * detected


def test_a_change_in_one_row_does_not_hide_that_in_another() -> None:
    """A rudder changes in both rows. The later one is found before its sigma has grown."""
    own, rows, found = detector(), ELEVATOR.copy(), []
    rows[0, 10] = 20.0
    (k, de), (_, da) = swaying(1400), swaying(1400, seed=4)
    chance = np.random.default_rng(1)
    for tick in k.tolist():
        f = np.zeros((10, STRUCTURE.size))
        f[:, 8], f[:, 10], f[:, CONSTANT_COLUMN] = de[tick], da[tick], 1.0
        y = f @ rows.T + 0.05 * chance.normal(size=3)
        y[:, 1] += 12.0 * de[tick] * (tick >= 1200)
        y[:, 0] -= 12.0 * da[tick] * (tick >= 1230)
        if own.add(Regression.of(y, f, f, TICK / 10).means()):
            sigma = np.full(ELEVATOR.shape, 2.0 + 0.1 * max(tick - 1200, 0))
            usual = np.zeros(3, dtype=bool)
            changes = own.look(rows, sigma, usual, NO_ERROR, UNKNOWN_ANSWER)
            found += [change[:2] for change in changes]
    assert found[:2] == [(1, 8), (0, 10)]


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_a_change_shows_in_the_force_of_a_surface(share: float) -> None:
    """A rudder's moment is nearly all by its side force, which is measured beside it."""
    structure = STRUCTURES["flight_dynamics"]
    problem, chance, found = layout(structure), np.random.default_rng(5), []
    own = ChangeDetector(structure.mask, problem, 15.0)
    moved_force = problem.index[3, problem.surfaces[1, 3]]
    rows, sigma = np.zeros((problem.rows, problem.size)), np.zeros(structure.mask.shape)
    rows[2, 9], rows[3, moved_force] = -2.0, 5.0
    dr = lfilter([1.0], [1.0, -0.8], 0.03 * chance.normal(size=1400))
    slope = np.diff(dr, prepend=0.0) / TICK
    for k in range(1400):
        f = np.zeros((10, problem.size))
        f[:, 9], f[:, moved_force] = dr[k], slope[k]
        y = (share if k >= 1200 else 1.0) * f @ rows.T + 0.3 * chance.normal(size=problem.rows)
        if own.add(Regression.of(y, f, f, TICK / 10).means()):
            usual = np.zeros(3, dtype=bool)
            changes = own.look(rows, sigma, usual, NO_ERROR, UNKNOWN_ANSWER)
            found += [(k, change) for change in changes]
    assert bool(found) == (share < 1.0)
    for detected, change in found[:1]:
        assert 1200 < detected < 1300
        assert (change.row, change.column) == (2, 9)
        assert change.size == pytest.approx(1.0, rel=0.3)


@pytest.mark.parametrize("share", [0.6, 1.5])
def test_a_change_of_a_whole_row_by_one_factor_is_detected(share: float) -> None:
    """A change of inertia does so; no control derivative explains a change of the damping."""
    chance, own = np.random.default_rng(3), detector()
    row, found = ELEVATOR.copy(), []
    row[1, 6] = -5.0
    for k in range(1400):
        f = np.zeros((10, STRUCTURE.size))
        f[:, 8], f[:, 6] = 0.03 * chance.normal(), 0.15 * chance.normal()
        y = (share if k >= 1200 else 1.0) * f @ row.T + 0.05 * chance.normal(size=3)
        if own.add(Regression.of(y, f, f, 0.005).means()):
            usual = np.zeros(3, dtype=bool)
            changes = own.look(row, np.zeros(row.shape), usual, NO_ERROR, UNKNOWN_ANSWER)
            found += [(k, change) for change in changes]
    (detected, change), *_ = found
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
    flown = Monitor(u, np.where(k >= 1400, 18.0, 4.0 * np.sin(0.013 * k)) * u)
    flown.found = [found for found in flown.found if found[0] > 400]
    flown.assert_first(1400)


def test_a_step_of_the_moment_is_attributed_to_the_constant() -> None:
    """The controller compensates it 40 ms later, so that the input correlates with the moment."""
    _, u = swaying(1400, seed=4)
    smooth, slow, moment = np.zeros(2), 0.0, np.zeros(len(u))
    for k in range(1200, len(u)):
        for _ in range(10):
            smooth = filtered(smooth, 4.0)
            slow += 0.005 * 25.0 * (smooth[0] - slow)
        moment[k], u[k] = smooth[0], u[k] + slow / 20.0
    Monitor(u, moment).assert_first(1200, CONSTANT_COLUMN)


def test_half_of_a_surface_that_pulses_is_no_step_of_the_constant() -> None:
    """A 3-2-1-1 holds the elevator: what is missing of its moment begins as a step does."""
    k, pulses = np.arange(1600), np.zeros(1600)
    for start in range(1000, 1600, 300):
        pulses[start : start + 70] = np.repeat([0.1, -0.1, 0.1, -0.1], [30, 20, 10, 10])
    held, smooth = np.zeros(len(k)), np.zeros(2)
    for tick, pulse in enumerate(pulses.tolist()):
        for _ in range(10):
            smooth = filtered(smooth, pulse)
        held[tick] = smooth[0]
    for seed in range(8):
        u = held + 0.002 * np.random.default_rng(seed).normal(size=len(k))
        Monitor(u, 12.0 * u * (k >= 1250), noise=0.08).assert_first(1250)


@pytest.mark.parametrize("ramp", [1, 40])
def test_another_trim_is_a_change_of_the_constant_where_the_row_does_not_learn(ramp: int) -> None:
    """A moment of 2 rad/s^2 builds up over that many ticks, as by flaps."""
    k, u = swaying(1600)
    moment = 2.0 * np.clip((k - 1200) / ramp, 0.0, 1.0)
    assert Monitor(u, moment).found == []
    Monitor(u, moment, outlying=k >= 1210).assert_first(1200 + ramp, CONSTANT_COLUMN)


@pytest.mark.parametrize("tau", [0.3, 1.0])
def test_gusts_outside_their_usual_size_are_no_other_trim(tau: float) -> None:
    """Gusts of 2 rad/s^2 with this correlation time, s."""
    _, u = swaying(2400)
    keep = np.exp(-TICK / tau)
    noise = np.random.default_rng(6).normal(size=len(u))
    gusts = 2.0 * np.sqrt(1.0 - keep**2) * lfilter([1.0], [1.0, -keep], noise)
    assert Monitor(u, gusts, outlying=True).found == []


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
