# SPDX-License-Identifier: Apache-2.0
"""The gates end to end: what pauses, what stays, and what the node says about it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from flying import AMPLITUDES, plant_flight
from node_process import StartNode
from recordings import MakePlayer, Recording
from sensor_msgs.msg import JointState

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.player import Player
from uav_ident_ros.simulation.disturbance import ColouredNoise
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.noise import Measurements, Sensors, measure
from uav_ident_ros.simulation.plant import Autopilot
from uav_ident_ros.simulation.recording import write_bag
from uav_ident_ros.simulation.vehicles import SMALL_UAV_AUTOPILOT

GROUND, EXCITED, STUCK, LIMITED, GAP, QUIET = (
    (0.0, 6.0), (6.0, 30.0), (30.0, 33.0), (36.0, 37.5), (40.0, 42.0), (46.0, 56.0),
)  # fmt: skip
END = QUIET[1]
GYRO_NOISE = 0.01


def flown(gusts: float, duration: float, seed: int) -> Measurements:
    """Excitation up to the quiet phase, on top of an autopilot, in gusts (rad/s^2)."""
    excitation = Segment("multisine", duration=QUIET[0], amplitudes=AMPLITUDES, seed=1)
    flight = plant_flight(
        duration,
        segments=(excitation,),
        gusts=ColouredNoise(gusts, 0.3),
        autopilot=Autopilot(**SMALL_UAV_AUTOPILOT),
        seed=seed,
    )
    return measure(flight, Sensors(gyro_noise=GYRO_NOISE, stamped=True), seed=seed)


def during(t_ns: np.ndarray, begin: float, end: float) -> np.ndarray:
    t = (t_ns - t_ns[0]) * 1e-9
    return (t >= begin) & (t < end)


def troubled() -> Measurements:
    """A flight with something wrong in every phase."""
    m = flown(0.3, END, seed=2)
    rates, actuators = m.rates.copy(), m.actuators.copy()
    ground = during(m.imu_t_ns, *GROUND)
    rates[ground] = np.random.default_rng(4).normal(0.0, GYRO_NOISE, (ground.sum(), 3))
    rates[during(m.imu_t_ns, *STUCK), 1] = 0.123
    actuators[during(m.actuator_t_ns, *LIMITED), 0] = UPPER_LIMIT
    heard = ~during(m.imu_t_ns, *GAP)
    return replace(
        m,
        rates=rates[heard],
        actuators=actuators,
        imu_t_ns=m.imu_t_ns[heard],
        imu_log_ns=m.imu_log_ns[heard],
        true_t_ns=m.true_t_ns[heard],
        specific_force=m.specific_force[heard],
    )


UPPER_LIMIT = 0.95
"""Limit of every channel, rad or 0 ... 1: beyond what the multisines ask for."""


def recorded(measurements: Measurements, folder: Path) -> Recording:
    write_bag(measurements, folder)
    with Bag(folder) as bag:
        types = {topic: bag.type_of(topic) for topic in ("/imu/data", "/actuators")}
        messages = list(bag.messages(tuple(types)))
    return Recording(messages, types, folder / "identifier.yaml")


@dataclass
class Flown:
    """What the node published last, and said last, at the end of a phase."""

    named: JointState
    state: str
    values: dict[str, str]

    @property
    def coefficients(self) -> dict[str, tuple[float, float]]:
        """Value and sigma by name."""
        both = zip(self.named.position, self.named.effort, strict=True)
        return {n: v for n, v in zip(self.named.name, both, strict=True) if "dot/" in n}

    @property
    def usable(self) -> bool:
        return bool(self.named.position[self.named.name.index("verdict/usable")])


def play(player: Player, flight: Recording, begin: float, end: float, say: str = "") -> Flown:
    """Play a phase and wait until the diagnostics say so."""
    start = flight.messages[0].log_ns
    phase = [m for m in flight.messages if begin * 1e9 <= m.log_ns - start < end * 1e9]
    player.play_in_step(phase)
    player.outputs.status.clear()
    player.wait_until(
        lambda: any(say in s.message for s in player.outputs.status), f"the words '{say}'"
    )
    status = player.outputs.status[-1]
    values = {value.key: value.value for value in status.values}
    return Flown(player.outputs.named[-1], status.message, values)


def moved(before: Flown, after: Flown) -> float:
    """Largest move of a coefficient, in standard deviations of before."""
    return max(
        abs(after.coefficients[name][0] - value) / sigma
        for name, (value, sigma) in before.coefficients.items()
        if sigma > 0.0
    )


def test_each_gate_pauses_keeps_the_coefficients_and_says_why(
    start_node: StartNode, make_player: MakePlayer, tmp_path: Path
) -> None:
    flight = recorded(troubled(), tmp_path / "flight")
    limit = f"[{', '.join([str(UPPER_LIMIT)] * 4)}]"
    start_node(parameter_file=flight.parameter_file, parameters={"actuators.upper_limit": limit})
    player = make_player(flight, clock=False)
    player.wait_for_node()

    ground = play(player, flight, *GROUND, "at rest")
    assert not any(value for value, _ in ground.coefficients.values())
    good = play(player, flight, *EXCITED, "converged")
    assert good.usable
    stuck = play(player, flight, STUCK[0], STUCK[1] - 0.1, "the Imu is stuck: q")
    assert moved(good, stuck) < 1.0
    play(player, flight, STUCK[1] - 0.1, LIMITED[0], "converged")
    limited = play(player, flight, LIMITED[0], LIMITED[1] - 0.1, "is at its limit")
    # The simulated elevator followed none of it, which spoils the fit for a while.
    after = play(player, flight, LIMITED[1] - 0.1, GAP[0])
    assert moved(limited, after) < 2.0
    resumed = play(player, flight, GAP[1], QUIET[0])
    assert moved(after, resumed) < 2.0
    quiet = play(player, flight, *QUIET, "too little excitation")
    assert moved(resumed, quiet) < 2.0


def test_severe_turbulence_under_an_autopilot_moves_nothing(
    start_node: StartNode, make_player: MakePlayer, tmp_path: Path
) -> None:
    calm = flown(0.3, 40.0, seed=2)
    severe = flown(4.0, 85.0, seed=3)
    rough = recorded(severe, tmp_path / "severe")
    flight = recorded(calm, tmp_path / "calm")
    start_node(parameter_file=flight.parameter_file)
    player = make_player(flight, clock=False)
    player.wait_for_node()
    before = play(player, flight, 0.0, 40.0, "converged")
    # The excitation of the second flight is over; its turbulence goes on.
    after = play(player, rough, 55.0, 85.0, "")
    assert moved(before, after) < 2.0
    assert after.coefficients.keys() == before.coefficients.keys()
