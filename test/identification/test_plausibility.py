# SPDX-License-Identifier: Apache-2.0
"""Mistakes in how the signals are read are named; what aircraft really do is none."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from equations import matrix
from flying import Message, flight_of, run
from light_aircraft import LightFlight

from uav_ident_ros.identification import plausibility
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.plausibility import Plausibility, coefficient_finding
from uav_ident_ros.identification.settings import Settings, SettingsError
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray
from uav_ident_ros.simulation.inputs import Segment

TICK = 0.05
TRIM = (0.0, 0.0, 0.0, 0.5)


class Signals:
    """Rates, specific force and channels of a flight, FRD, free to be spoilt."""

    def __init__(self, duration: float = 12.0, **spec: Any) -> None:
        peaks = {"de": 0.05, "dr": 0.06, "da": 0.05, "dth": 0.1}
        excitation = spec.pop("excitation", (Segment("multisine", amplitudes=peaks),))
        flight = flight_of(LightFlight(excitation, duration, **{"bank": 20.0, "gust": 0.3, **spec}))
        noise = np.random.default_rng(1)
        self.t = flight.time[::2]
        self.rates = flight.rates[::2] + 0.01 * noise.standard_normal((len(self.t), 3))
        self.force = flight.specific_force[::2] + 0.1 * noise.standard_normal((len(self.t), 3))
        self.actuator_t = (flight.actuator_t_ns - flight.t_ns[0]) * 1e-9
        self.raw = flight.channels()

    def findings(self, **settings: Any) -> Mapping[str, float]:
        """When what was found first, s, by name."""
        looker = Plausibility(settings_of(**settings))
        found: dict[str, float] = {}
        for t in np.arange(TICK, self.t[-1], TICK):
            new = (self.t > t - TICK) & (self.t <= t)
            raw = self.raw[(self.actuator_t > t - TICK) & (self.actuator_t <= t)]
            looker.look(t, np.hstack([self.rates[new], self.force[new]]), raw)
            for finding in looker.findings:
                found.setdefault(finding.name, float(t))
        self.fault = looker.fault
        return found


def settings_of(**changes: Any) -> Settings:
    values: dict[str, Any] = {
        "imu.convention": "frd",
        "actuators.channels": (0, 1, 2, 3),
        "actuators.trim": TRIM,
    }
    values.update({name.replace("__", "."): value for name, value in changes.items()})
    return Settings.from_values(values)


def turned(signals: Signals, matrix: Any) -> Signals:
    turn = np.array(matrix, dtype=float)
    signals.rates, signals.force = signals.rates @ turn.T, signals.force @ turn.T
    return signals


def only(found: Mapping[str, float], name: str, at: float = 4.1) -> None:
    assert list(found) == [name]
    assert found[name] == pytest.approx(at, abs=0.3)


@pytest.mark.parametrize(
    "spec",
    [
        {},
        {"excitation": (), "gust": 0.0, "bank": 0.0},
        {"excitation": (), "gust": 2.0, "bank": 30.0, "duration": 40.0},
        {"excitation": (), "bank": 60.0, "duration": 40.0},
    ],
    ids=["excited", "calm", "storm", "steep turns"],
)
def test_a_flight_raises_no_alarm(spec: dict[str, Any]) -> None:
    signals = Signals(**spec)
    assert signals.findings() == {}


def test_the_wrong_convention_is_named_with_the_right_one() -> None:
    only(Signals().findings(imu__convention="flu"), "mounting")
    looker = Plausibility(settings_of(imu__convention="flu"))
    text = looker._better_mounting(np.array([0.0, 0.0, 1.0]))
    assert text.startswith("imu.convention 'frd' would fit, not 'flu', or the board is mounted")
    assert "[3.14, 0.00, yaw]" in text


@pytest.mark.parametrize(
    ("matrix", "rpy"),
    [
        (np.diag([1, -1, -1]), (math.pi, 0.0, 0.0)),
        ([[0, 0, -1], [0, 1, 0], [1, 0, 0]], (0.0, math.pi / 2, 0.0)),
        ([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], (0.0, -math.pi / 2, 0.0)),
        ([[1, 0, 0], [0, 0, 1], [0, -1, 0]], (math.pi / 2, 0.0, 0.0)),
    ],
    ids=["upside down", "x down", "x up", "on its side"],
)
def test_a_board_mounted_otherwise_is_named_with_the_angles_that_fit(
    matrix: Any, rpy: tuple[float, float, float]
) -> None:
    signals = turned(Signals(), matrix)
    only(signals.findings(), "mounting")
    mean = signals.force.mean(axis=0)
    text = Plausibility(settings_of())._better_mounting(mean / np.linalg.norm(mean))
    assert f"[{rpy[0]:.2f}, {rpy[1]:.2f}, yaw]" in text
    assert signals.findings(imu__rpy=rpy) == {}


def test_free_fall_is_no_wrong_unit() -> None:
    signals = Signals(30.0)
    signals.force[(signals.t > 15.0) & (signals.t < 25.0)] *= 0.1
    assert signals.findings() == {}


def test_a_gyro_in_degrees_is_named() -> None:
    signals = Signals()
    signals.rates *= 180.0 / math.pi
    only(signals.findings(), "gyro units", 7.1)


def test_rolling_and_looping_are_no_wrong_units() -> None:
    t = np.arange(0.0, 20.0, 0.01)
    for axis, rate in ((0, 6.0), (1, 2.5)):
        signals = Signals()
        signals.t, rates = t, np.zeros((len(t), 3))
        rates[:, axis] = rate * (t > 8.0)
        angle = np.cumsum(rates[:, axis]) * 0.01
        # on average the force carries the weight, whatever the attitude; in a loop it pulls too
        gravity = [np.zeros_like(t), -np.sin(angle), -np.cos(angle)]
        if axis == 1:
            gravity = [np.sin(angle), np.zeros_like(t), -np.cos(angle)]
        signals.rates, signals.force = rates, 9.81 * np.stack(gravity, axis=1)
        signals.force[:, 2] -= 15.0 * (t > 8.0) * (axis == 1)
        assert signals.findings() == {}, axis


@pytest.mark.parametrize(
    ("factor", "words"), [(1.0 / 9.80665, "looks like g"), (100.0 / 9.80665, "milli-g")]
)
def test_a_force_in_other_units_is_named(factor: float, words: str) -> None:
    signals = Signals()
    signals.force *= factor
    only(signals.findings(), "force size")
    assert words in signals.fault


def test_an_accelerometer_that_repeats_itself_is_none() -> None:
    for value in (0.0, -9.81):
        signals = Signals()
        signals.force[:] = [0.0, 0.0, value]
        assert signals.findings() == {}


def test_trim_in_degrees_is_named() -> None:
    only(Signals().findings(actuators__trim=(2.0, 0.0, 0.0, 0.5)), "trim")


def test_pulse_widths_are_named_and_well_mapped_ones_are_not() -> None:
    signals = Signals()
    signals.raw = 1500.0 + 500.0 * signals.raw
    only(signals.findings(actuators__trim=()), "channel range")
    signals.raw[signals.actuator_t < 6.0] = 0.0  # not armed
    trim, scale = (1500.0, 1500.0, 1500.0, 1750.0), (0.002,) * 4
    assert signals.findings(actuators__trim=trim, actuators__scale=scale) == {}


def test_degrees_are_a_warning() -> None:
    signals = Signals()
    signals.raw *= 180.0 / math.pi
    only(signals.findings(actuators__trim=()), "channel range")
    assert signals.fault == ""


@pytest.mark.parametrize("every", [1, 4])
def test_two_publishers_are_named(every: int) -> None:
    signals = Signals()
    index = np.arange(0, len(signals.raw), every)
    signals.raw = np.insert(signals.raw, index, np.array(TRIM) + 0.2, axis=0)
    signals.actuator_t = np.insert(signals.actuator_t, index, signals.actuator_t[index] - 0.005)
    only(signals.findings(), "publishers")


def test_noisy_commands_and_pulses_are_no_second_publisher() -> None:
    rng = np.random.default_rng(2)
    signals = Signals(40.0)
    signals.raw += 0.1 * rng.standard_normal(signals.raw.shape)
    assert signals.findings() == {}
    pulses = Segment("3211", amplitudes={"de": 0.05, "da": 0.05, "dr": 0.1}, unit=0.1)
    assert Signals(40.0, excitation=(pulses,)).findings() == {}


STRUCTURE = STRUCTURES["augmented"]


def coefficients(**changes: float) -> FloatArray:
    values = {"pdot_da": 45.0, "pdot_dr": 3.0, "qdot_de": -30.0, "rdot_dr": -9.0, "rdot_da": -1.5}
    named = {name.replace("_", "/"): value for name, value in {**values, **changes}.items()}
    return matrix(STRUCTURE, named)


def test_reversed_and_swapped_channels_are_named_once_that_is_sure() -> None:
    expected = ("+pdot/da", "-rdot/dr")
    swapped = {"pdot_da": 3.0, "pdot_dr": 45.0, "rdot_dr": -1.5, "rdot_da": -9.0}
    for changes, sigma, name in (
        ({}, 1.0, None),
        ({"pdot_da": -45.0}, 1.0, "signs"),
        ({"pdot_da": -45.0}, 10.0, "signs"),
        ({"pdot_da": -45.0}, 16.0, None),
        ({"rdot_dr": 9.0}, 1.0, "signs"),
        (swapped, 1.0, "swapped"),
        (swapped, 9.0, "swapped"),
        (swapped, 11.0, None),
        ({"pdot_dr": 60.0}, 1.0, None),  # a rudder that rolls, and yaws as a rudder does
    ):
        spread = np.full(STRUCTURE.mask.shape, sigma)
        found = coefficient_finding(STRUCTURE, coefficients(**changes), spread, expected)
        assert (found.name if found else None) == name, (changes, sigma)


def test_a_doubt_stays_until_it_is_the_less_likely() -> None:
    """Three sigma raise it; evidence that dips below them does not begin it anew."""
    looker, nothing = Plausibility(settings_of(structure="augmented")), np.zeros((0, 6))
    swapped = coefficients(pdot_da=3.0, pdot_dr=45.0, rdot_dr=-1.5, rdot_da=-9.0)
    for t, values, sigma, named_ in (
        (1.0, swapped, 9.0, []),
        (3.0, swapped, 15.0, []),
        (5.5, swapped, 9.0, ["swapped"]),
        (6.0, coefficients(), 9.0, []),
        (7.0, swapped, 15.0, []),
        (12.0, swapped, 15.0, []),
        (13.0, swapped, 9.0, []),
        (18.0, swapped, 15.0, []),  # once is chance: nobody is accused by what may be noise
        (18.5, swapped, 9.0, ["swapped"]),
        (25.0, swapped, 50.0, ["swapped"]),
    ):
        looker.look(t, nothing, nothing[:, :4])
        looker.judge(values, np.full(STRUCTURE.mask.shape, sigma))
        assert [finding.name for finding in looker.findings] == named_, t


def test_a_reversed_surface_is_named_with_the_evidence_by_which_it_was_sure() -> None:
    expected, nothing = ("+pdot/da",), np.zeros((0, 6))
    given = {"structure": "augmented", "supervision__expected_signs": expected}
    looker = Plausibility(settings_of(**given))
    for t, sigma in ((1.0, 3.0), (6.0, 4.0), (7.0, 400.0)):
        looker.look(t, nothing, nothing[:, :4])
        looker.judge(coefficients(pdot_da=-45.0), np.full(STRUCTURE.mask.shape, sigma))
    assert looker.fault.startswith("pdot/da is -45 +- 4, expected is +")


def test_an_unknown_expected_sign_is_refused() -> None:
    for entry in ("pdot/da", "+pdot/dx", "*pdot/da", ""):
        with pytest.raises(SettingsError, match="write \\+ or -"):
            settings_of(supervision__expected_signs=(entry,))


def named(finding: plausibility.Finding | None) -> str | None:
    return None if finding is None else finding.name


def test_the_mean_tilt_from_which_the_imu_is_mounted_otherwise() -> None:
    for tilt, found in ((55.0, None), (65.0, "mounting")):
        looker, angle = Plausibility(settings_of()), math.radians(tilt)
        looker._follow(9.81 * np.array([[math.sin(angle), 0.0, -math.cos(angle)]]), 5.0)
        assert named(looker._mounting()) == found


def test_how_long_an_aircraft_may_fly_inverted() -> None:
    looker = Plausibility(settings_of())
    for _ in range(200):
        looker._follow(np.array([[0.0, 0.0, -9.81]]), 1.0)
    inverted = 0
    while looker._mounting() is None:
        looker._follow(np.array([[0.0, 0.0, 9.81]]), 1.0)
        inverted += 1
    assert 110 <= inverted <= 120  # a minute's memory turned to 0.7 the other way


def test_the_mean_size_that_a_specific_force_can_have() -> None:
    for size, found in ((3.5, "force size"), (4.5, None), (55.0, None), (65.0, "force size")):
        looker = Plausibility(settings_of())
        looker._follow(np.array([[0.0, 0.0, -size]]), 5.0)
        assert named(looker._size()) == found, size


def test_what_a_gyro_may_turn_of_gravity() -> None:
    """Rolling to and fro by `angle` rad leaves J0(angle) of gravity: 0.6 and 0.8 here."""
    t = np.arange(0.0, 8.0, 0.05)
    force = np.tile([0.0, 0.0, -9.80665], (len(t), 1))
    for angle, speed, found in (
        (1.35, 5.0, "gyro units"), (0.95, 5.0, None), (1.6, 0.6, "gyro units"), (1.6, 0.4, None)
    ):  # fmt: skip
        omega, rates = speed * math.pi / 2.0 / angle, np.zeros((len(t), 3))
        rates[:, 0] = angle * omega * np.cos(omega * t)
        assert named(Plausibility(settings_of())._gyro_units(t, rates, force)) == found
    assert plausibility._gravity_left(t, np.zeros_like(rates), force) == pytest.approx(1.0)


@pytest.mark.parametrize(("speed", "found"), [(30.0, "gyro units"), (60.0, None)])
def test_who_pulls_much_did_not_turn_slowly(speed: float, found: str | None) -> None:
    """A quadrotor in aerobatics: thrust along its own axis, one g on average, far from steady."""
    t = np.arange(0.0, 8.0, 0.05)
    rates, force = np.zeros((len(t), 3)), np.tile([0.0, 0.0, -9.80665], (len(t), 1))
    rates[:, 0] = 3.0
    force[:, 2] -= math.sqrt(2.0) * speed * math.radians(3.0) * np.sin(7.0 * math.pi * t)
    assert named(Plausibility(settings_of())._gyro_units(t, rates, force)) == found


def test_the_ranges_of_an_input() -> None:
    sway = 0.05 * np.sin(np.arange(100))

    def found(u: np.ndarray, without_trim: np.ndarray) -> list[tuple[str, bool]]:
        return [(f.name, f.fault) for f in plausibility._off_range("de", u, without_trim)]

    for offset, trim in ((0.5, []), (0.7, [("trim", True)])):
        assert found(offset + sway, sway) == trim
        assert found(offset + sway, offset + sway + 0.2) == []
    for middle, counts in ((80.0, []), (120.0, [("channel range", True)])):
        assert found(middle + sway, middle + sway) == counts
    for largest, degrees in ((2.9, []), (3.5, [("channel range", False)]), (120.0, [])):
        u = largest * np.sin(np.arange(100))
        assert found(u, u) == degrees


def test_what_makes_two_streams_of_one() -> None:
    k = np.arange(200)
    for u, found in (
        (0.015 * (k % 2), None),
        (0.03 * (k % 2), "publishers"),
        (0.06 * (k % 2) + 0.01 * k, None),
        (0.08 * (k % 2) + 0.01 * k, "publishers"),
        (1.0 * (k % 14 == 0), None),
        (1.0 * (k % 7 == 0), "publishers"),
    ):
        assert named(plausibility._interleaved("de", u)) == found
    # a wobble at half the rate of slow inputs looks the same
    for count, found in ((64, 0), (96, 4)):
        looker = Plausibility(settings_of())
        raw = np.tile([[0.0] * 4, [1.0] * 4], (count // 2, 1))
        for t, part in ((0.5, raw[:2]), (4.5, raw[2:])):
            looker.look(t, np.zeros((0, 6)), part)
        assert len(looker.noted) == min(found, 1)


def flown(signals: Signals, **settings: Any) -> list[Any]:
    rates = zip(signals.t, np.hstack([signals.rates, signals.force]).tolist(), strict=True)
    inputs = zip(signals.actuator_t, signals.raw.tolist(), strict=True)
    stream = [
        Message(0, name, 10**18 + round(t * 1e9), tuple(values))
        for name, samples in (("rates", rates), ("actuators", inputs))
        for t, values in samples
    ]
    identifier = OnlineIdentifier(settings_of(**settings))
    return run(identifier, sorted(stream, key=lambda message: (message.t_ns, message.stream)))


def test_a_fault_stops_learning_and_says_why_but_can_be_switched_off() -> None:
    estimates = flown(Signals(10.0), imu__convention="flu", supervision__plausibility=False)
    assert estimates[-1].state != "fault"
    estimates = flown(Signals(10.0), imu__convention="flu")
    late = [e for e in estimates if e.t_ns > 10**18 + 6 * 10**9]
    assert all(e.state == "fault" and not e.usable and not e.adapting for e in late)
    assert "imu.convention 'frd' would fit" in late[0].reason
    np.testing.assert_array_equal(late[0].coefficients, late[-1].coefficients)


def test_a_reversed_channel_is_never_usable() -> None:
    reversed_ = (0.0, 0.0, -1.0, 0.0)
    estimates = flown(
        Signals(40.0),
        actuators__mixing__da=reversed_,
        supervision__expected_signs=("+pdot/da",),
    )
    known = [e for e in estimates if e.t_ns > 10**18 + 10 * 10**9]
    assert all(e.state == "fault" and not e.usable for e in known)
    assert "pdot/da is -" in known[-1].reason


def test_evidence_is_held_and_then_forgotten() -> None:
    signals = Signals(60.0)
    both = signals.actuator_t < 15.0
    index = np.flatnonzero(both)
    signals.raw = np.insert(signals.raw, index, np.array(TRIM) + 0.2, axis=0)
    signals.actuator_t = np.insert(signals.actuator_t, index, signals.actuator_t[index] - 0.005)
    looker, alarms = Plausibility(settings_of()), []
    for t in np.arange(TICK, 60.0, TICK):
        raw = signals.raw[(signals.actuator_t > t - TICK) & (signals.actuator_t <= t)]
        looker.look(t, np.zeros((0, 6)), raw)
        alarms.append(bool(looker.fault))
    after = np.flatnonzero(alarms) * TICK
    assert after[0] < 6.0
    # 4 s in which they are still looked at, and 30 s in which they are remembered
    assert after[-1] == pytest.approx(15.0 + 4.0 + 30.0, abs=1.5)
    assert list(looker.noted) == ["publishers"]
