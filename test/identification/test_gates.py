# SPDX-License-Identifier: Apache-2.0
"""What pauses learning, what it protects, and what is said about it."""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import flying
import numpy as np
import pytest

from uav_ident_ros.identification.estimate import CoefficientSet, Estimate
from uav_ident_ros.identification.gates import (
    ROW_GATES,
    Gates,
    GlitchFilter,
    Look,
    RestGate,
    SensorGate,
    SpikeFilter,
)
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.samples import Drop
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.simulation.inputs import ColouredNoise, Segment
from uav_ident_ros.simulation.noise import Measurements
from uav_ident_ros.simulation.plant import CoefficientChange

STRUCTURE = "throttle_coupled"

Alter = Callable[[float, flying.Message], flying.Message]


@pytest.fixture(scope="module")
def excited() -> Measurements:
    return flying.measured(45.0)


@cache
def healthy() -> Estimate:
    """The end of that flight with nothing wrong."""
    return flying.identified(flying.measured(45.0), structure=STRUCTURE)[1][-1]


@cache
def halved() -> Measurements:
    """The same flight, and on, with half an elevator from 40 s."""
    return flying.measured(60.0, changes=(CoefficientChange(40.0, {"qdot/de": 0.5}),))


def altered(measurements: Measurements, alter: Alter) -> list[flying.Message]:
    """Messages with the rates altered; `alter` is given the time since the start, s."""
    stream = flying.messages(measurements)
    start = stream[0].t_ns
    return [alter((m.t_ns - start) * 1e-9, m) if m.stream == "rates" else m for m in stream]


def with_rates(message: flying.Message, rates: np.ndarray[Any, Any]) -> flying.Message:
    return message._replace(values=(*rates.tolist(), *message.values[3:]))


def identifier(measurements: Measurements, **changes: Any) -> OnlineIdentifier:
    return OnlineIdentifier(flying.settings(measurements, **{"structure": STRUCTURE, **changes}))


def test_a_control_check_on_the_ground_teaches_nothing_and_its_cost_is_told(
    excited: Measurements,
) -> None:
    rng = np.random.default_rng(3)

    def stand(t: float, m: flying.Message) -> flying.Message:
        flies = min(max(t - 9.0, 0.0), 1.0)  # it takes off within a second
        still = rng.normal(0.0, 0.01, 3)
        return with_rates(m, flies * np.array(m.values[:3]) + (1.0 - flies) * still)

    stream, flown = altered(excited, stand), identifier(excited)
    estimates = flying.run(flown, stream)
    standing = flying.since(estimates, 1.0, 8.9)
    assert {e.reason for e in standing} == {AT_REST}
    assert {e.state for e in standing} == {"paused"}
    assert not any(e.coefficients.any() for e in standing)
    assert all(e.adapting for e in flying.since(estimates, 10.5, 45.0))
    assert estimates[-1].usable
    costs = flown.supervisor.gates.costs()
    resting = sum(e.reason.startswith("at rest") for e in estimates) / len(estimates)
    assert costs["rest"].share == pytest.approx(resting, abs=0.01) and 0.15 < resting < 0.25
    assert costs["rest"].setting == "supervision.min_motion, min_force_motion"
    assert "channel limit" not in costs
    flown.supervisor.adapt = False
    flown.update(stream[-1].t_ns + 10 * 10**9)
    assert flown.supervisor.gates.costs()["adaptation"].reason == "adaptation is switched off"
    ungated = flying.run(
        identifier(excited, supervision__min_motion=0.0), stream[: len(stream) // 3]
    )
    assert flying.since(ungated, 1.0, 9.0)[-1].coefficients.any()


def test_a_force_that_never_moves_is_the_ground_too(excited: Measurements) -> None:
    # The simulated accelerometer sees noise alone.
    stream = flying.messages(excited)
    estimates = flying.run(
        identifier(excited, supervision__min_force_motion=5.0), stream[: len(stream) // 3]
    )
    assert {e.reason for e in flying.since(estimates, 1.0, 10.0)} == {
        "at rest: no specific force has moved by 5 m/s^2"
    }


def test_a_saturated_gyro_pauses_a_second_more_and_is_not_scored(
    excited: Measurements,
) -> None:
    def clip(t: float, m: flying.Message) -> flying.Message:
        if not 20.0 <= t < 21.0:
            return m
        return with_rates(m, np.array([4.0, *m.values[1:3]]))

    estimates = flying.run(identifier(excited, supervision__max_rate=4.0), altered(excited, clip))
    paused = flying.since(estimates, 20.1, 21.9)
    assert {e.reason for e in paused} == {"the gyro is saturated: p reaches 4 rad/s"}
    before = flying.since(estimates, 19.0, 19.9)[-1]
    np.testing.assert_array_equal(paused[-1].coefficients, paused[0].coefficients)
    np.testing.assert_allclose(paused[-1].coefficients, before.coefficients, rtol=0.05, atol=0.5)
    after = flying.since(estimates, 22.2, 45.0)
    assert all(e.adapting for e in after)
    assert after[-1].usable
    np.testing.assert_allclose(flying.since(estimates, 24.0, 25.0)[-1].fit, before.fit, atol=3.0)


def test_a_stuck_gyro_is_named_and_not_learned_from(excited: Measurements) -> None:
    def freeze(t: float, m: flying.Message) -> flying.Message:
        if not 33.0 <= t < 39.0:
            return m
        return with_rates(m, np.array([m.values[0], 0.123, m.values[2]]))

    stream = altered(excited, freeze)
    estimates = flying.run(identifier(excited), stream)
    assert {e.reason for e in flying.since(estimates, 33.4, 39.0)} == {
        "the Imu is stuck: q has not changed for 0.25 s or more"
    }
    np.testing.assert_allclose(
        estimates[-1].coefficients[1], healthy().coefficients[1], rtol=0.1, atol=0.5
    )
    open_gates = {"supervision__stuck_time": 0.0, "supervision__max_residual": 0.0}
    ungated = flying.run(identifier(excited, **open_gates), stream)[-1]
    assert abs(ungated.coefficients[1, 8] / healthy().coefficients[1, 8] - 1.0) > 0.1


def rounded(
    rate: float, step: float, still: tuple[float, float] = (0.0, 0.0), seconds: float = 60.0,
    limit: float = math.inf,
) -> list[str]:  # fmt: skip
    """What the gate of the Imu says at each tick; it may hold q still for a while, or limit it.

    Each axis is moved in turn and then left to itself, as test inputs do. The gyro rounds to
    `step`, rad/s, and its noise is a quarter of that.
    """
    t = np.arange(0.0, seconds, 1.0 / rate)
    rng = np.random.default_rng(7)
    moving = (t[:, None] // 10.0) % 3 == np.arange(3)
    rates = 0.002 * rng.standard_normal((len(t), 3)).cumsum(axis=0) / math.sqrt(rate)
    rates += 0.1 * moving * np.sin(2.0 * np.pi * t[:, None] * np.array([0.4, 0.5, 0.3]))
    rates += 0.25 * step * rng.standard_normal(rates.shape)
    rates = step * np.round(rates / step) if step else rates
    rates[:, 1] = np.clip(rates[:, 1], -limit, limit)
    held = (still[0] <= t) & (t < still[1])
    rates[held, 1] = rates[held][:1, 1]
    force = rng.normal(size=(len(t), 3))
    gate, reasons, given = SensorGate(), [], 0
    for tick in np.arange(0.05, seconds, 0.05):
        end = int(np.searchsorted(t, tick, side="right"))
        samples = np.hstack([rates, force])[given:end]
        look = Look(float(tick), samples, np.empty((0, 4)), None, None, True, "", Settings())
        reasons.append(gate.check(look))
        given = end
    return reasons


@pytest.mark.parametrize(("rate", "step"), [(10.0, 0.002), (25.0, 0.002), (1000.0, 0.0175)])
def test_a_gyro_that_rounds_coarsely_is_stuck_only_where_it_repeats_itself_for_longer(
    rate: float, step: float
) -> None:
    assert set(rounded(rate, step)) == {""}
    reasons = rounded(rate, step, still=(41.0, 55.0))
    assert "the Imu is stuck: q has not changed for 0.25 s or more" in reasons[-19 * 20 : -5 * 20]


@pytest.mark.parametrize("step", [0.0, 0.002])
def test_a_gyro_whose_range_is_smaller_than_told_is_saturated(step: float) -> None:
    """It stays at the largest value that it ever had, as no gyro does that still measures."""
    reasons = rounded(200.0, step, limit=0.07)[10 * 20 :]
    assert {reason for reason in reasons if "saturated" in reason} == {
        "the gyro is saturated: q reaches 0.07 rad/s"
    }


@pytest.mark.parametrize("rate", [20.0, 100.0, 1000.0])
def test_a_gyro_that_never_repeats_itself_is_stuck_at_once(rate: float) -> None:
    """Again and again: what it repeats while it is stuck is no habit."""
    for begin in (3.0, 33.0):
        reasons = rounded(rate, 0.0, still=(begin, begin + 2.0), seconds=begin + 1.0)
        assert not any(reasons[: round(begin / 0.05)])
        assert reasons[round(begin / 0.05) + 6].startswith("the Imu is stuck: q ")
    assert not any(rounded(rate, 0.0, still=(0.0, 9.0), seconds=9.0)), "it never moved"


def test_sticks_at_their_limit_pause(excited: Measurements) -> None:
    raw = np.array([m.values for m in flying.messages(excited) if m.stream == "actuators"])
    high = raw.max(axis=0) + 1.0
    high[0] = np.quantile(raw[:, 0], 0.99)
    limits = {
        "actuators__lower_limit": tuple((raw.min(axis=0) - 1.0).tolist()),
        "actuators__upper_limit": tuple(high.tolist()),
    }
    stream = flying.messages(excited)
    estimates = flying.run(identifier(excited, **limits), stream[: len(stream) // 2])
    names = flying.settings(excited).actuators.channels
    printed = {e.reason for e in estimates if e.state == "paused"}
    assert f"channel {names[0]} is at its limit" in printed
    assert any(e.adapting for e in estimates)


def test_armed_decides_if_there_is_a_topic_that_tells(excited: Measurements) -> None:
    given = identifier(excited, armed__type="std_msgs/msg/Bool")
    stream = flying.messages(excited)[: len(flying.messages(excited)) // 3]
    third = len(stream) // 3
    deaf = flying.run(given, stream[:third])
    assert {e.reason for e in deaf[5:]} == {"no message says that it is armed"}
    given.add_armed(stream[third].t_ns, False)
    disarmed = flying.run(given, stream[third : 2 * third])
    assert {e.reason for e in disarmed[5:]} == {"not armed"}
    # Said late, but said once only: it must count all the same.
    assert given.add_armed(disarmed[-1].t_ns - 1, True) is None
    armed = flying.run(given, stream[2 * third :])
    assert all(e.adapting for e in armed)
    unset = identifier(excited)
    unset.add_armed(stream[0].t_ns, False)
    assert flying.run(unset, stream[:third])[-1].adapting


def test_below_flying_speed_nothing_is_learned(excited: Measurements) -> None:
    slow = identifier(excited, airspeed__type="std_msgs/msg/Float64", supervision__min_airspeed=8.0)
    stream = flying.messages(excited)[: len(flying.messages(excited)) // 3]
    half = len(stream) // 2
    slow.add_airspeed(stream[0].t_ns, 3.0)
    assert {e.reason for e in flying.run(slow, stream[:half])[5:]} == {
        "not flying: the airspeed is below 8 m/s"
    }
    slow.add_airspeed(stream[half].t_ns, 20.0)
    assert flying.run(slow, stream[half:])[-1].adapting


def test_a_blocked_pitot_tube_takes_the_verdict_at_once() -> None:
    """It would publish a ninth of every control derivative."""
    flown = flying.light_measured(45.0)
    blocked = OnlineIdentifier(flying.settings(flown, airspeed__type="std_msgs/msg/Float64"))
    stream = flying.messages(flown)
    cut = next(k for k, m in enumerate(stream) if m.t_ns - stream[0].t_ns >= 40_000_000_000)
    blocked.add_airspeed(stream[0].t_ns, 20.0)
    assert flying.run(blocked, stream[:cut])[-1].usable
    blocked.add_airspeed(stream[cut].t_ns, 0.0)
    half = (cut + len(stream)) // 2
    after = flying.run(blocked, stream[cut:half])[2:]  # two ticks before were still to come
    learned, scored = blocked.coefficient_set().values, blocked.running_fit.fit.copy()
    after += flying.run(blocked, stream[half:])
    assert not any(any(e.usable_rows) for e in after)
    assert all("look at the pitot tube" in e.reason for e in after)
    np.testing.assert_array_equal(blocked.coefficient_set().values, learned)
    np.testing.assert_array_equal(blocked.running_fit.fit, scored)


def test_a_knock_is_kept_from_good_coefficients(excited: Measurements) -> None:
    def knock(t: float, m: flying.Message) -> flying.Message:
        if not 33.0 <= t < 33.4:
            return m
        shake = 6.0 * np.sin(2.0 * np.pi * 5.0 * (t - 33.0)) * np.array([1.0, -1.0, 1.0])
        return with_rates(m, np.array(m.values[:3]) + shake)

    stream = altered(excited, knock)
    gated, ungated = (
        flying.run(identifier(excited, supervision__max_residual=ratio), stream)
        for ratio in (6.0, 0.0)
    )
    kept = flying.since(gated, 33.25, 33.4)
    assert {e.reason.split(";")[0] for e in kept} == {"residual far outside its usual size"}
    assert flying.since(gated, 37.0, 38.0)[-1].adapting

    def moved(estimates: list[Estimate]) -> float:
        return float(np.abs(estimates[-1].coefficients - healthy().coefficients).max())

    assert moved(gated) < 0.5 * moved(ungated)


def test_a_halved_elevator_is_named_and_not_usable_until_learned_anew() -> None:
    flown, estimates = flying.identified(halved(), structure=STRUCTURE)
    (change,) = flown.supervisor.changed
    noticed = change.t - estimates[0].t_ns * 1e-9
    assert (change.name, 40.0 < noticed < 47.0) == ("qdot/de", True)
    before = flying.since(estimates, 35.0, 40.0)[-1]
    assert before.usable
    dropped = flying.since(estimates, noticed + 0.1, noticed + 2.9)
    assert {(e.usable, e.reason) for e in dropped} == {
        (False, "qdot/de changed in flight and is learned anew")
    }
    doubt = [e.sigma[1, 8] / abs(e.coefficients[1, 8]) for e in (before, dropped[0])]
    assert doubt[1] > 1.5 * doubt[0]
    last = estimates[-1]
    assert last.usable
    assert last.coefficients[1, 8] == pytest.approx(0.5 * before.coefficients[1, 8], rel=0.1)


def test_a_surface_lost_after_a_warm_start_is_learned_anew() -> None:
    """What was known of it must not hold it where it was."""
    sure = CoefficientSet(STRUCTURE, healthy().coefficients, 0.2 * healthy().sigma)
    flown, (*_, last) = flying.identified(halved(), sure, structure=STRUCTURE)
    assert [change.name for change in flown.supervisor.changed] == ["qdot/de"]
    assert last.coefficients[1, 8] == pytest.approx(0.5 * sure.values[1, 8], rel=0.15)


def test_a_long_storm_under_an_autopilot_moves_nothing() -> None:
    def flight(rms: float, duration: float, seed: int) -> Measurements:
        excitation = Segment("multisine", duration=46.0, amplitudes=flying.AMPLITUDES, seed=1)
        return flying.measured(
            duration,
            segments=(excitation,),
            gusts=ColouredNoise(rms, 0.3),
            autopilot=True,
            seed=seed,
        )

    calm = flight(0.3, 47.0, 2)
    for gusts in (4.0, 1.5):
        hit = identifier(calm)
        before = flying.run(hit, flying.messages(calm))[-1]
        assert before.usable
        stream = flying.messages(flight(gusts, 95.0, 4))
        # Its excitation is over by then; its turbulence goes on.
        last = flying.run(hit, [m for m in stream if m.t_ns - stream[0].t_ns > 55e9])[-1]
        moved = np.abs(last.coefficients - before.coefficients)
        assert (moved <= 2.0 * before.sigma).all(), gusts
        assert hit.supervisor.changed == []


def test_a_pause_is_told_row_by_row() -> None:
    amplitudes = {k: v for k, v in flying.AMPLITUDES.items() if k != "de"}
    part = flying.measured(
        24.0,
        segments=(
            Segment("multisine", duration=12.0, amplitudes=flying.AMPLITUDES, seed=1),
            Segment("multisine", start=12.0, amplitudes=amplitudes | {"dth": 0.0}, seed=2),
        ),
    )
    flown, _ = flying.identified(part, structure=STRUCTURE)
    assert flown.supervisor.pauses() == {"qdot": "too little excitation"}
    assert flown.supervisor.learning.tolist() == [True, False, True]


def test_an_instant_out_of_range_costs_nothing(excited: Measurements) -> None:
    """One sample of 2000 deg/s took the verdict away for 52 s."""
    stream = altered(excited, lambda _, m: m)
    index = [k for k, m in enumerate(stream) if m.stream == "rates" and m.t_ns > stream[0].t_ns][
        7000
    ]
    rates = np.array(stream[index].values[:3])
    stream[index] = with_rates(stream[index], np.array([34.9, *rates[1:]]))
    flown = identifier(excited)
    estimates = flying.run(flown, stream)
    after = flying.since(estimates, 34.0, 38.0)
    assert all(e.usable and e.adapting for e in after)
    assert flown.intake.drops["rates"][Drop.GLITCH] == 1
    last = estimates[-1].coefficients
    np.testing.assert_allclose(last, healthy().coefficients, rtol=1e-2, atol=0.1)


def test_only_an_instant_out_of_range_is_a_glitch() -> None:
    quiet = np.zeros((6, 3))
    for low, high, found in ((1, 2, 1), (1, 5, 4), (1, 6, 4), (0, 2, 2)):
        rates = quiet.copy()
        rates[low:high, 1] = -40.0
        which = GlitchFilter().find(rates, 34.9)
        assert which is not None
        assert which.sum() == found and which[low : low + found].all()
    one = GlitchFilter()
    saturated = np.full((3, 3), 40.0)
    for found_then in ([True, True, True], [True, False, False], [False, False, False]):
        which = one.find(saturated, 34.9)
        assert which is not None and which.tolist() == found_then
    assert one.find(quiet, 34.9) is None and GlitchFilter().find(saturated, 0.0) is None


def test_spikes_within_the_range_of_the_gyro_cost_nothing(excited: Measurements) -> None:
    """10 rad/s in one sample of 500: 'dr has hardly moved of late' was said of a rudder at work."""
    rng = np.random.default_rng(5)

    def spoil(_: float, m: flying.Message) -> flying.Message:
        return with_rates(m, np.array(m.values[:3]) + 10.0 * (rng.random(3) < 0.002))

    flown = identifier(excited)
    estimates = flying.run(flown, altered(excited, spoil))
    assert all(e.usable for e in flying.since(estimates, 34.0, 45.0))
    count = 45.0 * 200.0 * 3 * 0.002
    assert flown.intake.drops["rates"][Drop.SPIKE] == pytest.approx(count, rel=0.3)
    assert healthy().usable
    last = estimates[-1].coefficients
    np.testing.assert_allclose(last, healthy().coefficients, rtol=5e-2, atol=0.2)


def test_a_step_of_the_clock_of_the_inputs_is_no_change_of_the_aircraft(
    excited: Measurements,
) -> None:
    """It was 'pdot/da changed in flight' after stamps that stepped by 0.2 s."""
    stream = flying.messages(excited)
    start = stream[0].t_ns
    late = [
        m._replace(t_ns=m.t_ns + 200_000_000)
        if m.stream == "actuators" and m.t_ns > start + 20 * 10**9
        else m
        for m in stream
    ]
    flown = identifier(excited)
    estimates = flying.run(flown, late)
    assert not flown.supervisor.changed and estimates[-1].usable
    assert "stepped by +0.20 s" in flown.plausibility.noted["clock step"].text
    for name in flying.DOMINANT:  # a second of it was learned before it was sure
        index = flown.structure.index(name)
        expected = healthy().coefficients[index]
        assert estimates[-1].coefficients[index] == pytest.approx(expected, rel=0.05)


def spikes_of(column: np.ndarray[Any, Any], ticks: int = 5) -> list[int]:
    """Samples that are left out of one signal, which comes so many at a time."""
    samples, found = np.zeros((len(column), 6)), SpikeFilter()
    samples[:, 1] = column
    out: list[int] = []
    for k in range(0, len(column), ticks):
        which = found.find(samples[k : k + ticks], 0.05)
        out += [] if which is None else (k + np.flatnonzero(which)).tolist()
    return out


@pytest.mark.parametrize("ticks", [1, 2, 5])
def test_a_spike_is_one_sample_and_the_next_is_back(ticks: int) -> None:
    t = 0.01 * np.arange(1000)
    rates = 0.3 * np.sin(2.0 * t) + np.random.default_rng(1).normal(0.0, 0.01, len(t))
    assert spikes_of(rates, ticks) == []
    spoiled, where = rates.copy(), [300, 304, 305, 501, 502, 799]
    spoiled[where] += [5.0, -5.0, 5.0, -5.0, 5.0, 5.0]  # single ones, and some beside others
    assert spikes_of(spoiled, ticks) == where
    # A blow, however hard: it is elsewhere from then on.
    thrown = rates + 20.0 * (t > 6.0)
    assert set(spikes_of(thrown, ticks)) <= {601}


@pytest.mark.parametrize("cycles", [0.5, 0.45, 0.34, 0.25])
def test_noise_and_vibration_are_no_spikes(cycles: float) -> None:
    """Even at half the sampling rate, where each sample leaves both its neighbours."""
    k = np.arange(20_000)
    for signal in (
        np.cos(2.0 * np.pi * cycles * k),
        np.random.default_rng(2).normal(size=len(k)),
        0.1 * np.round(np.random.default_rng(3).normal(0.0, 0.4, len(k))),  # coarse
    ):
        assert spikes_of(signal) == []


AT_REST = "at rest: no rate moves beyond the gyro's noise"
TOO_QUIET = "too quiet: no rate moves beyond the gyro's noise"


@pytest.mark.parametrize(
    ("swing", "noise", "airspeed", "said"),
    [
        (0.02, 0.003, None, ""),
        (0.0, 0.003, None, AT_REST),
        (0.004, 0.0005, None, AT_REST),
        (0.02, 0.015, None, AT_REST),
        (0.008, 0.0001, None, AT_REST),
        (0.02, 0.0001, None, ""),
        (0.0, 0.0, None, AT_REST),
        (0.0, 0.0, 6.0, AT_REST),
        (0.0, 0.0, 7.0, TOO_QUIET),  # a third of the reference, 20 m/s, is flight
    ],
    ids=["a large aircraft", "on the ground", "rocked by the wind", "lost in the noise",
         "rocked more", "smoothest flight", "no noise", "taxiing", "flying"],
)  # fmt: skip
def test_rest_is_told_by_the_gyros_own_noise_and_by_the_airspeed(
    swing: float, noise: float, airspeed: float | None, said: str
) -> None:
    gate, rng = RestGate(), np.random.default_rng(1)
    reasons = set()
    for k in range(200):
        t = 0.05 * k
        samples = noise * rng.standard_normal((10, 6))
        samples[:, 1] += 0.5 * swing * np.sin(2.0 * np.pi * 0.3 * t)
        look = Look(t, samples, np.zeros((0, 4)), airspeed, None, True, "", Settings())
        reason = gate.check(look)
        if t > 4.0:
            reasons.add(reason)
    assert reasons == {said}


def test_every_gate_names_settings_that_exist() -> None:
    known = set(Settings.from_values({}).values())
    gates = Gates()
    names = [gate.setting for gate in gates.table] + [setting for setting, _ in ROW_GATES.values()]
    for entry in names:
        first, *others = entry.split(", ")
        prefix = first.rpartition(".")[0]
        assert {first, *(f"{prefix}.{other}" for other in others)} <= known, entry
