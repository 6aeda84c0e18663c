# SPDX-License-Identifier: Apache-2.0
"""The gates: when learning pauses, the coefficients that a pause protects, and its reason."""

import math
from collections.abc import Callable
from copy import deepcopy
from functools import cache
from typing import Any

import flying
import numpy as np
import pytest
from numpy.typing import ArrayLike

from uav_ident_ros.identification import gates
from uav_ident_ros.identification.estimate import CoefficientSet, Estimate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.samples import ACTUATORS, AIRSPEED, Drop
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.inputs import ColouredNoise, Segment
from uav_ident_ros.simulation.noise import Measurements
from uav_ident_ros.simulation.plant import CoefficientChange

STRUCTURE = "throttle_coupled"


@cache
def healthy() -> Estimate:
    """The last estimate of the flight without faults."""
    return flown()[1][-1]


@cache
def halved() -> Measurements:
    """Measurements of the same flight, 15 s longer, with half an elevator from 34 s."""
    return flying.measured(52.0, changes=(CoefficientChange(34.0, {"qdot/de": 0.5}),))


def flown(
    stream: list[flying.SentSample] | None = None, seconds: float = 37.0, **changes: Any
) -> tuple[OnlineIdentifier, list[Estimate]]:
    """Return the identifier and estimates of `seconds` of the flight, or of other messages."""
    stream = flying.messages(flying.excited()) if stream is None else stream
    end = stream[0].t_ns + seconds * 1e9
    part = [m for m in stream if m.t_ns <= end]
    return flying.identified(flying.excited(), stream=part, **{"structure": STRUCTURE, **changes})


def altered(alter: Callable[[float, FloatArray], ArrayLike]) -> list[flying.SentSample]:
    """The flight's messages with rates changed by `alter`, a function of the time, s, and rates."""
    stream = flying.messages(flying.excited())
    start = stream[0].t_ns

    def altered_message(m: flying.SentSample) -> flying.SentSample:
        rates = np.asarray(alter((m.t_ns - start) * 1e-9, np.array(m.values[:3])))
        return m._replace(values=(*rates.tolist(), *m.values[3:]))

    return [altered_message(m) if m.stream == "rates" else m for m in stream]


def reasons_of(estimates: list[Estimate], begin: float, end: float) -> set[str]:
    return {e.reason for e in flying.since(estimates, begin, end)}


def test_a_control_check_on_the_ground_is_not_learned_and_its_cost_is_recorded() -> None:
    rng = np.random.default_rng(3)

    def stand(t: float, rates: FloatArray) -> FloatArray:
        flies = min(max(t - 4.0, 0.0), 1.0)  # take-off within a second
        return flies * rates + (1.0 - flies) * rng.normal(0.0, 0.01, 3)

    stream = altered(stand)
    identifier, estimates = flown(stream)
    standing = flying.since(estimates, 1.0, 3.9)
    assert {(e.state, e.reason) for e in standing} == {("paused", AT_REST)}
    assert not any(e.coefficients.any() for e in standing)
    assert all(e.adapting for e in flying.since(estimates, 5.5, 37.0))
    assert estimates[-1].usable
    costs = identifier.supervisor.gates.costs
    resting = sum(e.reason.startswith("at rest") for e in estimates) / len(estimates)
    assert costs()["rest"].share == pytest.approx(resting, abs=0.01) and 0.08 < resting < 0.15
    assert costs()["rest"].setting == "supervision.min_motion, min_force_motion"
    assert "channel limit" not in costs()
    identifier.supervisor.adapt = False
    identifier.update(stream[-1].t_ns + 10 * 10**9)
    assert costs()["adaptation"].reason == "adaptation is switched off"
    _, ungated = flown(stream, 4.0, supervision__min_motion=0.0)
    assert ungated[-1].coefficients.any()


def test_a_constant_specific_force_counts_as_rest() -> None:
    # The simulated accelerometer measures noise alone.
    _, estimates = flown(seconds=10.0, supervision__min_force_motion=5.0)
    assert reasons_of(estimates, 1.0, 10.0) == {"at rest: no specific force has moved by 5 m/s^2"}


def test_a_saturated_gyro_pauses_learning_and_scoring_for_a_second_more() -> None:
    clipped = altered(lambda t, rates: [4.0, *rates[1:]] if 20.0 <= t < 21.0 else rates)
    _, estimates = flown(clipped, supervision__max_rate=4.0)
    assert reasons_of(estimates, 20.1, 21.9) == {"the gyro is saturated: p reaches 4 rad/s"}
    paused = flying.since(estimates, 20.1, 21.9)
    before = flying.since(estimates, 19.0, 19.9)[-1]
    np.testing.assert_array_equal(paused[-1].coefficients, paused[0].coefficients)
    np.testing.assert_allclose(paused[-1].coefficients, before.coefficients, rtol=0.05, atol=0.5)
    assert all(e.adapting for e in flying.since(estimates, 22.2, 37.0))
    assert estimates[-1].usable
    np.testing.assert_allclose(flying.since(estimates, 24.0, 25.0)[-1].fit, before.fit, atol=3.0)


def test_a_stuck_gyro_is_named_and_its_samples_are_not_learned() -> None:
    stream = altered(lambda t, x: [x[0], 0.123, x[2]] if 25.0 <= t < 31.0 else x)
    _, estimates = flown(stream)
    assert reasons_of(estimates, 25.4, 31.0) == {
        "the Imu is stuck: q has not changed for 0.25 s or more"
    }
    found, right = estimates[-1].coefficients[1], healthy().coefficients[1]
    np.testing.assert_allclose(found, right, rtol=0.1, atol=0.5)
    ungated = flown(stream, supervision__stuck_time=0.0, supervision__max_residual=0.0)[1]
    during = np.array([e.coefficients[1, 8] for e in flying.since(ungated, 25.0, 37.0)])
    assert np.abs(during / right[8] - 1.0).max() > 0.1


def rounded(
    rate: float, step: float, still: tuple[float, float] = (0.0, 0.0), seconds: float = 60.0,
    limit: float = math.inf,
) -> list[str]:  # fmt: skip
    """Return the reason of the Imu's gate at each tick; q may be constant or limited.

    The axes are excited in turn. The gyro rounds to `step`, rad/s, with noise of a quarter.
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
    whole = np.hstack([rates, rng.normal(size=(len(t), 3))])
    gate, ticks, chosen = gates.SensorGate(), np.arange(0.05, seconds, 0.05), Settings()
    parts = np.split(whole, np.searchsorted(t, ticks, side="right"))
    return [
        gate.check(
            gates.Look(float(tick), part, np.empty((0, 4)), None, "", None, True, "", chosen)
        )
        for tick, part in zip(ticks, parts, strict=False)  # the last part has no tick
    ]


@pytest.mark.parametrize(("rate", "step"), [(10.0, 0.002), (25.0, 0.002), (1000.0, 0.0175)])
def test_a_coarse_gyro_is_stuck_after_unusual_repetitions(rate: float, step: float) -> None:
    assert set(rounded(rate, step)) == {""}
    reasons = rounded(rate, step, still=(41.0, 55.0))
    assert "the Imu is stuck: q has not changed for 0.25 s or more" in reasons[-19 * 20 : -5 * 20]


@pytest.mark.parametrize("step", [0.0, 0.002])
def test_a_gyro_with_a_smaller_range_than_configured_is_saturated(step: float) -> None:
    reasons = rounded(200.0, step, limit=0.07)[10 * 20 :]
    assert {reason for reason in reasons if "saturated" in reason} == {
        "the gyro is saturated: q reaches 0.07 rad/s"
    }


@pytest.mark.parametrize("rate", [20.0, 100.0, 1000.0])
def test_a_gyro_without_usual_repetitions_is_stuck_at_once(rate: float) -> None:
    """Repetitions while it is stuck do not count as usual."""
    for begin in (3.0, 33.0):
        reasons = rounded(rate, 0.0, still=(begin, begin + 2.0), seconds=begin + 1.0)
        assert not any(reasons[: round(begin / 0.05)])
        assert reasons[round(begin / 0.05) + 6].startswith("the Imu is stuck: q ")
    assert not any(rounded(rate, 0.0, still=(0.0, 9.0), seconds=9.0)), "it never moved"


def test_a_channel_at_its_limit_pauses_learning() -> None:
    raw = np.array([m.values for m in flying.messages(flying.excited()) if m.stream == "actuators"])
    high = raw.max(axis=0) + 1.0
    high[0] = np.quantile(raw[:, 0], 0.99)
    limits = {
        "actuators__lower_limit": tuple((raw.min(axis=0) - 1.0).tolist()),
        "actuators__upper_limit": tuple(high.tolist()),
    }
    identifier, estimates = flown(seconds=22.0, **limits)
    channel = identifier.settings.actuators.channels[0]
    pause_reasons = {e.reason for e in estimates if e.state == "paused"}
    assert f"channel {channel} is at its limit" in pause_reasons
    assert any(e.adapting for e in estimates)


def thirds() -> tuple[list[flying.SentSample], ...]:
    """Messages of the flight's first, second and third 5 s."""
    stream = flying.messages(flying.excited())
    t = (np.array([m.t_ns for m in stream]) - stream[0].t_ns) * 1e-9
    cuts = np.searchsorted(t, [5.0, 10.0, 15.0])
    return tuple(stream[a:b] for a, b in zip([0, *cuts], cuts, strict=False))


def test_an_armed_topic_decides_if_it_is_configured() -> None:
    armed, (first, second, third) = flying.fresh(armed__type="std_msgs/msg/Bool"), thirds()
    assert {e.reason for e in flying.run(armed, first)[5:]} == {"no message says that it is armed"}
    armed.add_armed(second[0].t_ns, False)
    disarmed = flying.run(armed, second)
    assert {e.reason for e in disarmed[5:]} == {"not armed"}
    # A late message counts, since it is sent only once.
    assert armed.add_armed(disarmed[-1].t_ns - 1, True) is None
    assert all(e.adapting for e in flying.run(armed, third))
    unset = flying.fresh()
    unset.add_armed(first[0].t_ns, False)
    assert flying.run(unset, first)[-1].adapting


def at_speed(stream: list[flying.SentSample], speed: float) -> list[flying.SentSample]:
    """Return messages with an airspeed, m/s, before each of the inputs."""
    return [
        part
        for m in stream
        for part in (m._replace(stream=AIRSPEED, values=(speed,)), m)
        if part is m or m.stream == ACTUATORS
    ]


def test_below_flying_speed_nothing_is_learned() -> None:
    slow = flying.fresh(airspeed__type="std_msgs/msg/Float64", supervision__min_airspeed=8.0)
    first, second, _ = thirds()
    assert {e.reason for e in flying.run(slow, at_speed(first, 3.0))[5:]} == {
        "not flying: the airspeed is below 8 m/s"
    }
    assert flying.run(slow, at_speed(second, 20.0))[-1].adapting


def test_with_a_blocked_pitot_tube_no_row_is_usable() -> None:
    """The scaling would divide every control derivative by nine."""
    m = flying.light_measured(36.0)
    blocked = OnlineIdentifier(flying.settings(m, airspeed__type="std_msgs/msg/Float64"))
    stream = flying.messages(m)
    cut = next(k for k, m in enumerate(stream) if m.t_ns - stream[0].t_ns >= 32_000_000_000)
    assert flying.run(blocked, at_speed(stream[:cut], 20.0))[-1].usable
    half = (cut + len(stream)) // 2
    after = flying.run(blocked, at_speed(stream[cut:half], 0.0))[1:]  # one tick was pending
    learned, scored = blocked.coefficient_set().values, blocked.running_fit.fit.copy()
    after += flying.run(blocked, at_speed(stream[half:], 0.0))
    assert not any(any(e.usable_rows) for e in after)
    assert all("look at the pitot tube" in e.reason for e in after)
    np.testing.assert_array_equal(blocked.coefficient_set().values, learned)
    np.testing.assert_array_equal(blocked.running_fit.fit, scored)


def test_the_residual_gate_protects_the_coefficients_from_a_knock() -> None:
    def knock(t: float, rates: FloatArray) -> FloatArray:
        shake = 6.0 * np.sin(2.0 * np.pi * 5.0 * (t - 32.0)) * np.array([1.0, -1.0, 1.0])
        return rates + shake * (32.0 <= t < 32.4)

    gated, ungated = (
        flown(altered(knock), supervision__max_residual=ratio)[1] for ratio in (6.0, 0.0)
    )
    reasons = reasons_of(gated, 32.25, 32.4)
    assert {reason.split(";")[0] for reason in reasons} == {"residual far outside its usual size"}
    assert flying.since(gated, 36.0, 37.0)[-1].adapting
    moved, moved_ungated = (
        np.abs(estimates[-1].coefficients - healthy().coefficients).max()
        for estimates in (gated, ungated)
    )
    assert moved < 0.5 * moved_ungated


def test_a_halved_elevator_is_named_and_unusable_until_it_alone_is_relearned() -> None:
    identifier, estimates = flying.identified(halved(), structure=STRUCTURE)
    (change,) = identifier.supervisor.changed
    detected = change.t - estimates[0].t_ns * 1e-9
    assert (change.name, 34.0 < detected < 41.0) == ("qdot/de", True)
    before, last = flying.since(estimates, 29.0, 34.0)[-1], estimates[-1]
    assert before.usable
    dropped = flying.since(estimates, detected + 0.1, detected + 2.9)
    assert {(e.usable, e.reason) for e in dropped} == {
        (False, "qdot/de changed in flight and is learned anew")
    }
    relative_sigma = [e.sigma[1, 8] / abs(e.coefficients[1, 8]) for e in (before, dropped[0])]
    assert relative_sigma[1] > 1.5 * relative_sigma[0]
    assert last.usable
    assert last.coefficients[1, 8] == pytest.approx(0.5 * before.coefficients[1, 8], rel=0.1)
    for name in set(flying.DOMINANT) - {"qdot/de"}:
        place = identifier.structure.index(name)
        moved = abs(last.coefficients[place] - before.coefficients[place])
        assert moved < max(0.1 * abs(before.coefficients[place]), 2.0 * before.sigma[place]), name


def test_an_elevator_halved_after_a_warm_start_is_learned_anew() -> None:
    """The prior does not hold the coefficient at its former value."""
    sure = CoefficientSet(STRUCTURE, healthy().coefficients, 0.2 * healthy().sigma)
    stream = [m for m in flying.messages(halved()) if m.t_ns > halved().imu_t_ns[0] + 20e9]
    identifier, (*_, last) = flying.identified(halved(), sure, stream, structure=STRUCTURE)
    assert [change.name for change in identifier.supervisor.changed] == ["qdot/de"]
    assert last.coefficients[1, 8] == pytest.approx(0.5 * sure.values[1, 8], rel=0.15)


def test_a_long_storm_under_an_autopilot_does_not_change_the_coefficients() -> None:
    segments = (Segment("multisine", duration=34.0, amplitudes=flying.AMPLITUDES, seed=2),)

    def flight(rms: float, duration: float, seed: int) -> Measurements:
        air = {"gusts": ColouredNoise(rms, 0.3), "autopilot": True, "seed": seed}
        return flying.measured(duration, segments=segments, **air)

    learned, (*_, before) = flying.identified(flight(0.3, 34.0, 2), structure=STRUCTURE)
    assert before.usable
    for gusts in (4.0, 1.5):
        hit, stream = deepcopy(learned), flying.messages(flight(gusts, 75.0, 4))
        # From here on there is turbulence without excitation.
        last = flying.run(hit, [m for m in stream if m.t_ns - stream[0].t_ns > 40e9])[-1]
        moved = np.abs(last.coefficients - before.coefficients)
        assert (moved <= 2.0 * before.sigma).all(), gusts
        assert hit.supervisor.changed == []


def test_the_rows_pause_separately_for_lack_of_excitation() -> None:
    rests = flying.AMPLITUDES | {"de": 0.0, "dth": 0.0}
    segments = (
        Segment("multisine", duration=12.0, amplitudes=flying.AMPLITUDES, seed=1),
        Segment("multisine", start=12.0, amplitudes=rests, seed=2),
    )
    m = flying.measured(24.0, segments=segments)
    identifier, _ = flying.identified(m, structure=STRUCTURE)
    assert identifier.supervisor.pauses() == {"qdot": "too little excitation"}
    assert identifier.supervisor.learning.tolist() == [True, False, True]


def test_a_single_sample_out_of_range_is_dropped_without_a_pause() -> None:
    spoiled = altered(lambda t, rates: [34.9, *rates[1:]] if abs(t - 33.0) < 1e-3 else rates)
    identifier, estimates = flown(spoiled)
    assert all(e.usable and e.adapting for e in flying.since(estimates, 32.0, 36.0))
    assert identifier.intake.drops["rates"][Drop.GLITCH] == 1
    found, right = estimates[-1].coefficients, healthy().coefficients
    np.testing.assert_allclose(found, right, rtol=1e-2, atol=0.1)


def test_spikes_within_the_range_of_the_gyro_do_not_change_the_verdict() -> None:
    """Spikes of 10 rad/s, in one sample of 500."""
    rng = np.random.default_rng(5)
    stream = altered(lambda _, rates: rates + 10.0 * (rng.random(3) < 0.002))
    identifier, estimates = flown(stream)
    assert all(e.usable for e in flying.since(estimates, 32.0, 37.0))
    count = 37.0 * 200.0 * 3 * 0.002
    assert identifier.intake.drops["rates"][Drop.SPIKE] == pytest.approx(count, rel=0.3)
    found, right = estimates[-1].coefficients, healthy().coefficients
    np.testing.assert_allclose(found, right, rtol=5e-2, atol=0.2)


def test_a_clock_step_of_the_inputs_is_no_change_of_the_aircraft() -> None:
    stream = flying.messages(flying.excited())
    step_ns = stream[0].t_ns + 20 * 10**9
    late = [
        m._replace(t_ns=m.t_ns + 200_000_000 * (m.stream == "actuators" and m.t_ns > step_ns))
        for m in stream
    ]
    identifier, (*_, last) = flown(late)
    assert not identifier.supervisor.changed and last.usable
    assert "stepped by +0.20 s" in identifier.plausibility.noted["clock step"].text
    for name in flying.DOMINANT:  # a second was learned before the detection
        index = identifier.structure.index(name)
        assert last.coefficients[index] == pytest.approx(healthy().coefficients[index], rel=0.05)


def spikes_of(column: FloatArray, ticks: int = 5) -> list[int]:
    """Samples that the filter removes from one signal, filtered `ticks` samples at a time."""
    samples, found = np.zeros((len(column), 6)), gates.Outliers()
    samples[:, 1] = column
    out: list[int] = []
    for k in range(0, len(column), ticks):
        _, which = found.find(samples[k : k + ticks], 0.05, max_rate=0.0)
        out += [] if which is None else (k + np.flatnonzero(which)).tolist()
    return out


@pytest.mark.parametrize("ticks", [1, 2, 5])
def test_a_spike_is_a_single_sample_between_usual_ones(ticks: int) -> None:
    t = 0.01 * np.arange(1000)
    rates = 0.3 * np.sin(2.0 * t) + np.random.default_rng(1).normal(0.0, 0.01, len(t))
    assert spikes_of(rates, ticks) == []
    spoiled, where = rates.copy(), [300, 304, 305, 501, 502, 799]
    spoiled[where] += [5.0, -5.0, 5.0, -5.0, 5.0, 5.0]  # single and adjacent ones
    assert spikes_of(spoiled, ticks) == where
    # After a blow the signal stays at its new value.
    thrown = rates + 20.0 * (t > 6.0)
    assert set(spikes_of(thrown, ticks)) <= {601}


@pytest.mark.parametrize("cycles", [0.5, 0.45, 0.34, 0.25])
def test_noise_and_vibration_are_no_spikes(cycles: float) -> None:
    """Even at half the sampling rate, where each sample deviates from both neighbours."""
    k = np.arange(20_000)
    for signal in (
        np.cos(2.0 * np.pi * cycles * k),
        np.random.default_rng(2).normal(size=len(k)),
        0.1 * np.round(np.random.default_rng(3).normal(0.0, 0.4, len(k))),  # quantised
    ):
        assert spikes_of(signal) == []


AT_REST = "at rest: no rate moves beyond the gyro's noise"
TOO_QUIET = "too quiet: no rate moves beyond the gyro's noise"


@pytest.mark.parametrize(
    ("swing", "noise", "airspeed", "expected"),
    [
        (0.02, 0.003, None, ""),  # a large aircraft
        (0.0, 0.003, None, AT_REST),
        (0.004, 0.0005, None, AT_REST),  # rocked by the wind
        (0.02, 0.015, None, AT_REST),  # lost in the noise
        (0.008, 0.0001, None, AT_REST),  # rocked more
        (0.02, 0.0001, None, ""),  # the smoothest flight
        (0.0, 0.0, None, AT_REST),
        (0.0, 0.0, 6.0, AT_REST),  # taxiing
        (0.0, 0.0, 7.0, TOO_QUIET),  # above a third of the reference, 20 m/s: flight
    ],
)
def test_rest_is_detected_by_the_gyros_noise_and_by_the_airspeed(
    swing: float, noise: float, airspeed: float | None, expected: str
) -> None:
    gate, rng, chosen = gates.RestGate(), np.random.default_rng(1), Settings()
    reasons = set()
    for k in range(200):
        t = 0.05 * k
        samples = noise * rng.standard_normal((10, 6))
        samples[:, 1] += 0.5 * swing * np.sin(2.0 * np.pi * 0.3 * t)
        look = gates.Look(t, samples, np.zeros((0, 4)), airspeed, "", None, True, "", chosen)
        reason = gate.check(look)
        if t > 4.0:
            reasons.add(reason)
    assert reasons == {expected}


def test_every_gate_names_settings_that_exist() -> None:
    known = set(Settings.from_values({}).values())
    names = [gate.setting for gate in gates.Gates().table] + [
        setting for setting, _ in gates.ROW_GATES.values()
    ]
    for entry in names:
        first, *others = entry.split(", ")
        prefix = first.rpartition(".")[0]
        assert {first, *(f"{prefix}.{other}" for other in others)} <= known, entry
