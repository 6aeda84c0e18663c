# SPDX-License-Identifier: Apache-2.0
"""The delay is found where the flight shows it, and nowhere else."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flying import AMPLITUDES, Message, errors, messages, plant_flight, run, settings, worst

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.identification.delay import (
    NEIGHBOURHOOD,
    SMALLEST_MOVE,
    DelayBank,
)
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.settings import Settings, SettingsError
from uav_ident_ros.messages.types import header_ns
from uav_ident_ros.simulation.disturbance import ColouredNoise
from uav_ident_ros.simulation.flight import Flight
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.noise import Sensors, measure
from uav_ident_ros.simulation.plant import Autopilot
from uav_ident_ros.simulation.vehicles import SMALL_UAV_AUTOPILOT

NOISY = Sensors(gyro_noise=0.02, accelerometer_noise=0.1)
REAL_FLIGHT = Path(__file__).resolve().parents[3] / "shared" / "bags" / "thor75_auto"


def found(flight: Flight, sensors: Sensors = NOISY, **changes: Any) -> OnlineIdentifier:
    m = measure(flight, sensors)
    values = {"actuators__delay": 0.0, "actuators__estimate_delay": True, **changes}
    identifier = OnlineIdentifier(settings(m, estimator="least_squares", **values))
    run(identifier, messages(m))
    return identifier


@pytest.mark.parametrize("delay", [0.0, 0.03, 0.06, 0.12, 0.2])
def test_delays_are_found_within_five_milliseconds(delay: float) -> None:
    identifier = found(plant_flight(25.0, delay=delay))
    assert identifier.delay == pytest.approx(delay, abs=0.005)
    assert identifier.delay_confidence == "sure"
    assert identifier.delay_sigma < 0.005


@pytest.mark.parametrize("rate", [20.0, 50.0, 1000.0])
def test_at_any_rate_of_the_imu(rate: float) -> None:
    flight = plant_flight(25.0, delay=0.06, rate=1000.0, max_step=1e-3)
    identifier = found(flight, Sensors(rate=rate, gyro_noise=0.01))
    assert identifier.delay == pytest.approx(0.06, abs=0.01)


def test_in_gusts_under_an_autopilot() -> None:
    autopilot = Autopilot(**SMALL_UAV_AUTOPILOT)
    flight = plant_flight(40.0, delay=0.06, gusts=ColouredNoise(0.3, 0.3), autopilot=autopilot)
    assert found(flight).delay == pytest.approx(0.06, abs=0.01)


def test_a_wrong_start_is_corrected() -> None:
    identifier = found(plant_flight(25.0, delay=0.02), actuators__delay=0.1)
    assert identifier.delay == pytest.approx(0.02, abs=0.005)


@pytest.mark.parametrize("gusts", [0.0, 0.3, 1.0])
def test_without_excitation_it_says_nothing(gusts: float) -> None:
    """The autopilot's answers to gusts tell of the autopilot, not of the delay."""
    flight = plant_flight(
        90.0,
        segments=(),
        delay=0.06,
        gusts=ColouredNoise(gusts, 0.3),
        autopilot=Autopilot(**SMALL_UAV_AUTOPILOT),
    )
    identifier = found(flight, actuators__delay=0.04)
    assert identifier.delay == 0.04
    assert identifier.delay_confidence != "sure"


def test_nothing_is_known_before_there_are_data() -> None:
    identifier = OnlineIdentifier(Settings.from_values({"actuators.estimate_delay": True}))
    assert (identifier.delay, identifier.delay_confidence) == (0.0, "none")
    assert identifier.delay_sigma == math.inf


def test_the_papers_differences_cannot_show_a_delay() -> None:
    with pytest.raises(SettingsError, match="state_variable") as caught:
        Settings.from_values(
            {
                "actuators.estimate_delay": True,
                "filter.method": "backward_difference",
                "estimator": "gradient",
                "structure": "baseline",
            }
        )
    assert caught.value.name == "actuators.estimate_delay"


def test_without_the_setting_nothing_moves() -> None:
    m = measure(plant_flight(15.0, delay=0.06), NOISY)
    identifier = OnlineIdentifier(settings(m, actuators__delay=0.02))
    run(identifier, messages(m))
    assert identifier.delay == 0.02
    assert identifier.delay_confidence == "none"


def test_what_was_learned_with_the_wrong_delay_does_not_stay() -> None:
    flight = plant_flight(45.0, delay=0.06)
    identifier = found(flight, Sensors(), structure="throttle_coupled")
    a = identifier._estimator.coefficients
    names = ("pdot/p", "pdot/da", "qdot/q", "qdot/de", "rdot/r", "rdot/dr")
    assert worst(errors(a, "throttle_coupled", flight, names)) < 0.03


def test_the_coefficients_do_not_jump_wildly_when_the_delay_moves() -> None:
    m = measure(plant_flight(25.0, delay=0.06), NOISY)
    identifier = OnlineIdentifier(
        settings(m, estimator="least_squares", actuators__delay=0.0, actuators__estimate_delay=True)
    )
    moved, before, largest = False, np.zeros(0), 0.0
    truth = np.abs(m.flight.coefficients).max(axis=1, keepdims=True)  # type: ignore[arg-type]
    for message in messages(m):
        estimates = run(identifier, [message])
        for estimate in estimates:
            if moved:
                largest = max(largest, float((np.abs(estimate.coefficients) / truth).max()))
            before = estimate.coefficients
        moved = moved or identifier.delay > 0.0
    assert moved and len(before)
    assert largest < 2.0


def test_the_delay_survives_a_gap_and_a_new_time_base() -> None:
    m = measure(plant_flight(30.0, delay=0.06), NOISY)
    start = int(m.imu_t_ns[0])
    identifier = OnlineIdentifier(settings(m, actuators__delay=0.0, actuators__estimate_delay=True))

    def broken(message: Message) -> Message:
        after = message.t_ns - start
        if after > 20e9:
            return message._replace(t_ns=message.t_ns + 3600 * 10**9)
        return message

    kept = [m for m in messages(m) if not 9e9 < m.t_ns - start < 9.6e9]
    run(identifier, [broken(message) for message in kept])
    assert identifier.delay == pytest.approx(0.06, abs=0.01)


def test_a_cold_start_forgets_the_delay() -> None:
    identifier = found(plant_flight(20.0, delay=0.06))
    assert identifier.delay > 0.05
    identifier.reset()
    assert identifier.delay == 0.0
    assert identifier.delay_confidence == "none"


def test_the_bank_is_the_batch_solution() -> None:
    """Recursion, sharing and memory change nothing: residuals against plain least squares."""
    cells, h = 2000, 0.005
    rng = np.random.default_rng(1)
    x, u = rng.normal(size=(cells + 1, 3)).cumsum(axis=0) * 0.05, rng.normal(size=(cells, 4))
    force = rng.normal(size=(cells + 1, 3))
    bank = DelayBank(h, np.zeros(3))
    for k in range(0, cells, 10):
        block = Block(
            np.arange(k, k + 11) * 5_000_000,
            h,
            x[k : k + 11],
            u[k : k + 10],
            u[k : k + 10],
            force[k : k + 11],
            k == 0,
        )
        bank.add(block)
    _, residual = bank._solve()
    whole = DelayBank(h, np.zeros(3))
    whole._chunk = cells + 1  # never absorbs: only its filter is used
    whole.add(Block(np.arange(cells + 1) * 5_000_000, h, x, u, u, force, True))
    signals = whole._signals[0]
    first = len(whole._history) + 64  # the same settling: 8 / 25 rad/s in cells of 5 ms
    ends = np.concatenate([_used(k, first) for k in range(0, cells, 200)])
    weight = np.exp(-0.5 * (cells / 200 - 1 - ends // 200) / 120.0)
    for j, lag in ((0, 0), (7, 14), (30, 60)):
        for i, columns in enumerate(_ROWS):
            inputs = [11 + 3 + c - 8 for c in columns if 8 <= c < 12]
            shared = [c if c < 8 else c - 4 for c in columns if c < 8 or c >= 12]
            f = np.hstack([signals[ends][:, shared], signals[ends - lag][:, inputs]])
            y = signals[ends][:, 11 + i]
            a, *_ = np.linalg.lstsq(f * weight[:, None], y * weight, rcond=None)
            expected = float((((y - f @ a) * weight) ** 2).sum())
            assert residual[j, i] == pytest.approx(expected, rel=1e-5)


_ROLL = (0, 1, 5, 7, 9, 10, 11, 12, 13)
_ROWS = (_ROLL, (2, 3, 4, 6, 8, 11, 12, 14), _ROLL)


def _used(start: int, first: int) -> np.ndarray:
    """Samples of a chunk that a bank with steps of 10 ms takes, past its settling."""
    begin = start + min(max(first - start, 0), 200)
    return np.arange(begin, start + 200, 2)


def test_small_differences_are_left_alone() -> None:
    identifier = found(plant_flight(25.0, delay=0.06), actuators__delay=0.06 - 0.8 * SMALLEST_MOVE)
    assert identifier.delay == 0.06 - 0.8 * SMALLEST_MOVE
    assert NEIGHBOURHOOD > SMALLEST_MOVE


def test_pulses_show_the_delay_too() -> None:
    segment = Segment("3211", start=1.0, unit=0.4, amplitudes=AMPLITUDES)
    identifier = found(plant_flight(45.0, segments=(segment,), delay=0.06))
    assert identifier.delay == pytest.approx(0.06, abs=0.005)


@pytest.mark.skipif(not REAL_FLIGHT.exists(), reason=f"there is no {REAL_FLIGHT.name}")
def test_the_real_flight_has_70_to_80_milliseconds() -> None:
    identifier = OnlineIdentifier(
        Settings.from_values(
            {"actuators.estimate_delay": True, "actuators.interpolation": "linear"}
        )
    )
    with Bag(REAL_FLIGHT) as bag:
        decode = {topic: bag.decoder(topic) for topic in ("/imu/data", "/actuators")}
        stream = []
        for message in bag.messages(decode):
            content = decode[message.topic](message.data)
            if message.topic == "/imu/data":
                rate, force = content.angular_velocity, content.linear_acceleration
                values = (rate.x, rate.y, rate.z, force.x, force.y, force.z)
                stream.append(Message(message.log_ns, "rates", header_ns(content), values))
            else:
                own = tuple(content.data.tolist())
                stream.append(Message(message.log_ns, "actuators", message.log_ns, own))
    run(identifier, stream)
    assert 0.07 <= identifier.delay <= 0.08
    assert identifier.delay_confidence == "sure"
