# SPDX-License-Identifier: Apache-2.0
"""The change detector: what it notices, and what it does not take for a change."""

import numpy as np
import pytest
from flying import SURFACES, identified, light_errors, light_measured
from numpy.typing import ArrayLike
from scipy.signal import lfilter

from uav_ident_ros.identification.estimators.change import ChangeDetector, _whitened
from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.structure import (
    CONSTANT_COLUMN,
    ROWS,
    STRUCTURES,
    FloatArray,
)
from uav_ident_ros.simulation.flight import CoefficientChange

STRUCTURE = STRUCTURES["augmented"]
ELEVATOR = np.zeros((3, STRUCTURE.size))
ELEVATOR[1, 8] = -20.0
TICK = 0.05


def detector() -> ChangeDetector:
    return ChangeDetector(STRUCTURE.mask, 15.0)


def swaying(ticks: int, seed: int = 2) -> tuple[FloatArray, FloatArray]:
    """Numbers of ticks, and an elevator that moves in them."""
    k = np.arange(ticks)
    return k, 0.03 * np.sin(0.1 * k) + 0.01 * np.random.default_rng(seed).normal(size=ticks)


class Watched:
    """A detector after a flight of the elevator: u, and what else is in qdot, at each tick."""

    def __init__(
        self,
        u: FloatArray,
        more: FloatArray,
        noise: ArrayLike = 0.05,
        sigma: ArrayLike = 0.0,
        known: ArrayLike = 1.0,  # Times its effect
    ) -> None:
        own, self.found, self.apparent = detector(), [], np.zeros(len(u))
        scatter = np.random.default_rng(1).normal(size=(len(u), 3))
        noise, sigma, known = (np.broadcast_to(v, len(u)) for v in (noise, sigma, known))
        for k in range(len(u)):
            f = np.zeros((10, STRUCTURE.size))
            f[:, 8], f[:, CONSTANT_COLUMN] = u[k], 1.0
            y = f @ ELEVATOR.T + noise[k] * scatter[k]
            y[:, 1] += more[k]
            if own.add(Regression.of(y, f, f, TICK / 10).means()):
                changes = own.look(known[k] * ELEVATOR, np.full((3, 4), sigma[k]))
                self.found += [(k, change.row, change.column) for change in changes]
            self.apparent[k] = own.apparent[1, 0]
            assert not np.delete(own.apparent.ravel(), 4).any()

    def assert_first(self, since: int, column: int = 8) -> None:
        """Nothing before a tick, and then a change of the elevator."""
        k, *place = self.found[0]
        assert since <= k < since + 100 and place == [1, column]


def test_a_window_does_not_reach_over_a_gap() -> None:
    """After one it is full again, and looked at, no sooner than after five seconds."""
    chance, own, looks = np.random.default_rng(1), detector(), []
    for k in range(240):
        f, y = chance.normal(size=(10, STRUCTURE.size)), chance.normal(size=(10, 3))
        looks.append(own.add(Regression.of(y, f, f, 0.005, restarted=k == 120).means()))
    assert looks[110:120] == [True] * 10  # until `look` is asked, it stays due
    assert looks.index(True, 120) - 120 == pytest.approx(100, abs=2)


@pytest.mark.parametrize(
    ("first", "noise", "sigma", "noticed"),
    [
        (1200, 0.05, 0.0, True),
        (1200, 0.3, 0.0, False),  # what an autopilot answers to a storm explains little of it
        (400, 0.05, 3.0, True),  # soon after the start, too
        (1200, 0.05, 5.0, False),  # within three sigma: it is being learned
        (1200, 0.05, 30.0, False),  # what is not known cannot be seen to change
    ],
)
def test_a_change_stands_out_from_noise_and_from_learning(
    first: int, noise: float, sigma: float, noticed: bool
) -> None:
    """A lost surface does, by 12 of -20."""
    k, u = swaying(first + 200)
    flown = Watched(u, 12.0 * u * (k >= first), noise, sigma)
    if noticed:
        flown.assert_first(first)
    else:
        assert flown.found == []


def test_a_change_does_not_hide_behind_the_sigma_that_it_makes() -> None:
    """Its residual looks like a disturbance that is answered, and sigma grows by that."""
    k, u = swaying(1400)
    Watched(u, 12.0 * u * (k > 1200), sigma=3.0 + 0.1 * np.maximum(k - 1200, 0)).assert_first(1200)


@pytest.mark.parametrize(
    ("change", "noticed"), [(0.5, True), (2.0, True), (3.0, False), (-3.0, False)]
)
def test_no_failure_changes_more_than_a_reversed_surface(change: float, noticed: bool) -> None:
    """What a yaw damper answers to gusts looks like a rudder of many times its effect.

    After excitation it explains a fifth of the residual, then less than half, then more.
    """
    k = np.arange(2400)
    excited = k < 1200
    u = np.where(excited, 0.2, 0.03) * np.random.default_rng(2).normal(size=len(k))
    noise = 0.05 + 3.0 * change**2 * np.where(excited, 0.05, 4e-4 * (2400 - k))
    found = Watched(u, change * 20.0 * u * ~excited, noise, 1.0).found
    assert [place for _, *place in found[:1]] == [[1, 8]] * noticed


@pytest.mark.parametrize("share", [0.6, 1.5])
def test_a_row_that_changes_by_one_share_is_found_as_a_whole(share: float) -> None:
    """As by another inertia: no control derivative explains what damping has lost."""
    chance, own = np.random.default_rng(3), detector()
    row, found = ELEVATOR.copy(), []
    row[1, 6] = -5.0
    for k in range(1400):
        f = np.zeros((10, STRUCTURE.size))
        f[:, 8], f[:, 6] = 0.03 * chance.normal(), 0.15 * chance.normal()
        y = (share if k >= 1200 else 1.0) * f @ row.T + 0.05 * chance.normal(size=3)
        if own.add(Regression.of(y, f, f, 0.005).means()):
            found += [(k, change) for change in own.look(row, np.zeros((3, 4)))]
    (noticed, change), *_ = found
    assert (change.row, change.column) == (1, None)
    assert change.size == pytest.approx(0.6 * (share - 1.0), rel=0.5)  # of half the window or more
    assert 1200 < noticed < 1300


def test_of_another_inertia_all_is_known_again_in_seconds() -> None:
    """Damping follows at once, not by forgetting."""
    heavier = (CoefficientChange(40.0, dict.fromkeys(ROWS, 1.4)),)
    flight = {"bank": 20.0, "gust": 0.1, "seed": 2, "changes": heavier}
    m = light_measured(55.0, SURFACES, sensors={"rate": 200.0}, noise_seed=2, **flight)
    flown, (*_, last) = identified(m)
    assert {c.name for c in flown.supervisor.changed} == {"pdot/da", "qdot/de", "rdot/dr"}
    off, _ = light_errors(last, "pdot/da", "pdot/p", "qdot/de", "qdot/q", "rdot/dr", factor=1.4)
    assert (off < 0.15).all()


def test_what_noise_hides_of_a_change_seems_to_change_until_it_is_learned() -> None:
    """An elevator at half effect makes a third of the residual: too little for a reset.

    While it rests, nothing tells that it is over.
    """
    k, u = np.arange(2000), 0.03 * np.random.default_rng(1).normal(size=2000)
    u[1400:1550] = 0.0
    known = np.where(k < 1600, 1.0, 0.5)
    flown = Watched(u, 10.0 * u * (k >= 1200), 0.4, 0.3, known)
    assert flown.found == []
    assert flown.apparent[:1200].max() == 0.0
    assert flown.apparent[1300:1600].min() > 5.0
    assert flown.apparent[1700:].max() == 0.0


def test_a_slope_that_comes_and_goes_is_usual() -> None:
    """A model error does; a surface that is lost then is noticed all the same."""
    k, u = swaying(1600)
    flown = Watched(u, np.where(k >= 1400, 18.0, 4.0 * np.sin(0.013 * k)) * u)
    flown.found = [found for found in flown.found if found[0] > 400]
    flown.assert_first(1400)


def test_a_moment_that_steps_is_the_constant_though_the_controller_answers() -> None:
    """The input makes up for it 40 ms later, and so looks like its cause."""
    _, u = swaying(1400, seed=4)
    smooth, slow, moment = np.zeros(2), 0.0, np.zeros(len(u))
    for k in range(1200, len(u)):
        for _ in range(10):  # the moment as the regression's filter passes it
            slope = 15.0**2 * (4.0 - smooth[0]) - np.sqrt(2.0) * 15.0 * smooth[1]
            smooth = smooth + 0.005 * np.array([smooth[1], slope])
            slow += 0.005 * 25.0 * (smooth[0] - slow)
        moment[k], u[k] = smooth[0], u[k] + slow / 20.0
    Watched(u, moment).assert_first(1200, CONSTANT_COLUMN)


def test_gusts_that_fade_within_a_third_of_a_second_are_white_to_the_detector() -> None:
    keep = np.exp(-TICK / 0.3)
    gusts = lfilter([1.0], [1.0, -keep], np.random.default_rng(1).normal(size=20_000))
    white = _whitened(gusts[:, None], TICK)[:, 0]
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.03
