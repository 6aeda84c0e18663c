# SPDX-License-Identifier: Apache-2.0
"""Confirmation of control derivatives: the flight confirms or contradicts each."""

import numpy as np
import pytest
from scipy.signal import lfilter

from uav_ident_ros.identification.regression import Layout, Regression, RowSamples, layout
from uav_ident_ros.identification.residuals import Autoregression, Confirmation
from uav_ident_ros.identification.structure import INPUT_COLUMNS, INPUTS, MAIN_COLUMNS, STRUCTURES

LAYOUT, FLOW = (layout(STRUCTURES[name]) for name in ("augmented", "flight_dynamics"))
DT = 0.05
BLOCK = 4
"""Samples that are added together."""
MAX_AGE = 30.0
ROLL, PITCH, YAW = range(3)
ESTIMATED = np.zeros((3, 4))
"""Control derivatives, rad/s^2 per rad: aileron, elevator and rudder."""
ESTIMATED[ROLL, INPUTS.index("da")] = 40.0
ESTIMATED[PITCH, INPUTS.index("de")] = -25.0
ESTIMATED[YAW, INPUTS.index("dr")] = -9.0
LINEAR = np.zeros((3, LAYOUT.size))
LINEAR[:, INPUT_COLUMNS] = ESTIMATED
BY_FORCE = FLOW.index[3, FLOW.surfaces[1, 3]]
"""Column of the rudder in the row of the side force."""
RUDDER = np.zeros((FLOW.rows, FLOW.size))
"""Estimate of a rudder whose moment is nearly all by its side force, in SI units."""
RUDDER[YAW, MAIN_COLUMNS[YAW]], RUDDER[3, BY_FORCE] = -2.0, 5.0


class Flight:
    """Ticks with moving surfaces, in slow, strong gusts."""

    def __init__(self, seed: int = 1, places: Layout = LAYOUT, linear: np.ndarray = LINEAR) -> None:
        self.confirmed, self._noise = Confirmation(places), Autoregression(places.rows)
        self._places, self._linear = places, linear
        self.max_age, self.answers = MAX_AGE, np.zeros(3, dtype=bool)
        self._rng, self._gust, self._u = np.random.default_rng(seed), np.zeros(3), np.zeros(4)
        self.restarted = True

    def fly(
        self,
        seconds: float,
        effect: float = 1.0,
        moved: float = 1.0,
        row: int = ROLL,
        gust: float = 0.5,
    ) -> None:
        """Fly with an effect of the row's main surface of `effect` times the estimated one."""
        actual, count = ESTIMATED.copy(), round(seconds / DT)
        actual[row] *= effect
        u, gusts = np.zeros((count, 4)), np.zeros((count, 3))
        for k in range(count):
            self._gust = gusts[k] = 0.9 * self._gust + gust * self._rng.normal(size=3)
            self._u = u[k] = 0.8 * self._u + 0.03 * moved * self._rng.normal(size=4)
        self.add(u, u @ actual.T + gusts)

    def fly_by_rudder(self, seconds: float, moment: float, force: float) -> str:
        """Fly with these shares of the rudder's effects; return the doubt about rdot.

        The side force shows it three times as well as the moment.
        """
        actual, count = self._linear.copy(), round(seconds / DT)
        actual[YAW] *= moment
        actual[3] *= force
        before, moved = self._u[1], self._rng.normal(size=count)
        u, _ = lfilter([0.03], [1.0, -0.8], moved, zi=[0.8 * before])
        f, self._u[1] = np.zeros((count, self._places.size)), u[-1]
        f[:, MAIN_COLUMNS[YAW]], f[:, BY_FORCE] = u, np.diff(u, prepend=before) / DT
        noise = self._rng.normal(size=(count, self._places.rows)) * (0.1, 0.1, 0.1, 0.5, 0.5)
        self._look(f, f @ actual.T + noise, f @ self._linear.T)
        return self.confirmed.doubt(YAW)

    def add(self, u: np.ndarray, measured: np.ndarray, estimated: np.ndarray | None = None) -> None:
        """Add samples: inputs (N, 4), measured and estimated acceleration (N, 3), rad/s^2."""
        f = np.zeros((len(u), self._places.size))
        f[:, INPUT_COLUMNS] = u
        self._look(f, measured, f @ self._linear.T if estimated is None else estimated)

    def _look(self, f: np.ndarray, measured: np.ndarray, estimated: np.ndarray) -> None:
        for k in range(0, len(f), BLOCK):
            own = slice(k, k + BLOCK)
            samples = Regression.of(measured[own], f[own], f[own], DT)
            rows = RowSamples.of(samples, (measured - estimated)[own], self._places)
            white = self._noise.whiten(rows.signals, DT, restarted=self.restarted)
            self.confirmed.add(
                RowSamples(white, DT), self._linear, self._noise.variance, self.max_age,
                self.answers, restarted=self.restarted,
            )  # fmt: skip
            self.restarted = False

    def doubts(self) -> list[str]:
        return [self.confirmed.doubt(row) for row in range(3)]


def test_no_derivative_is_confirmed_before_its_surface_has_moved() -> None:
    assert Flight().doubts() == [
        f"{name} is unconfirmed: {surface} has moved too little of late to exclude half and twice "
        f"of it; move {surface}"
        for name, surface in (("pdot/da", "da"), ("qdot/de", "de"), ("rdot/dr", "dr"))
    ]


@pytest.mark.parametrize(
    ("gust", "max_age", "then", "moved"),
    [(0.5, MAX_AGE, 1.0, 1.0), (0.5, 0.0, 10.0 * MAX_AGE, 0.0), (0.0, MAX_AGE, 1.0, 1.0)],
    ids=["after a gap", "for ever if there is no largest age", "without noise"],
)
def test_surfaces_with_the_estimated_effect_are_confirmed(
    gust: float, max_age: float, then: float, moved: float
) -> None:
    flight = Flight()
    flight.max_age = max_age
    flight.fly(20.0, gust=gust)
    flight.restarted = True
    flight.fly(then, moved=moved, gust=gust)
    assert flight.doubts() == ["", "", ""]


@pytest.mark.parametrize("effect", [-1.0, 0.0], ids=["reversed", "lost"])
@pytest.mark.parametrize("row", [ROLL, PITCH, YAW])
def test_a_failed_surface_is_contradicted_and_no_other(row: int, effect: float) -> None:
    """Ten seconds suffice, even after a long confirmed flight."""
    flight = Flight()
    flight.fly(2.0 * MAX_AGE)
    flight.fly(10.0, effect, row=row)
    surface, axis = ("da", "de", "dr")[row], ("pdot", "qdot", "rdot")[row]
    doubts = flight.doubts()
    assert doubts.pop(row) == (
        f"{axis}/{surface} is contradicted: {axis} does not follow {surface}; check the surface"
    )
    assert doubts == ["", ""]


@pytest.mark.parametrize(
    ("effect", "remark"),
    [
        (0.3, "pdot does not follow da; check the surface"),
        (0.6, "half of it explains pdot better; check the surface"),
        (0.9, ""),
        (1.3, ""),
        (1.7, "twice as much explains pdot better; check the airspeed and the load"),
        (4.0, "twice as much explains pdot better; check the airspeed and the load"),
    ],
)
def test_an_effect_nearer_to_half_or_to_twice_is_contradicted(effect: float, remark: str) -> None:
    flight = Flight()
    flight.fly(60.0)
    flight.fly(60.0, effect)
    expected = f"pdot/da is contradicted: {remark}" if remark else ""
    assert flight.doubts() == [expected, "", ""]


@pytest.mark.parametrize(("scale", "contradicted"), [(1.0, False), (2.0, True)])
def test_twice_the_row_is_contradicted_beside_damping(scale: float, contradicted: bool) -> None:
    """The moment is that of the last changes of the aileron alone."""
    rng, flight, flown = np.random.default_rng(1), Flight(), []
    aileron, gust, u, damped = np.eye(4)[INPUTS.index("da")], np.zeros(3), np.zeros(4), np.zeros(4)
    for _ in range(round(60.0 / DT)):
        damped = damped + 0.5 * (u - damped)
        u = 0.98 * u + 0.01 * rng.normal() * aileron
        gust[ROLL] = 0.9 * gust[ROLL] + 0.1 * rng.normal()
        moment = ESTIMATED @ (u - damped)
        flown.append((u, scale * moment + gust, moment))
    flight.add(*map(np.array, zip(*flown, strict=True)))
    expected = "pdot/da is contradicted: twice all of pdot explains the flight better; "
    expected += "check the airspeed and the load"
    assert flight.doubts()[ROLL] == (expected if contradicted else "")


@pytest.mark.parametrize(("moved", "confirmed"), [(0.06, False), (0.3, True)])
def test_motion_must_tell_an_effect_from_its_half(moved: float, confirmed: bool) -> None:
    """The smaller motion excludes only that the elevator has no effect: 7 and 2 of 4.5 nats."""
    flight = Flight()
    flight.fly(120.0, moved=moved)
    assert (flight.doubts()[PITCH] == "") == confirmed
    assert confirmed or "to exclude half" in flight.doubts()[PITCH]


def test_a_row_without_contradictions_is_unconfirmed_and_a_confirmed_one_stays_so() -> None:
    """Evidence against half and twice stays, that for them goes."""
    flight = Flight()
    flight.fly(120.0)
    flight.fly(60.0, 0.6)
    assert "contradicted: half of it" in flight.doubts()[ROLL]
    flight.confirmed.forget_contradictions(np.array([True, True, False]))
    assert flight.doubts()[ROLL].startswith("pdot/da is unconfirmed")
    assert flight.doubts()[PITCH] == ""


def test_the_confirmation_of_resting_surfaces_ends_at_the_largest_age() -> None:
    flight = Flight()
    flight.fly(60.0)
    flight.fly(0.4 * MAX_AGE, moved=0.0)
    assert flight.doubts() == ["", "", ""]
    flight.fly(0.8 * MAX_AGE, moved=0.0)
    assert all("unconfirmed" in doubt for doubt in flight.doubts())
    flight.fly(20.0)
    assert flight.doubts() == ["", "", ""]


@pytest.mark.parametrize("seed", range(1, 6))
def test_a_disturbance_that_no_surface_explains_contradicts_none(seed: int) -> None:
    """As in a manoeuvre about another axis: sideslip pitches, and the residual is large."""
    flight = Flight(seed)
    flight.fly(60.0)
    for _ in range(20):
        flight.fly(0.5, moved=0.5, gust=15.0)
        assert not any("contradicted" in doubt for doubt in flight.doubts())


@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_answers_to_gusts_within_a_sample_contradict_no_healthy_surface(spread: float) -> None:
    """As of a rate loop much faster than the samples: half of each gust is answered at once.

    The regression's filter spreads a share of each sample over the next.
    """
    rng, flight = np.random.default_rng(1), Flight()
    flight.answers[:] = True
    main = np.array([0, 1, 2]), np.array([INPUTS.index(name) for name in ("da", "de", "dr")])
    gust, command, moved = np.zeros(3), np.zeros(3), np.zeros(3)
    before = np.zeros(4), np.zeros(3)
    for k in range(round(60.0 / DT)):
        new = 0.5 * rng.normal(size=3)
        gust = 0.9 * gust + new
        command = 0.8 * command + 0.3 * rng.normal(size=3)
        moved = 0.8 * moved + command
        u = np.zeros(4)
        u[main[1]] = (moved - 0.5 * new) / ESTIMATED[main]
        now = u, gust
        u, w = ((1.0 - spread) * new + spread * old for new, old in zip(now, before, strict=True))
        before = now
        flight.add(u[None], (ESTIMATED @ u + w)[None])
        learned = k * DT > 10.0  # both models of the past
        assert not (learned and any("contradicted" in doubt for doubt in flight.doubts()))
    assert flight.doubts() == ["", "", ""]


def by_rudder() -> Flight:
    flight = Flight(places=FLOW, linear=RUDDER)
    flight.confirmed.forget_contradictions(np.zeros(4, dtype=bool))  # All effects are known.
    return flight


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_the_side_force_contradicts_a_rudder_sooner_than_its_moment(share: float) -> None:
    flight = by_rudder()
    assert flight.fly_by_rudder(30.0, 1.0, 1.0) == ""
    assert "contradicted" not in flight.fly_by_rudder(2.0, share, 1.0)
    assert flight.fly_by_rudder(20.0, 1.0, 1.0) == ""
    remark = "half of it explains rdot better" if share else "rdot does not follow dr"
    expected = f"rdot/dr is contradicted: {remark}; check the surface"
    assert flight.fly_by_rudder(2.0, share, share) == expected


def test_the_side_force_confirms_no_moment() -> None:
    doubt = by_rudder().fly_by_rudder(60.0, 0.0, 1.0)
    assert doubt.startswith("rdot/dr is contradicted: rdot does not follow dr")


TURN, REST = 3.0, 15.0
"""Duration of a test input on a surface, and of those on the others, s."""
LARGE = 4.0
"""Size of a test input relative to the usual motion."""


def in_turns(seed: int = 1) -> Flight:
    """Fly three test inputs with rests between them; the largest age of a confirmation is 5 s."""
    flight = Flight(seed)
    flight.max_age = 5.0
    for _ in range(3):
        flight.fly(REST, moved=0.0)
        flight.fly(TURN, moved=LARGE)
    return flight


def test_periodic_test_inputs_keep_surfaces_confirmed_until_the_next_is_due() -> None:
    """Few are not: at the end of a test input the evidence may be below its bound by chance."""
    kept = 0
    for seed in range(1, 9):
        flight = in_turns(seed)
        flight.fly(REST + TURN, moved=0.0)
        kept += flight.doubts().count("")
        flight.fly(5.0, moved=0.0)
        assert all("unconfirmed" in doubt for doubt in flight.doubts())
    assert kept >= 20  # of 24


def test_a_test_input_without_effect_contradicts_its_surface() -> None:
    flight = in_turns()
    flight.fly(REST, moved=0.0)
    flight.fly(TURN, 0.0, LARGE, row=PITCH)
    assert [bool(doubt) for doubt in flight.doubts()] == [False, True, False]


def test_only_the_row_that_is_learned_anew_loses_its_confirmation() -> None:
    flight = in_turns()
    flight.confirmed.forget(PITCH)
    doubts = flight.doubts()
    assert doubts[PITCH].startswith("qdot/de is unconfirmed")
    assert [doubts[ROLL], doubts[YAW]] == ["", ""]
    flight.fly(TURN, moved=LARGE)
    flight.fly(8.0, moved=0.0)
    assert [bool(doubt) for doubt in flight.doubts()] == [False, True, False]


@pytest.mark.parametrize("effect", [1.0, 0.33])
def test_a_steady_deflection_confirms_nothing_beside_an_unknown_constant(effect: float) -> None:
    """The constant cancels what a weak surface leaves: the residual is noise, whatever is left."""
    flight, rng, count = in_turns(), np.random.default_rng(1), round(20.0 / DT)
    flight.confirmed.forget(PITCH)
    u, noise = np.full((count, 4), 0.1), 0.5 * rng.normal(size=(count, 3))
    u += 0.002 * rng.normal(size=u.shape)  # answers of an autopilot
    moment = u @ ESTIMATED.T
    moment[:, PITCH] = effect * (moment[:, PITCH] - moment[:, PITCH].mean())
    moment[:, PITCH] += (u @ ESTIMATED.T)[:, PITCH].mean()
    flight.add(u, moment + noise)
    assert flight.doubts()[PITCH].startswith("qdot/de is unconfirmed")
    assert flight.doubts()[YAW] == ""  # a known constant: half of the rudder would show


@pytest.mark.parametrize("deflection", [0.05, 0.07])
def test_a_steady_deflection_does_not_confirm_a_rudder_that_has_jammed(deflection: float) -> None:
    """It turns the aircraft as before, but follows its command no more."""
    flight, rng, count = in_turns(), np.random.default_rng(1), round(60.0 / DT)
    u = np.full((count, 4), deflection)
    jammed = u @ ESTIMATED.T
    u += 0.002 * rng.normal(size=u.shape)  # answers of an autopilot
    flight.add(u, jammed + 0.5 * rng.normal(size=(count, 3)))
    assert flight.doubts()[YAW].startswith("rdot/dr is unconfirmed")
