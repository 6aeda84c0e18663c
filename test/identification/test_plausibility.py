# SPDX-License-Identifier: Apache-2.0
"""Mistakes in how the signals are read are named; what aircraft really do is none."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from equations import matrix
from flying import PEAKS, flight_of, identified, light_errors, light_measured, since
from light_aircraft import LightFlight
from verdict_flights import MISTAKES

from uav_ident_ros.identification.delay import DelayEstimate
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.frames import rotation
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.plausibility import (
    Plausibility,
    SetupErrors,
    coefficient_finding,
)
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray
from uav_ident_ros.simulation.inputs import Segment

TICK = 0.05
G = 9.80665


@dataclass
class Signals:
    """Rates, specific force and channels, FRD."""

    t: FloatArray
    rates: FloatArray
    force: FloatArray
    actuator_t: FloatArray
    raw: FloatArray
    fault: str = ""

    def findings(self, **settings: Any) -> list[str]:
        """What is found, in the order in which it is; what is only a warning ends in a `?`."""
        looker = Plausibility(settings_of(**settings))
        found: dict[str, None] = {}
        for t in np.arange(TICK, self.t[-1] + 0.5 * TICK, TICK):
            new = (self.t > t - TICK) & (self.t <= t)
            raw = self.raw[(self.actuator_t > t - TICK) & (self.actuator_t <= t)]
            looker.look(t, np.hstack([self.rates[new], self.force[new]]), raw)
            found |= dict.fromkeys(f.name + "?" * (not f.fault) for f in looker.findings)
        self.fault = looker.fault
        return list(found)


def flown(duration: float = 12.0, **spec: Any) -> Signals:
    """The signals of a flight."""
    excitation = spec.pop("excitation", (Segment("multisine", amplitudes=PEAKS),))
    flight = flight_of(LightFlight(excitation, duration, **{"bank": 20.0, "gust": 0.3, **spec}))
    noise, t = np.random.default_rng(1), flight.time[::2]
    rates = flight.rates[::2] + 0.01 * noise.standard_normal((len(t), 3))
    force = flight.specific_force[::2] + 0.1 * noise.standard_normal((len(t), 3))
    actuator_t = (flight.actuator_t_ns - flight.t_ns[0]) * 1e-9
    return Signals(t, rates, force, actuator_t, flight.channels())


def settings_of(**changes: Any) -> Settings:
    values: dict[str, Any] = {
        "imu.convention": "frd",
        "actuators.channels": (0, 1, 2, 3),
        "actuators.trim": (0.0, 0.0, 0.0, 0.5),
    }
    values.update({name.replace("__", "."): value for name, value in changes.items()})
    return Settings.from_values(values)


@pytest.mark.parametrize(
    "spec",
    [
        {},
        {"excitation": (), "gust": 0.0, "bank": 0.0},
        {"excitation": (), "gust": 2.0, "bank": 30.0, "duration": 40.0},
        {"excitation": (), "bank": 60.0, "duration": 40.0},
        {
            "excitation": (
                Segment("3211", amplitudes={"de": 0.05, "da": 0.05, "dr": 0.1}, unit=0.1),
            )
        },
    ],
    ids=["excited", "calm", "storm", "steep turns", "pulses"],
)
def test_a_flight_raises_no_alarm(spec: dict[str, Any]) -> None:
    assert flown(**spec).findings() == []


@pytest.mark.parametrize(("name", "spoil", "values", "words"), MISTAKES)
def test_a_mistake_is_named_within_ten_seconds_and_never_usable(
    name: str, spoil: Any, values: dict[str, Any], words: str
) -> None:
    """Those of the campaign, benchmarks/false_usable.py."""
    m = light_measured(40.0, start=0.0)
    _, estimates = identified(m if spoil is None else spoil(m), **values)
    assert any(re.search(words, e.reason) for e in since(estimates, 0.0, 10.0))
    assert not any(e.usable for e in estimates)


def test_a_fault_stops_learning_but_can_be_switched_off() -> None:
    m, wrong = light_measured(40.0, start=0.0), {"imu__convention": "frd"}
    first, *others = since(identified(m, **wrong)[1], 10.0, 40.0)
    assert all(e.state == "fault" and not e.adapting for e in others)
    np.testing.assert_array_equal(first.coefficients, others[-1].coefficients)
    _, estimates = identified(m, **wrong, supervision__plausibility=False)
    assert estimates[-1].state != "fault"


@pytest.mark.parametrize(
    "rpy",
    [(math.pi, 0.0), (0.0, math.pi / 2), (0.0, -math.pi / 2), (math.pi / 2, 0.0)],
    ids=["upside down", "x down", "x up", "on its side"],
)
def test_a_board_mounted_otherwise_is_named_with_the_angles_that_fit(
    rpy: tuple[float, float],
) -> None:
    signals, turned = flown(), rotation(*rpy, 0.0)
    signals.rates, signals.force = signals.rates @ turned, signals.force @ turned
    assert signals.findings() == ["mounting"]
    assert f"[{rpy[0]:.2f}, {rpy[1]:.2f}, yaw]" in signals.fault
    assert signals.findings(imu__rpy=[*rpy, 0.0]) == []


# --- where the borders are ----------------------------------------------------------------------


def plain(
    force: Any = -G, rates: Any = 0.0, de: Any = 0.0, rate: float = 50.0, noise: float = 1e-6
) -> Signals:
    """Nothing but a force down or of three parts, a roll or three rates, an elevator.

    Numbers, or functions of the time or, the elevator, of the sample.
    """
    t, samples = np.arange(TICK, 20.0, TICK), np.arange(round(20.0 * rate))
    forces = noise * np.random.default_rng(1).standard_normal((len(t), 3))
    turned, raw = np.zeros((len(t), 3)), np.zeros((len(samples), 4))
    for target, given, at, own in (
        (forces, force, t, 2), (turned, rates, t, 0), (raw, de, samples, 0)
    ):  # fmt: skip
        values = np.asarray(given(at) if callable(given) else given)
        target[:, slice(None) if values.shape[-1:] == (3,) else own] += values
    return Signals(t, turned, forces, samples / rate, raw)


def tilted(degrees: float) -> Signals:
    angle = math.radians(degrees)
    return plain([G * math.sin(angle), 0.0, -G * math.cos(angle)])


def rolling_to_and_fro(angle: float, speed: float) -> Signals:
    """A mean rate of `speed` rad/s in a constant force: J0(angle) is left of gravity."""
    omega = speed * math.pi / 2.0 / angle
    return plain(rates=lambda t: angle * omega * np.cos(omega * t))


def pulling(speed: float) -> Signals:
    """A quadrotor in aerobatics: thrust along its own axis, one g on average, far from steady."""
    pull = math.sqrt(2.0) * speed * math.radians(3.0)
    return plain(lambda t: -G - pull * np.sin(7.0 * math.pi * t), rates=3.0)


def turning(axis: int, rate: float) -> Signals:
    """Rolls, or loops that pull: on average the force carries the weight."""

    def force(t: FloatArray) -> FloatArray:
        angle, zero = np.cumsum(rate * (t > 8.0)) * TICK, 0.0 * t
        along = (zero, -np.sin(angle)) if axis == 0 else (np.sin(angle), zero)
        return G * np.stack([*along, -np.cos(angle) - 1.5 * axis * (t > 8.0)], axis=1)

    return plain(force, lambda t: np.outer(rate * (t > 8.0), np.eye(3)[axis]))


def swaying(middle: float) -> Signals:
    return plain(de=lambda k: middle + 0.05 * np.sin(k))


def switching(step: float, drift: float = 0.0, every: int = 2, rate: float = 50.0) -> Signals:
    """An input that leaves its place for a sample, again and again."""
    return plain(de=lambda k: step * (k % every == every - 1) + drift * (k % 300), rate=rate)


def pulse_widths(k: FloatArray) -> FloatArray:
    """Of an elevator that is not armed at first."""
    return (1500.0 + 25.0 * np.sin(k)) * (k > 300)


def trim(elevator: float) -> dict[str, Any]:
    return {"actuators__trim": (elevator, 0.0, 0.0, 0.0)}


MAPPED = trim(1500.0) | {"actuators__scale": (0.002, 1.0, 1.0, 1.0)}
LEARNED = {"actuators__learn_trim_time": 2.0, "actuators__trim": ()}
BORDERS: list[tuple[str, Callable[[], Signals], dict[str, Any]]] = [
    # what is found, words of it, in which signals, read how
    ("", lambda: tilted(55.0), {}),
    ("mounting", lambda: tilted(65.0), {}),
    ("", lambda: plain(lambda t: np.where((t > 8.0) & (t < 18.0), -0.1 * G, -G)), {}),  # free fall
    ("force size: looks like g", lambda: plain(-1.0), {}),
    ("force size: looks like g", lambda: plain(-3.5), {}),
    ("", lambda: plain(-4.5), {}),
    ("", lambda: plain(-55.0), {}),
    ("force size: milli-g", lambda: plain(-65.0), {}),
    ("", lambda: plain(0.0, noise=0.0), {}),  # an accelerometer that repeats itself is none
    ("", lambda: plain([-9.81, 0.0, 0.0], noise=0.0), {}),
    ("gyro units", lambda: rolling_to_and_fro(1.35, 5.0), {}),  # 0.6 of gravity is left
    ("", lambda: rolling_to_and_fro(0.95, 5.0), {}),  # 0.8
    ("gyro units", lambda: rolling_to_and_fro(1.6, 0.6), {}),
    ("", lambda: rolling_to_and_fro(1.6, 0.4), {}),
    ("gyro units", lambda: pulling(30.0), {}),
    ("", lambda: pulling(60.0), {}),
    ("", lambda: turning(0, 6.0), {}),
    ("", lambda: turning(1, 2.5), {}),
    ("", lambda: swaying(0.0), trim(-0.5)),
    ("trim", lambda: swaying(0.0), trim(-0.7)),
    ("", lambda: swaying(0.9), trim(0.2)),  # as far from no trim as from this one
    ("", lambda: swaying(170.0), {}),
    ("channel range", lambda: swaying(190.0), {}),
    ("", lambda: plain(de=pulse_widths), MAPPED),
    ("", lambda: plain(de=lambda k: 2.9 * np.sin(k)), {}),
    ("channel range?", lambda: plain(de=lambda k: 3.5 * np.sin(k)), {}),  # degrees, a warning
    ("", lambda: plain(de=lambda k: 3.0 + 0.4 * np.sin(k)), LEARNED),  # pulse widths of 1500 us
    ("channel range?", lambda: plain(de=lambda k: 3.0 + 3.5 * np.sin(k)), LEARNED),
    ("", lambda: plain(de=lambda k: 190.0 * np.sin(k)), {}),
    ("", lambda: plain(de=lambda k: 0.1 * np.random.default_rng(2).normal(size=len(k))), {}),
    ("", lambda: switching(0.015), {}),
    ("publishers", lambda: switching(0.03), {}),
    ("", lambda: switching(0.06, 0.01), {}),
    ("publishers", lambda: switching(0.08, 0.01), {}),
    ("", lambda: switching(1.0, every=14), {}),
    ("publishers", lambda: switching(1.0, every=7), {}),
    # a wobble at half the rate of slow inputs looks the same
    ("", lambda: switching(1.0, rate=16.0), {}),
    ("publishers", lambda: switching(1.0, rate=24.0), {}),
]


@pytest.mark.parametrize("number", range(len(BORDERS)))
def test_the_border_between_a_mistake_and_what_may_be(number: int) -> None:
    found, make, read = BORDERS[number]
    name, _, words = found.partition(": ")
    signals = make()
    assert signals.findings(**(trim(0.0) | read)) == [name] * bool(name)
    assert words in signals.fault


def test_how_long_an_aircraft_may_fly_inverted() -> None:
    looker, nothing = Plausibility(settings_of()), np.zeros((0, 4))
    inverted = 0
    for t in range(1, 400):
        force = np.array([0.0, 0.0, -G if t <= 200 else G]) + 1e-6 * (t % 2)
        looker.look(float(t), np.append(np.zeros(3), force)[None], nothing)
        inverted += t > 200 and not looker.fault
    assert 110 <= inverted <= 120  # a minute's memory turned to 0.7 the other way


def test_evidence_is_held_and_then_forgotten() -> None:
    """Though the Imu has fallen silent."""
    looker, alarms = Plausibility(settings_of()), []
    for t in np.arange(TICK, 60.0, TICK):
        raw = np.array([[0.0] * 4, [0.2 * (t < 15.0)] * 4])
        motion = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, -G + 1e-6 * t]])
        looker.look(t, motion[: int(t < 2.0)], raw)
        alarms.append(bool(looker.fault))
    after = np.flatnonzero(alarms) * TICK
    assert after[0] < 6.0
    # 4 s in which they are still looked at, and 30 s in which they are remembered
    assert after[-1] == pytest.approx(15.0 + 4.0 + 30.0, abs=1.5)
    assert list(looker.noted) == ["publishers"]


# --- what the coefficients say ------------------------------------------------------------------

STRUCTURE = STRUCTURES["augmented"]


RIGHT = {"pdot/da": 45.0, "pdot/dr": 3.0, "qdot/de": -30.0, "rdot/dr": -9.0, "rdot/da": -1.5}
SWAPPED = RIGHT | {"pdot/da": 3.0, "pdot/dr": 45.0, "rdot/dr": -1.5, "rdot/da": -9.0}
REVERSED = RIGHT | {"pdot/da": -45.0}


@pytest.mark.parametrize(
    ("values", "sigma", "name"),
    [
        (RIGHT, 1.0, None),
        (REVERSED, 1.0, "signs"),
        (REVERSED, 10.0, "signs"),
        (REVERSED, 16.0, None),
        (RIGHT | {"rdot/dr": 9.0}, 1.0, "signs"),
        (SWAPPED, 1.0, "swapped"),
        (SWAPPED, 9.0, "swapped"),
        (SWAPPED, 11.0, None),
        (RIGHT | {"pdot/dr": 60.0}, 1.0, None),  # a rudder that rolls, and yaws as a rudder does
    ],
)
def test_reversed_and_swapped_channels_are_named_once_that_is_sure(
    values: dict[str, float], sigma: float, name: str | None
) -> None:
    spread = np.full(STRUCTURE.mask.shape, sigma)
    expected = ("+pdot/da", "-rdot/dr")
    found = coefficient_finding(STRUCTURE, matrix(STRUCTURE, values), spread, expected)
    assert (found.name if found else None) == name


class Learning:
    """What is told of an aircraft by what is learned of it."""

    def __init__(self, **given: Any) -> None:
        expected = {"supervision__expected_signs": ("+pdot/da",)}
        self.looker = Plausibility(settings_of(structure="augmented", **expected, **given))

    def found(self, t: float, values: dict[str, float], sigma: float) -> list[str]:
        """What is found at a time by what was learned until then."""
        nothing = np.zeros((0, 6))
        self.looker.look(t, nothing, nothing[:, :4])
        self.looker.judge(matrix(STRUCTURE, values), np.full(STRUCTURE.mask.shape, sigma))
        return [finding.name for finding in self.looker.findings]


QUAD = {  # four motors, which lift it and turn it
    "actuators__mixing__de": (0.25, 0.25, -0.25, -0.25),
    "actuators__mixing__da": (0.25, -0.25, -0.25, 0.25),
    "actuators__mixing__dr": (0.25, -0.25, 0.25, -0.25),
    "actuators__mixing__dth": (0.25,) * 4,
}


@pytest.mark.parametrize(
    ("given", "swapped", "reversed_"),
    [
        ({}, "rudder and aileron are swapped", "a surface is connected the wrong way round"),
        (QUAD, "yaw and roll inputs are swapped", "a motor is connected the wrong way round"),
    ],
)
def test_a_multirotor_has_no_surfaces(given: dict[str, Any], swapped: str, reversed_: str) -> None:
    for values, words in ((SWAPPED, swapped), (REVERSED, reversed_)):
        learning = Learning(**given)
        for t in (1.0, 6.0):
            learning.found(t, values, 1.0)
        assert words in learning.looker.fault


def test_a_doubt_stays_until_it_is_the_less_likely() -> None:
    """Three sigma raise it; evidence that dips below them does not begin it anew."""
    learning = Learning()
    for t, values, sigma, named in (
        (1.0, SWAPPED, 9.0, []),
        (3.0, SWAPPED, 15.0, []),
        (5.5, SWAPPED, 9.0, ["swapped"]),
        (6.0, RIGHT, 9.0, []),
        (7.0, SWAPPED, 15.0, []),
        (12.0, SWAPPED, 15.0, []),
        (13.0, SWAPPED, 9.0, []),
        (18.0, SWAPPED, 15.0, []),  # once is chance: nobody is accused by what may be noise
        (18.5, SWAPPED, 9.0, ["swapped"]),
        (25.0, SWAPPED, 50.0, ["swapped"]),
    ):
        assert learning.found(t, values, sigma) == named, t


def test_a_reversed_surface_is_named_with_the_evidence_by_which_it_was_sure() -> None:
    learning = Learning()
    for t, sigma in ((1.0, 3.0), (6.0, 4.0), (7.0, 400.0)):
        learning.found(t, REVERSED, sigma)
    assert learning.looker.fault.startswith("pdot/da is -45 +- 4, expected is +")


# --- settings that are off by a little ----------------------------------------------------------


@cache
def with_an_imu_at(height: float, told: float) -> tuple[OnlineIdentifier, Estimate]:
    """Return an identifier after an excited flight with the Imu above the centre of gravity, m."""
    m = light_measured(40.0, sensors={"lever_arm": (0.0, 0.0, -height)})
    identifier, (*_, last) = identified(m, imu__lever_arm=[0.0, 0.0, -told])
    return identifier, last


@pytest.mark.parametrize("height", [0.1, -0.1])
def test_the_height_of_the_imu_is_found_and_sigma_covers_what_it_does(height: float) -> None:
    identifier, last = with_an_imu_at(height, 0.0)
    index = identifier.structure.index("pdot/da")
    share, sigmas = light_errors(last, "pdot/da")
    assert identifier.estimator.height == pytest.approx(height, abs=0.02)
    assert last.sigma[index] > 1.5 * identifier.estimator.sigma[index]
    assert share > 0.15 and sigmas < 2.0


def test_sigma_covers_what_a_lag_takes_from_an_input_where_nothing_damps() -> None:
    structure = STRUCTURES["flight_dynamics"]
    values, rudder = np.zeros((5, structure.size)), structure.index("rdot/dr")
    values[rudder] = -9.0
    sure = DelayEstimate(delay=0.1, sigma=0.01, rise=9.0, hidden=0.1)
    lost, setup = np.array([0.0, 0.3, 0.0, 0.0]), SetupErrors(structure, 20.0)
    setup.look(values, sure, 0.1, 0.0, lambda: lost, 0.0, lag_is_configured=False)
    assert setup.widened(np.full(values.shape, 0.1))[rudder] == pytest.approx(2.7, rel=0.01)
    assert "servo lag are not separated" in setup.denied(values, 4.0)[2]
    setup.look(values, sure, 0.1, 0.0, lambda: lost, 0.0, lag_is_configured=True)
    assert setup.widened(np.full(values.shape, 0.1))[rudder] == 0.1


def test_where_the_sum_is_told_a_lag_counts_to_second_order() -> None:
    """Beside it counts, to first order, what the delay in use misses of the sum."""
    structure = STRUCTURES["flight_dynamics"]
    values, rudder, damping = np.zeros((5, structure.size)), structure.index("rdot/dr"), 5.0
    values[rudder], values[structure.index("rdot/r")] = -9.0, -damping
    told = DelayEstimate(0.03, 0.01, 0.03, 0.01, 9.0, 0.02, lag_sigma=0.02, hidden=0.04)
    for total, missed in ((0.03, 0.0), (0.05, 0.02), (0.01, -0.02)):
        setup = SetupErrors(structure, 20.0)
        estimate = replace(told, total=total)
        setup.look(values, estimate, 0.03, 0.0, lambda: np.zeros(4), 0.0, lag_is_configured=False)
        share = damping * abs(missed) + 0.5 * (damping * told.hidden) ** 2
        widened = setup.widened(np.full(values.shape, 1e-6))[rudder]
        assert widened == pytest.approx(9.0 * share, rel=1e-3)


def test_a_height_that_is_told_is_none_that_is_off() -> None:
    identifier, last = with_an_imu_at(0.3, 0.3)
    assert identifier.estimator.height == 0.0
    assert last.usable, last.reason


def test_no_roll_that_a_height_falsifies_by_a_quarter_is_usable() -> None:
    _, last = with_an_imu_at(-0.3, 0.0)
    assert not last.usable_rows[0]
    assert "m below where 'imu.lever_arm' puts it" in last.reason


@pytest.mark.parametrize(("delay", "denied"), [(-0.012, False), (-0.025, True)])
def test_inputs_that_act_before_they_are_given_deny_the_lag_in_use(
    delay: float, denied: bool
) -> None:
    """As little as the delay is off, all of the lag may not be there."""
    structure = STRUCTURES["flight_dynamics"]
    values, roll, lag = np.zeros((5, structure.size)), structure.index("pdot/da"), 0.06
    values[roll], values[structure.index("pdot/p")] = 60.0, -10.0
    estimate, setup = DelayEstimate(delay, 0.01, rise=9.0), SetupErrors(structure, 20.0)
    setup.look(values, estimate, 0.0, lag, lambda: np.zeros(4), 0.0, lag_is_configured=True)
    assert ("lower 'actuators.time_constant'" in setup.denied(values, 4.0)[0]) == denied
    widened = setup.widened(np.full(values.shape, 1e-6))[roll]
    assert widened > 60.0 * 10.0 * abs(delay) if denied else widened < 0.1 * 60.0
