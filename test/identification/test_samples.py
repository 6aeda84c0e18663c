# SPDX-License-Identifier: Apache-2.0
"""Samples are used in the order of their stamps; a single outlying stamp is no new time base."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uav_ident_ros.identification import samples
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.scales import IN_A_ROW
from uav_ident_ros.identification.settings import Settings


def filled(*stamps: int) -> samples.SampleBuffer:
    buffer = samples.SampleBuffer(1)
    for t in stamps:
        buffer.append(t, (float(t),))
    return buffer


def test_of_samples_with_equal_stamps_the_first_to_arrive_counts() -> None:
    buffer = filled(20)
    assert [buffer.append(10, (value,)) for value in (1.0, 2.0, 3.0)] == [True, False, False]
    buffer.merge(100)
    assert buffer.t.tolist() == [10, 20]
    assert buffer.v[0, 0] == 1.0


@given(st.permutations(range(12)), st.lists(st.integers(0, 12), max_size=4))
def test_samples_wait_for_their_tick_in_any_order(order: list[int], ticks: list[int]) -> None:
    buffer = filled(*order)
    for tick in [*sorted(ticks), 12]:
        buffer.merge(tick)
        used = list(range(min(tick, 11) + 1))
        assert buffer.t.tolist() == buffer.v[:, 0].tolist() == used


# --- stamps -----------------------------------------------------------------------------------

S = 1_000_000_000


def intake_at(t_ns: int) -> samples.Intake:
    """Return an intake with this newest stamp."""
    intake = OnlineIdentifier(Settings()).intake
    assert add(intake, t_ns) is None
    return intake


def add(intake: samples.Intake, t_ns: int) -> samples.Drop | None:
    return intake.add_rates(t_ns, (0.1, 0.2, 0.3), (0.0, 0.0, -9.8))


@pytest.mark.parametrize("jump", [-3600, -2, 2, 3600])
def test_a_single_outlier_is_dropped_and_agreeing_ones_are_a_new_time_base(jump: int) -> None:
    intake = intake_at(10_000 * S)
    base = (10_000 + jump) * S
    assert add(intake, base) is samples.Drop.OUTLYING_STAMP
    assert add(intake, 10_000 * S + S // 200) is None
    assert intake.newest_ns == 10_000 * S + S // 200
    verdicts = [add(intake, base + k * S // 200) for k in range(IN_A_ROW)]
    assert verdicts == [samples.Drop.OUTLYING_STAMP] * (IN_A_ROW - 1) + [None]
    assert intake.newest_ns == base + (IN_A_ROW - 1) * S // 200
    assert intake.drops["rates"][samples.Drop.OUTLYING_STAMP] == 1  # those that agree are kept
    assert add(intake, base + S // 10) is None


def test_outliers_that_disagree_or_alternate_with_usual_ones_are_no_time_base() -> None:
    intake = intake_at(10_000 * S)
    for k in range(50):
        assert add(intake, (20_000 + 7 * (k % 5)) * S) is samples.Drop.OUTLYING_STAMP
    for k in range(1, 21):
        assert add(intake, 20_000 * S + k * S // 200) is samples.Drop.OUTLYING_STAMP
        assert add(intake, 10_000 * S + k * S // 200) is None


def test_stamps_beyond_the_range_of_a_message_are_dropped() -> None:
    identifier = OnlineIdentifier(Settings())
    beyond = samples.LATEST_STAMP + 1
    for k in range(2 * IN_A_ROW):
        t_ns = beyond + k * S // 200
        assert identifier.add_rates(t_ns, (0.1, 0.2, 0.3)) is samples.Drop.BEYOND_STAMP
        assert identifier.add_actuators(t_ns, (0.0,) * 4) is samples.Drop.BEYOND_STAMP
        assert identifier.add_airspeed(t_ns, 20.0) is samples.Drop.BEYOND_STAMP
        assert identifier.add_armed(t_ns, True) is samples.Drop.BEYOND_STAMP
    assert identifier.intake.due is None


@pytest.mark.parametrize(
    ("stream", "real", "beyond"),
    [
        ("rates", 4000.0 * math.pi / 180.0, 7400.0 * math.pi / 180.0),  # full scale of a gyro
        ("force", 90.0 * 9.80665, 120.0 * 9.80665),  # full scale of an accelerometer for shocks
        ("airspeed", 900.0, 1200.0),
        ("actuators", 700_000.0, 1.2e6),  # ten times the 1/min of a small motor
        ("excitation", 700_000.0, 1.2e6),
    ],
)
def test_values_of_real_sensors_and_motors_pass(stream: str, real: float, beyond: float) -> None:
    def drop_of(value: float) -> samples.Drop | None:
        identifier = OnlineIdentifier(Settings())
        t_ns, none = 10 * S, (0.0, 0.0, 0.0)
        if stream in ("rates", "force"):
            own = (0.0, -value, 0.0)
            rates, force = (own, none) if stream == "rates" else (none, own)
            return identifier.add_rates(t_ns, rates, force)
        identifier.add_rates(t_ns, none, none)
        if stream == "airspeed":
            return identifier.add_airspeed(t_ns, value)
        return getattr(identifier, f"add_{stream}")(t_ns, (0.0, 0.0, 0.0, value))

    assert drop_of(real) is None
    assert drop_of(beyond) is samples.Drop.IMPLAUSIBLE


# --- a clock that steps ---------------------------------------------------------------------------

MS = 1_000_000


def received(
    step: int = 0, rates_late: int = 0, late: int = 0, lost: int = 0, every: int = 20
) -> tuple[samples.ClockSteps, list[int]]:
    """Return the corrected stamps, ms, of 6 s of a stream beside rates at 100 Hz.

    At 3 s its clock steps. From 3 s to 5 s the rates or the stream arrive later, or it pauses.
    """
    clock, stamps = samples.ClockSteps(), []
    events = [(t + (rates_late if 3000 <= t < 5000 else 0), 0, t) for t in range(0, 6000, 10)]
    for t in range(5, 6000, every):
        happens = 3000 <= t < 5000
        if not 3000 <= t < 3000 + lost:
            arrival = t + (late if happens else 0)
            events.append((arrival, 1, t + (step if t >= 3000 else 0)))
    newest = 0
    for _, kind, t in sorted(events):
        if kind == 0:
            newest = max(newest, t)
        else:
            stamps.append(round(clock.corrected(t * MS, newest * MS) / MS))
    return clock, stamps


@pytest.mark.parametrize("step", [40, 200, 900, -40, -200, -900])
@pytest.mark.parametrize("every", [5, 20, 100])
def test_a_step_of_the_clock_is_corrected(step: int, every: int) -> None:
    clock, stamps = received(step=step, every=every)
    assert len(clock.steps) == 1
    assert clock.steps[0] / MS == pytest.approx(step, abs=10.0)  # interval of the rates
    assert stamps[-5:] == pytest.approx(range(5, 6000, every)[-5:], abs=10.0)


@pytest.mark.parametrize("every", [5, 20, 100])
@pytest.mark.parametrize(
    "what", [{"rates_late": 300}, {"late": 300}, {"lost": 700}, {"late": 300, "lost": 700}], ids=str
)
def test_late_or_lost_messages_are_no_step_of_the_clock(what: dict[str, int], every: int) -> None:
    clock, stamps = received(**what, every=every)
    assert clock.steps == []
    expected = [t for t in range(5, 6000, every) if not 3000 <= t < 3000 + what.get("lost", 0)]
    assert sorted(stamps) == expected


def test_no_step_is_detected_before_the_usual_delay_is_known() -> None:
    clock = samples.ClockSteps()
    for k in range(samples.USUAL):
        t = (k * 20 + 300 * (k > 5)) * MS
        assert clock.corrected(t, k * 20 * MS) == t
