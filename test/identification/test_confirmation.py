# SPDX-License-Identifier: Apache-2.0
"""What a surface does, confirmed by the flight or contradicted by it."""

import numpy as np
import pytest

from uav_ident_ros.identification.regression import Regression, RowSamples, layout
from uav_ident_ros.identification.residuals import Confirmation, NoiseModel
from uav_ident_ros.identification.structure import INPUT_COLUMNS, INPUTS, STRUCTURES

LAYOUT = layout(STRUCTURES["augmented"])
DT = 0.05
MAX_AGE = 60.0
BELIEVED = np.zeros((3, 4))
"""Control derivatives, rad/s^2 per rad: aileron, elevator and rudder."""
BELIEVED[0, INPUTS.index("da")] = 40.0
BELIEVED[1, INPUTS.index("de")] = -25.0
BELIEVED[2, INPUTS.index("dr")] = -9.0
ROLL, PITCH, YAW = range(3)


class Flown:
    """Ticks of surfaces that move, in gusts that are slow and large."""

    def __init__(self, seed: int = 1) -> None:
        self.confirmed = Confirmation()
        self._noise = NoiseModel(3)
        self.max_age = MAX_AGE
        self._rng = np.random.default_rng(seed)
        self._gust = np.zeros(3)
        self._u = np.zeros(4)
        self.restarted = True

    def fly(
        self,
        seconds: float,
        effect: float = 1.0,
        moved: float = 1.0,
        row: int = ROLL,
        gust: float = 0.5,
    ) -> None:
        """Fly with the main surface of a row worth `effect` of what is believed of it."""
        actual = BELIEVED.copy()
        actual[row] *= effect
        for _ in range(round(seconds / DT)):
            self._gust = 0.9 * self._gust + gust * self._rng.normal(size=3)
            self._u = 0.8 * self._u + 0.03 * moved * self._rng.normal(size=4)
            residual = self._gust + (actual - BELIEVED) @ self._u
            f = np.zeros((1, 15))
            f[0, INPUT_COLUMNS] = self._u
            samples = Regression.of(np.zeros((1, 3)), f, f, DT)
            sample = RowSamples.of(samples, residual[None], LAYOUT)
            white = self._noise.whiten(sample, restarted=self.restarted)
            self.restarted = False
            effect = LAYOUT.main_effect(BELIEVED, white)
            self.confirmed.add(white, effect, self._noise.variance, self.max_age)

    def doubts(self) -> list[str]:
        return [self.confirmed.doubt(row) for row in range(3)]


def test_nothing_is_confirmed_before_anything_has_moved() -> None:
    assert Flown().doubts() == [
        "pdot/da is unconfirmed: da has hardly moved of late; move it",
        "qdot/de is unconfirmed: de has hardly moved of late; move it",
        "rdot/dr is unconfirmed: dr has hardly moved of late; move it",
    ]


@pytest.mark.parametrize(
    ("gust", "max_age", "then", "moved"),
    [(0.5, MAX_AGE, 1.0, 1.0), (0.5, 0.0, 10.0 * MAX_AGE, 0.0), (0.0, MAX_AGE, 1.0, 1.0)],
    ids=["after a gap", "for ever if there is no largest age", "without noise"],
)
def test_surfaces_that_do_as_believed_are_confirmed(
    gust: float, max_age: float, then: float, moved: float
) -> None:
    flight = Flown()
    flight.max_age = max_age
    flight.fly(20.0, gust=gust)
    flight.restarted = True
    flight.fly(then, moved=moved, gust=gust)
    assert flight.doubts() == ["", "", ""]


@pytest.mark.parametrize("effect", [-1.0, 0.0], ids=["reversed", "lost"])
@pytest.mark.parametrize("row", [ROLL, PITCH, YAW])
def test_a_surface_that_fails_speaks_against_itself(row: int, effect: float) -> None:
    """Soon, however long it had worked; and the others stay what they are."""
    flight = Flown()
    flight.fly(2.0 * MAX_AGE)
    flight.fly(10.0, effect, row=row)
    surface, axis = ("da", "de", "dr")[row], ("pdot", "qdot", "rdot")[row]
    doubts = flight.doubts()
    assert doubts.pop(row) == (
        f"{axis}/{surface} is contradicted: {axis} does not follow {surface}; check the surface"
    )
    assert doubts == ["", ""]


@pytest.mark.parametrize(("effect", "doubted"), [(0.3, True), (0.7, False), (1.3, False)])
def test_half_of_what_is_believed_is_the_border(effect: float, doubted: bool) -> None:
    """Below it the flight speaks for nothing, above it for what is believed."""
    flight = Flown()
    flight.fly(60.0)
    flight.fly(30.0, effect)
    doubts = flight.doubts()
    assert ("does not follow" in doubts[ROLL]) == doubted
    assert doubted or doubts == ["", "", ""]


def test_what_does_not_move_fades_in_its_time() -> None:
    flight = Flown()
    flight.fly(60.0)
    flight.fly(0.4 * MAX_AGE, moved=0.0)
    assert flight.doubts() == ["", "", ""]
    flight.fly(0.8 * MAX_AGE, moved=0.0)
    assert all("unconfirmed" in doubt for doubt in flight.doubts())
    flight.fly(20.0)
    assert flight.doubts() == ["", "", ""]


@pytest.mark.parametrize("seed", range(1, 6))
def test_what_no_surface_explains_speaks_against_none(seed: int) -> None:
    """A manoeuvre about another axis, which leaves far more than usual, as sideslip pitches."""
    flight = Flown(seed)
    flight.fly(60.0)
    for _ in range(20):
        flight.fly(0.5, moved=0.5, gust=15.0)
        assert not any("contradicted" in doubt for doubt in flight.doubts())


TURN, REST = 3.0, 15.0
"""Time of a test input on a surface, and of those on the others, s."""
MOVED = 4.0
"""Size of a test input."""


def in_turns() -> Flown:
    """Fly three turns of all surfaces, the last one just over; what is confirmed fades in 5 s."""
    flight = Flown()
    flight.max_age = 5.0
    for _ in range(3):
        flight.fly(REST, moved=0.0)
        flight.fly(TURN, moved=MOVED)
    return flight


def test_surfaces_that_have_their_turns_stay_confirmed_until_the_next_is_due() -> None:
    flight = in_turns()
    flight.fly(REST + TURN, moved=0.0)
    assert flight.doubts() == ["", "", ""]
    flight.fly(5.0, moved=0.0)
    assert all("unconfirmed" in doubt for doubt in flight.doubts())


def test_a_turn_in_which_a_surface_does_nothing_counts_against_it() -> None:
    flight = in_turns()
    flight.fly(REST, moved=0.0)
    flight.fly(TURN, 0.0, MOVED, row=PITCH)
    assert [bool(doubt) for doubt in flight.doubts()] == [False, True, False]


def test_a_row_that_is_learned_anew_is_forgotten_alone() -> None:
    flight = in_turns()
    flight.confirmed.forget(PITCH)
    doubts = flight.doubts()
    assert doubts[PITCH].startswith("qdot/de is unconfirmed")
    assert [doubts[ROLL], doubts[YAW]] == ["", ""]
    flight.fly(TURN, moved=MOVED)
    flight.fly(8.0, moved=0.0)
    assert [bool(doubt) for doubt in flight.doubts()] == [False, True, False]
