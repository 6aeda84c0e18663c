# SPDX-License-Identifier: Apache-2.0
"""Plausibility: wrong settings of the signals are named, and usual flights raise no fault."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from equations import matrix
from flying import identified, light_errors, light_measured, messages, since
from verdict_flights import MISTAKES

from uav_ident_ros.identification.delay import DelayEstimate
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.frames import rotation
from uav_ident_ros.identification.gyro import HYPOTHESES, GyroFilters, WrongAxes
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.plausibility import Plausibility, SetupErrors, sign_finding
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
        """Return the names of the findings in their order; `?` marks a warning."""
        checks = Plausibility(settings_of(**settings))
        found: dict[str, None] = {}
        for t in np.arange(TICK, self.t[-1] + 0.5 * TICK, TICK):
            new = (self.t > t - TICK) & (self.t <= t)
            raw = self.raw[(self.actuator_t > t - TICK) & (self.actuator_t <= t)]
            checks.look(t, np.hstack([self.rates[new], self.force[new]]), raw)
            found |= dict.fromkeys(f.name + "?" * (not f.fault) for f in checks.findings)
        self.fault = checks.fault
        return list(found)


def flown(seconds: float = 12.0, **flight: Any) -> Signals:
    """The signals of a flight, with noise."""
    m = light_measured(seconds, **{"bank": 20.0, "sensors": {"convention": "frd"}, **flight})
    t, actuator_t = ((t_ns - m.imu_t_ns[0]) * 1e-9 for t_ns in (m.imu_t_ns, m.actuator_t_ns))
    return Signals(t, m.rates, m.specific_force, actuator_t, m.actuators)


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
        {"peaks": {}, "gust": 0.0, "bank": 0.0},
        {"peaks": {}, "gust": 2.0, "bank": 30.0, "seconds": 40.0},
        {"peaks": {}, "bank": 60.0, "seconds": 40.0},
        {"segments": (Segment("3211", 0.0, 12.0, {"de": 0.05, "da": 0.05, "dr": 0.1}, unit=0.1),)},
    ],
    ids=["excited", "calm", "storm", "steep turns", "pulses"],
)
def test_usual_flights_have_no_findings(spec: dict[str, Any]) -> None:
    assert flown(**spec).findings() == []


@pytest.mark.parametrize(("name", "spoil", "values", "expected_text"), MISTAKES)
def test_a_wrong_setting_is_named_within_ten_seconds_and_never_usable(
    name: str, spoil: Any, values: dict[str, Any], expected_text: str
) -> None:
    """The wrong settings of the campaign, benchmarks/false_usable.py."""
    m = light_measured(40.0, start=0.0, rate=200.0)
    spoiled = spoil(m)
    stream = [one for one in messages(spoiled) if one.t_ns < m.imu_t_ns[0] + 33e9]
    _, estimates = identified(spoiled, stream=stream, update_rate=20.0, **values)
    assert any(re.search(expected_text, e.reason) for e in since(estimates, 0.0, 10.0))
    assert not any(e.usable for e in estimates)


def test_a_fault_stops_learning_but_can_be_switched_off() -> None:
    m, wrong = light_measured(20.0, start=0.0), {"imu__convention": "frd"}
    first, *others = since(identified(m, **wrong)[1], 10.0, 20.0)
    assert all(e.state == "fault" and not e.adapting for e in others)
    np.testing.assert_array_equal(first.coefficients, others[-1].coefficients)
    _, estimates = identified(m, **wrong, supervision__plausibility=False)
    assert estimates[-1].state != "fault"


@pytest.mark.parametrize(
    "rpy",
    [(math.pi, 0.0), (0.0, math.pi / 2), (0.0, -math.pi / 2), (math.pi / 2, 0.0)],
    ids=["upside down", "x down", "x up", "on its side"],
)
def test_a_rotated_board_is_named_with_its_mounting_angles(rpy: tuple[float, float]) -> None:
    signals, misaligned = flown(), rotation(*rpy, 0.0)
    signals.rates, signals.force = signals.rates @ misaligned, signals.force @ misaligned
    assert signals.findings() == ["mounting"]
    assert f"[{rpy[0]:.2f}, {rpy[1]:.2f}, yaw]" in signals.fault
    assert signals.findings(imu__rpy=[*rpy, 0.0]) == []


# --- limits of the findings ---------------------------------------------------------------------


def plain(
    force: Any = -G, rates: Any = 0.0, de: Any = 0.0, rate: float = 50.0, noise: float = 1e-6
) -> Signals:
    """Signals with a given force (down, or three parts), rate (roll, or three), or elevator.

    Each is a number or a function of the time; the elevator of the sample.
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


def rolling_back_and_forth(angle: float, speed: float) -> Signals:
    """Rolls to and fro with a mean rate of `speed`, rad/s: the mean force is J0(angle) gravity."""
    omega = speed * math.pi / 2.0 / angle
    return plain(rates=lambda t: angle * omega * np.cos(omega * t))


def pulling(speed: float) -> Signals:
    """A quadrotor in aerobatics: thrust along its own axis, 1 g on average, with strong changes."""
    pull = math.sqrt(2.0) * speed * math.radians(3.0)
    return plain(lambda t: -G - pull * np.sin(7.0 * math.pi * t), rates=3.0)


def turning(axis: int, rate: float) -> Signals:
    """Rolls, or pulled loops: the mean force equals the weight."""

    def force(t: FloatArray) -> FloatArray:
        angle, zero = np.cumsum(rate * (t > 8.0)) * TICK, 0.0 * t
        along = (zero, -np.sin(angle)) if axis == 0 else (np.sin(angle), zero)
        return G * np.stack([*along, -np.cos(angle) - 1.5 * axis * (t > 8.0)], axis=1)

    return plain(force, lambda t: np.outer(rate * (t > 8.0), np.eye(3)[axis]))


def swaying(middle: float) -> Signals:
    return plain(de=lambda k: middle + 0.05 * np.sin(k))


def switching(step: float, drift: float = 0.0, every: int = 2, rate: float = 50.0) -> Signals:
    """An input that leaves its value for one sample, repeatedly."""
    return plain(de=lambda k: step * (k % every == every - 1) + drift * (k % 300), rate=rate)


def oscillating(reversed_: int) -> Signals:
    """An input with so many steps in 2 s that the next sample takes back, and two that it keeps."""
    period = np.zeros(100)
    period[3 : 3 + 4 * reversed_ : 4] = 1.0
    period[-6:-4] = 1.0, -1.0
    return plain(de=lambda k: period[k.astype(int) % len(period)])


def pulse_widths(k: FloatArray) -> FloatArray:
    """Pulse widths of an elevator that is not armed at first."""
    return (1500.0 + 25.0 * np.sin(k)) * (k > 300)


def trim(elevator: float) -> dict[str, Any]:
    return {"actuators__trim": (elevator, 0.0, 0.0, 0.0)}


MAPPED = trim(1500.0) | {"actuators__scale": (0.002, 1.0, 1.0, 1.0)}
LEARNED = {"actuators__learn_trim_time": 2.0, "actuators__trim": ()}
BORDERS: list[tuple[str, Callable[[], Signals], dict[str, Any]]] = [
    # finding: part of its text, signals, settings
    ("", lambda: tilted(55.0), {}),
    ("mounting", lambda: tilted(65.0), {}),
    ("", lambda: plain(lambda t: np.where((t > 8.0) & (t < 18.0), -0.1 * G, -G)), {}),  # free fall
    ("force size: looks like g", lambda: plain(-1.0), {}),
    ("force size: looks like g", lambda: plain(-3.5), {}),
    ("", lambda: plain(-4.5), {}),
    ("", lambda: plain(-55.0), {}),
    ("force size: milli-g", lambda: plain(-65.0), {}),
    ("", lambda: plain(0.0, noise=0.0), {}),  # an accelerometer that repeats itself is absent
    ("", lambda: plain([-9.81, 0.0, 0.0], noise=0.0), {}),
    ("gyro units", lambda: rolling_back_and_forth(1.35, 5.0), {}),  # 0.6 of gravity remains
    ("", lambda: rolling_back_and_forth(0.95, 5.0), {}),  # 0.8
    ("gyro units", lambda: rolling_back_and_forth(1.6, 0.6), {}),
    ("", lambda: rolling_back_and_forth(1.6, 0.4), {}),
    ("gyro units", lambda: pulling(30.0), {}),
    ("", lambda: pulling(60.0), {}),
    ("", lambda: turning(0, 6.0), {}),
    ("", lambda: turning(1, 2.5), {}),
    ("", lambda: swaying(0.0), trim(-0.5)),
    ("trim", lambda: swaying(0.0), trim(-0.7)),
    ("", lambda: swaying(0.9), trim(0.2)),  # as far from a trim of 0 as from this one
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
    ("", lambda: oscillating(17), {}),
    ("publishers", lambda: oscillating(19), {}),
    # an oscillation at half the rate of slow inputs is not distinguishable
    ("", lambda: switching(1.0, rate=16.0), {}),
    ("publishers", lambda: switching(1.0, rate=24.0), {}),
]


@pytest.mark.parametrize(("found", "make", "read"), BORDERS)
def test_findings_begin_at_their_limits(
    found: str, make: Callable[[], Signals], read: dict[str, Any]
) -> None:
    name, _, expected_text = found.partition(": ")
    signals = make()
    assert signals.findings(**(trim(0.0) | read)) == [name] * bool(name)
    assert expected_text in signals.fault


def test_inverted_flight_raises_no_fault_for_almost_two_minutes() -> None:
    checks, nothing = Plausibility(settings_of()), np.zeros((0, 4))
    inverted = 0
    for t in range(1, 400):
        force = np.array([0.0, 0.0, -G if t <= 200 else G]) + 1e-6 * (t % 2)
        checks.look(float(t), np.append(np.zeros(3), force)[None], nothing)
        inverted += t > 200 and not checks.fault
    assert 110 <= inverted <= 120  # a minute's memory changes to 0.7 of the opposite sign


def test_evidence_is_held_and_then_cleared() -> None:
    """Without messages of the Imu, too."""
    checks, faults = Plausibility(settings_of()), []
    for t in np.arange(TICK, 60.0, TICK):
        raw = np.array([[0.0] * 4, [0.2 * (t < 15.0)] * 4])
        motion = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, -G + 1e-6 * t]])
        checks.look(t, motion[: int(t < 2.0)], raw)
        faults.append(bool(checks.fault))
    after = np.flatnonzero(faults) * TICK
    assert after[0] < 6.0
    # 4 s in the window, and 30 s of memory
    assert after[-1] == pytest.approx(15.0 + 4.0 + 30.0, abs=1.5)
    assert list(checks.noted) == ["publishers"]


# --- findings from the coefficients ---------------------------------------------------------------

STRUCTURE = STRUCTURES["augmented"]
DERIVATIVES = {"pdot/da": 45.0, "pdot/dr": 3.0, "qdot/de": -30.0, "rdot/dr": -9.0, "rdot/da": -1.5}
RIGHT = matrix(STRUCTURE, DERIVATIVES)
REVERSED = matrix(STRUCTURE, DERIVATIVES | {"pdot/da": -45.0})
OTHER_RUDDER = matrix(STRUCTURE, DERIVATIVES | {"rdot/dr": 9.0})


@pytest.mark.parametrize(
    ("values", "sigma", "name"),
    [
        (RIGHT, 1.0, None),
        (REVERSED, 1.0, "signs"),
        (REVERSED, 10.0, "signs"),
        (REVERSED, 16.0, None),
        (OTHER_RUDDER, 1.0, "signs"),
    ],
)
def test_reversed_channels_are_named_beyond_three_sigma(
    values: FloatArray, sigma: float, name: str | None
) -> None:
    spread, expected = np.full(values.shape, sigma), ("+pdot/da", "-rdot/dr")
    found = sign_finding(STRUCTURE, values, spread, expected)
    assert (found.name if found else None) == name


def test_an_imu_that_points_backwards_is_never_usable_where_signs_are_expected() -> None:
    """Gravity does not show it: roll and pitch rate are reversed, and so are ax and ay."""
    measured = light_measured(35.0)
    signs = ("-qdot/de", "-rdot/dr", "+pdot/da")
    own = {"imu__rpy": (0.0, 0.0, math.pi), "supervision__expected_signs": signs}
    estimates = identified(measured, **own)[1]
    assert not any(usable for e in estimates for usable in e.usable_rows)
    assert "the Imu may point backwards; correct imu.rpy" in estimates[-1].reason
    assert not identified(measured, supervision__expected_signs=signs)[0].plausibility.noted


def learning(**given: Any) -> Plausibility:
    expected = {"supervision__expected_signs": ("+pdot/da",)}
    return Plausibility(settings_of(structure="augmented", **expected, **given))


def judged(
    checks: Plausibility,
    t: float,  # s
    values: FloatArray,
    sigma: float,
    *gyro: GyroFilters,
) -> list[str]:
    """Return the findings at a time from the coefficients learned until then."""
    nothing = np.zeros((0, 6))
    checks.look(t, nothing, nothing[:, :4])
    checks.judge(t, values, np.full(values.shape, sigma), *gyro)
    return [finding.name for finding in checks.findings]


QUAD = {  # four motors: lift and all moments
    "actuators__mixing__de": (0.25, 0.25, -0.25, -0.25),
    "actuators__mixing__da": (0.25, -0.25, -0.25, 0.25),
    "actuators__mixing__dr": (0.25, -0.25, 0.25, -0.25),
    "actuators__mixing__dth": (0.25,) * 4,
}


@pytest.mark.parametrize(("given", "moved"), [({}, "surface"), (QUAD, "motor")])
def test_a_reversed_sign_may_be_an_actuator_or_the_imu(given: dict[str, Any], moved: str) -> None:
    """Gravity does not show an Imu that points backwards, the signs do."""
    checks = learning(**given)
    for t, sigma in ((1.0, 3.0), (6.0, 4.0), (7.0, 400.0)):
        judged(checks, t, REVERSED, sigma)
    assert checks.fault.startswith("pdot/da is -45 +- 4, expected is +")  # the strongest evidence
    assert f"a {moved} is connected the wrong way round" in checks.fault
    assert checks.fault.endswith("an axis of the Imu is reversed: see imu.rpy")


def test_a_finding_on_coefficients_stays_until_it_is_the_less_likely() -> None:
    """A finding begins at three sigma; evidence below that does not begin it anew."""
    checks = learning()
    for t, values, sigma, named in (
        (1.0, REVERSED, 9.0, []),
        (3.0, REVERSED, 25.0, []),
        (5.5, REVERSED, 9.0, ["signs"]),
        (6.0, RIGHT, 9.0, []),
        (7.0, REVERSED, 25.0, []),
        (12.0, REVERSED, 25.0, []),
        (13.0, REVERSED, 9.0, []),
        (18.0, REVERSED, 25.0, []),  # a single time may be chance
        (18.5, REVERSED, 9.0, ["signs"]),
        (25.0, REVERSED, 90.0, ["signs"]),
    ):
        assert judged(checks, t, values, sigma) == named, t


def evidence(sigma: float) -> GyroFilters:
    """Evidence for wrong axes in place of the gyro's filters."""

    def wrong(sure: float) -> WrongAxes | None:
        return WrongAxes(HYPOTHESES[1], sigma, "lift") if sigma > sure else None

    return cast(GyroFilters, SimpleNamespace(wrong_axes=wrong, by_lift=wrong))


def test_axes_are_in_doubt_from_three_sigma_on_and_a_fault_without_doubt() -> None:
    """Doubted axes take the verdict alone; beyond 4.1 sigma they are named as well."""
    checks, values = Plausibility(settings_of()), matrix(STRUCTURES["flight_dynamics"], {})
    for t, sigma, doubted, named in (
        (1.0, 2.9, False, False),
        (2.0, 3.1, True, False),
        (7.0, 4.0, True, False),
        (8.0, 2.0, True, False),
        (9.0, 4.2, True, True),
        (10.0, 3.1, True, True),
        (11.0, -1.0, False, False),
    ):
        assert judged(checks, t, values, 1.0, evidence(sigma)) == ["axes"] * named, t
        assert (checks.doubt is not None, bool(checks.fault)) == (doubted, named), t
        likely = checks.likely_axes.startswith("the axes of the gyro are unconfirmed: ")
        assert likely == (sigma > 0.0)


# --- small errors of the settings ---------------------------------------------------------------


def with_an_imu_at(height: float, configured: float) -> tuple[OnlineIdentifier, Estimate]:
    """Return an identifier after an excited flight with the Imu above the centre of gravity, m."""
    m = light_measured(40.0, sensors={"lever_arm": (0.0, 0.0, -height)})
    identifier, (*_, last) = identified(m, imu__lever_arm=[0.0, 0.0, -configured])
    return identifier, last


@pytest.mark.parametrize("height", [0.1, -0.1])
def test_the_height_of_the_imu_is_estimated_and_sigma_covers_its_effect(height: float) -> None:
    identifier, last = with_an_imu_at(height, 0.0)
    index = identifier.structure.index("pdot/da")
    share, sigmas = light_errors(last, "pdot/da")
    assert identifier.estimator.height == pytest.approx(height, abs=0.02)
    assert last.sigma[index] > 1.5 * identifier.estimator.sigma[index]
    assert share > 0.15 and sigmas < 2.0


def setup_error(
    estimate: DelayEstimate,
    delay: float,  # In use, s
    damping: float,  # 1/s
    *,
    configured: bool,  # Whether the lag is
    structure: str = "flight_dynamics",
    lost: float = 0.0,  # Share of the effect that a hidden lag attenuates
) -> tuple[float, str]:
    """Return the aileron's error relative to its effect, and the reason that denies its row."""
    own = STRUCTURES[structure]
    values, setup = matrix(own, {"pdot/da": 60.0, "pdot/p": -damping}), SetupErrors(own, 20.0)
    shares = np.array([0.0, 0.0, lost, 0.0])
    setup.look(values, estimate, delay, 0.0, lambda _: shares, 0.0, lag_is_configured=configured)
    sigma = setup.widened(np.full(values.shape, 1e-6))
    return sigma[own.index("pdot/da")] / 60.0, setup.denied(values, 4.0)[0]


def test_sigma_covers_the_loss_by_an_unseparated_lag_without_damping() -> None:
    sure = DelayEstimate(delay=0.1, sigma=0.01, rise=9.0, hidden=0.1)
    share, reason = setup_error(sure, 0.1, 0.0, configured=False, lost=0.3)
    assert share == pytest.approx(0.3, rel=0.01)
    assert "servo lag are not separated" in reason
    share, _ = setup_error(sure, 0.1, 0.0, configured=True, lost=0.3)
    assert share == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize(("total", "missed"), [(0.03, 0.0), (0.05, 0.02), (0.01, -0.02)])
def test_with_a_known_sum_the_lag_error_counts_to_second_order(total: float, missed: float) -> None:
    """The error of the delay in use relative to the sum counts to first order."""
    estimate = DelayEstimate(0.03, 0.01, total, 0.01, 9.0, 0.02, lag_sigma=0.02, hidden=0.04)
    share, _ = setup_error(estimate, 0.03, 5.0, configured=False)
    assert share == pytest.approx(5.0 * abs(missed) + 0.5 * (5.0 * 0.04) ** 2, rel=1e-3)


@pytest.mark.parametrize(
    ("lag", "total", "expected"), [(0.03, 0.02, 0.0), (0.07, 0.02, 0.041), (0.0, 0.08, 0.296)]
)
def test_a_configured_lag_counts_beyond_chance(lag: float, total: float, expected: float) -> None:
    """The error of the sum of lag and delay counts to first order, that of the lag to second."""
    estimate = DelayEstimate(0.02, 0.01, total, 0.01, 9.0, lag, lag_sigma=0.04, hidden=0.1)
    share, reason = setup_error(estimate, 0.02, 5.0, configured=True, structure="augmented")
    assert share == pytest.approx(expected, rel=0.01, abs=1e-7)
    assert bool(reason) == (expected > 0.25)


@pytest.mark.parametrize(
    ("delay", "rise", "expected"), [(0.009, 9.0, 0.0), (0.0125, 9.0, 0.075), (0.0125, 3.0, 0.0)]
)
def test_of_a_possible_delay_error_the_square_beyond_its_variance_counts(
    delay: float, rise: float, expected: float
) -> None:
    """Below two sigma the error is not sure. A row is denied where its share is a quarter."""
    estimate = DelayEstimate(delay, 0.01, rise=rise)
    share, reason = setup_error(estimate, 0.0, 10.0, configured=True)
    assert share == pytest.approx(expected, abs=1e-7)
    assert not reason


def test_a_configured_height_is_no_error_and_a_bias_of_a_quarter_by_one_denies_the_row() -> None:
    identifier, last = with_an_imu_at(0.3, 0.3)
    assert identifier.estimator.height == 0.0
    assert last.usable, last.reason
    _, last = with_an_imu_at(-0.3, 0.0)
    assert not last.usable_rows[0]
    assert "m below where 'imu.lever_arm' puts it" in last.reason
