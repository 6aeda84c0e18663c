# SPDX-License-Identifier: Apache-2.0
"""The change detector: what it notices, and what it does not take for a change."""

import numpy as np
import pytest
from flying import identified
from light_aircraft import TRUTH, LightFlight

from uav_ident_ros.identification.estimators.change import Change, ChangeDetector, _whitened
from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.structure import CONSTANT_COLUMN, ROWS, STRUCTURES
from uav_ident_ros.simulation.flight import CoefficientChange
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.noise import Sensors, measure

STRUCTURE = STRUCTURES["augmented"]
ELEVATOR = np.zeros((3, STRUCTURE.size))
ELEVATOR[1, 8] = -20.0
EXACT = np.zeros((3, 4))
"""Coefficients of which one is known, exactly."""


def update(
    detector: ChangeDetector, data: Regression, sigma: np.ndarray = EXACT
) -> list[tuple[int, int | None]]:
    """What has changed, once it is time to look."""
    changes: list[Change] = detector.look(ELEVATOR, sigma) if detector.add(data) else []
    return [(change.row, change.column) for change in changes]


def noise_means(chance: np.random.Generator, dt: float, restarted: bool = False) -> Regression:
    """The means of a tick of ten samples of noise, `dt` s each."""
    f = chance.normal(size=(10, STRUCTURE.size))
    return Regression.of(chance.normal(size=(10, 3)), f, f, dt, restarted=restarted).means()


@pytest.mark.parametrize(
    "lengths", [(6.0, 6.0, 6.0), (4.9, 0.05, 0.05, 0.3), (2.0, 2.0, 0.9, 0.001), (0.05,) * 150]
)
def test_no_sequence_of_tick_lengths_is_too_odd(lengths: tuple[float, ...]) -> None:
    """As after a stall or a flood."""
    chance, detector = np.random.default_rng(1), ChangeDetector(STRUCTURE.mask, 15.0)
    for length in lengths:
        assert update(detector, noise_means(chance, length / 10), np.full((3, 4), 8.0)) == []


def test_a_window_does_not_reach_over_a_gap() -> None:
    """After one it is full again, and looked at, no sooner than after five seconds."""
    chance, detector = np.random.default_rng(1), ChangeDetector(STRUCTURE.mask, 15.0)
    looks = [detector.add(noise_means(chance, 0.005, restarted=k == 120)) for k in range(240)]
    assert looks[110:120] == [True] * 10  # until `look` is asked, it stays due
    assert looks.index(True, 120) - 120 == pytest.approx(100, abs=2)


def elevator_means(
    chance: np.random.Generator, u: float, more: float, noise: float = 0.05
) -> Regression:
    """The means of a tick of 0.05 s with the elevator at `u`, and `more` in qdot."""
    f = np.zeros((10, STRUCTURE.size))
    f[:, 8], f[:, CONSTANT_COLUMN] = u, 1.0
    y = f @ ELEVATOR.T + noise * chance.normal(size=3)
    y[:, 1] += more
    return Regression.of(y, f, f, 0.005).means()


@pytest.mark.parametrize(
    ("when", "noise", "sigma", "noticed"),
    [
        (60.0, 0.05, 0.0, True),
        (60.0, 0.3, 0.0, False),  # what an autopilot answers to a storm explains little of it
        (20.0, 0.05, 3.0, True),  # soon after the start, too
        (60.0, 0.05, 5.0, False),  # within three sigma: it is being learned
        (60.0, 0.05, 30.0, False),  # what is not known cannot be seen to change
    ],
)
def test_a_change_stands_out_from_noise_and_from_learning(
    when: float, noise: float, sigma: float, noticed: bool
) -> None:
    """A lost surface does, by 12 of -20."""
    chance, detector = np.random.default_rng(2), ChangeDetector(STRUCTURE.mask, 15.0)
    found, first = [], round(when / 0.05)
    for k in range(first + 200):
        u = 0.03 * np.sin(0.1 * k) + 0.01 * chance.normal()
        data = elevator_means(chance, u, 12.0 * u if k >= first else 0.0, noise)
        found += [(k, *change) for change in update(detector, data, np.full((3, 4), sigma))]
    assert [(i, j) for _, i, j in found[:1]] == ([(1, 8)] if noticed else [])
    assert all(first < k < first + 100 for k, _, _ in found[:1])


def test_a_change_does_not_hide_behind_the_sigma_that_it_makes() -> None:
    """Its residual looks like a disturbance that is answered, and sigma grows by that."""
    chance, detector = np.random.default_rng(2), ChangeDetector(STRUCTURE.mask, 15.0)
    found: list[tuple[int, int | None]] = []
    for k in range(1400):
        u, since = 0.03 * np.sin(0.1 * k) + 0.01 * chance.normal(), max(k - 1200, 0)
        data = elevator_means(chance, u, 12.0 * u if since else 0.0)
        found += update(detector, data, np.full((3, 4), 3.0 + 0.1 * since))
    assert found == [(1, 8)]


@pytest.mark.parametrize(
    ("change", "noticed"), [(0.5, True), (2.0, True), (3.0, False), (-3.0, False)]
)
def test_no_failure_changes_more_than_a_reversed_surface(change: float, noticed: bool) -> None:
    """What a yaw damper answers to gusts looks like a rudder of many times its effect.

    After excitation it explains a fifth of the residual, then less than half, then more.
    """
    chance, detector = np.random.default_rng(2), ChangeDetector(STRUCTURE.mask, 15.0)
    found: list[tuple[int, int | None]] = []
    for k in range(2400):
        excited = k < 1200
        u = (0.2 if excited else 0.03) * chance.normal()
        more, noise = (0.0, 0.05) if excited else (change * 20.0 * u, 4e-4 * (2400 - k))
        data = elevator_means(chance, u, more, noise * 3.0 * change**2 + 0.05)
        found += update(detector, data, np.full((3, 4), 1.0))
    assert (found[:1] == [(1, 8)]) == noticed


@pytest.mark.parametrize("share", [0.6, 1.5])
def test_a_row_that_changes_by_one_share_is_found_as_a_whole(share: float) -> None:
    """As by another inertia: no control derivative explains what damping has lost."""
    chance, detector = np.random.default_rng(3), ChangeDetector(STRUCTURE.mask, 15.0)
    row, found = ELEVATOR.copy(), []
    row[1, 6] = -5.0
    for k in range(1400):
        f = np.zeros((10, STRUCTURE.size))
        f[:, 8], f[:, 6] = 0.03 * chance.normal(), 0.15 * chance.normal()
        y = (share if k >= 1200 else 1.0) * f @ row.T + 0.05 * chance.normal(size=3)
        if detector.add(Regression.of(y, f, f, 0.005).means()):
            found += [(k, change) for change in detector.look(row, EXACT)]
    (noticed, change), *_ = found
    assert (change.row, change.column) == (1, None)
    assert change.size == pytest.approx(0.6 * (share - 1.0), rel=0.5)  # of half the window or more
    assert 1200 < noticed < 1300


def test_of_another_inertia_all_is_known_again_in_seconds() -> None:
    """Damping follows at once, not by forgetting."""
    segment = Segment("multisine", 2.0, 100.0, {"de": 0.06, "dr": 0.08, "da": 0.06}, seed=2)
    heavier = CoefficientChange(40.0, dict.fromkeys(ROWS, 1.4))
    flight = LightFlight((segment,), 55.0, seed=2, bank=20.0, gust=0.1, changes=(heavier,)).fly()
    m = measure(flight, Sensors(gyro_noise=0.01, accelerometer_noise=0.15), 2)
    flown, (*_, last) = identified(m)
    assert {c.name for c in flown.supervisor.changed} == {"pdot/da", "qdot/de", "rdot/dr"}
    for name in ("pdot/da", "pdot/p", "qdot/de", "qdot/q", "rdot/dr"):
        place = flown.structure.index(name)
        assert last.coefficients[place] == pytest.approx(1.4 * TRUTH[name], rel=0.15), name


def test_what_noise_hides_of_a_change_seems_to_change_until_it_is_learned() -> None:
    """An elevator at half effect makes a third of the residual: too little for a reset."""
    chance, detector = np.random.default_rng(5), ChangeDetector(STRUCTURE.mask, 15.0)
    seeming, coefficients, sigma = [], ELEVATOR, np.full((3, 4), 0.3)
    for k in range(2000):
        u = 0.03 * chance.normal()
        data = elevator_means(chance, u, 10.0 * u if k >= 1200 else 0.0, noise=0.4)
        if k == 1600:
            coefficients = 0.5 * ELEVATOR
        if detector.add(data):
            assert detector.look(coefficients, sigma) == []
        seeming.append(detector.seeming[1, 0])
        assert not np.delete(detector.seeming.ravel(), 4).any()
    assert max(seeming[:1200]) == 0.0
    assert min(seeming[1300:1600]) > 5.0
    assert max(seeming[1700:]) == 0.0


def test_what_seems_changed_still_does_after_the_input_has_rested() -> None:
    """Nothing tells meanwhile that it is over, though more noise hides it after."""
    chance, detector = np.random.default_rng(5), ChangeDetector(STRUCTURE.mask, 15.0)
    seeming = []
    for k in range(3200):
        u = 0.0 if 1600 <= k < 2400 else 0.03 * chance.normal()
        more = 10.0 * u if k >= 1200 else 0.0
        data = elevator_means(chance, u, more, noise=0.4 if k < 1600 else 1.0)
        if detector.add(data):
            assert detector.look(ELEVATOR, np.full((3, 4), 0.3)) == []
        seeming.append(detector.seeming[1, 0])
    assert np.mean(seeming[2500:]) > 5.0


def test_slow_gusts_hide_no_change() -> None:
    chance, detector = np.random.default_rng(6), ChangeDetector(STRUCTURE.mask, 15.0)
    found, gust = [], 0.0
    for k in range(1300):
        gust = 0.95 * gust + 0.4 * chance.normal()
        u = 0.03 * chance.normal()
        data = elevator_means(chance, u, gust + (12.0 * u if k >= 1200 else 0.0))
        found += [(k, *change) for change in update(detector, data)]
    assert [change[1:] for change in found] == [(1, 8)]
    assert found[0][0] >= 1200


def test_a_slope_that_comes_and_goes_is_usual() -> None:
    """A model error does; a surface that is lost then is noticed all the same."""
    chance, detector = np.random.default_rng(5), ChangeDetector(STRUCTURE.mask, 15.0)
    found = []
    for k in range(1600):
        u = 0.03 * np.sin(0.1 * k) + 0.01 * chance.normal()
        more = 18.0 if k >= 1400 else 4.0 * np.sin(0.013 * k)
        found += [(k, *change) for change in update(detector, elevator_means(chance, u, more * u))]
    known = [(k, i, j) for k, i, j in found if k > 400]
    assert known[0][0] >= 1400 and known[0][1:] == (1, 8)


def test_what_another_input_does_is_no_change() -> None:
    """An aileron of which nothing is known moves rdot; the rudder moves with it, by a hundredth."""
    chance, detector = np.random.default_rng(7), ChangeDetector(STRUCTURE.mask, 15.0)
    rudder, sigma = np.zeros_like(ELEVATOR), np.tile([0.1, 0.1, 900.0, 900.0], (3, 1))
    rudder[2, 9] = -20.0
    found: list[Change] = []
    for k in range(1400):
        aileron = 0.1 * np.sign(np.sin(0.1 * k)) if k >= 1200 else 0.0
        f = np.zeros((1, STRUCTURE.size))
        f[:, 9] = 0.03 * chance.normal() if k < 1200 else 0.01 * aileron + 1e-4 * chance.normal()
        f[:, 10] = aileron
        y = f @ rudder.T + 0.05 * chance.normal(size=3)
        y[:, 2] += 10.0 * aileron
        if detector.add(Regression.of(y, f, f, 0.05)):
            found += detector.look(rudder, sigma)
    assert found == []


def test_what_a_still_input_seems_to_do_is_not_remembered() -> None:
    """Its slope is noise: a surface that moves again and is lost is noticed all the same."""
    chance, detector = np.random.default_rng(3), ChangeDetector(STRUCTURE.mask, 15.0)
    found: list[tuple[int, int | None]] = []
    for k in range(1200):
        size = 1.0 if k % 400 < 100 or k >= 800 else 0.001
        u = size * (0.03 * np.sin(0.1 * k) + 0.01 * chance.normal())
        found += update(detector, elevator_means(chance, u, 12.0 * u if k >= 1000 else 0.0))
        assert not found or k >= 1000
    assert found[:1] == [(1, 8)]


def test_a_moment_that_steps_is_the_constant_though_the_controller_answers() -> None:
    """The input makes up for it 40 ms later, and so looks like its cause."""
    chance, detector = np.random.default_rng(4), ChangeDetector(STRUCTURE.mask, 15.0)
    found: list[tuple[int, int | None]] = []
    smooth, slow = np.zeros(2), 0.0
    for k in range(1400):
        for _ in range(10):  # the moment as the regression's filter passes it
            target = 4.0 if k >= 1200 else 0.0
            slope = 15.0**2 * (target - smooth[0]) - np.sqrt(2.0) * 15.0 * smooth[1]
            smooth = smooth + 0.005 * np.array([smooth[1], slope])
            slow += 0.005 * 25.0 * (smooth[0] - slow)
        u = 0.03 * np.sin(0.1 * k) + 0.01 * chance.normal() + slow / 20.0
        found += update(detector, elevator_means(chance, u, smooth[0]))
    assert found[:1] == [(1, CONSTANT_COLUMN)]


def test_gusts_that_fade_within_a_third_of_a_second_are_white_to_the_detector() -> None:
    rng, dt = np.random.default_rng(1), 0.05
    gusts = np.zeros((20_000, 1))
    for k, innovation in enumerate(rng.normal(size=len(gusts) - 1)):
        gusts[k + 1] = np.exp(-dt / 0.3) * gusts[k] + innovation
    white = _whitened(gusts, dt)[:, 0]
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.03
