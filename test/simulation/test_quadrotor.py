# SPDX-License-Identifier: Apache-2.0
"""The quadrotor: its physics by hand, and that the identifier finds what it is."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from flying import identify

from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.simulation.channels import QUADROTOR
from uav_ident_ros.simulation.cli import main
from uav_ident_ros.simulation.errors import SimulationError
from uav_ident_ros.simulation.flight import GRAVITY, Flight
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.noise import Sensors, measure
from uav_ident_ros.simulation.quadrotor import Body, Quadrotor
from uav_ident_ros.simulation.quadrotor_flight import AMPLITUDES, QuadrotorFlight, fly

STILL = (0.0, 0.0, 0.0)
H = 1e-3
CONFIG = Path(__file__).resolve().parents[2] / "config"


def hovering(**inputs: float) -> tuple[Quadrotor, list[float]]:
    """A quadrotor in hover, and its motors' commands for small inputs."""
    craft = Quadrotor(Body())
    values = [inputs.get(name, 0.0) for name in ("de", "dr", "da", "dth")]
    trim = np.array([0.0, 0.0, 0.0, craft.body.hover])
    return craft, QUADROTOR.raw(np.array(values), trim).tolist()


def test_it_hovers_where_it_is() -> None:
    craft, commands = hovering()
    for _ in range(1000):
        craft.step(commands, H, STILL)
    assert craft.force == pytest.approx([0.0, 0.0, -GRAVITY])
    assert max(map(abs, (*craft.rates, *craft.velocity, craft.down))) < 1e-12


def test_motors_follow_with_their_lag() -> None:
    craft, commands = hovering(dth=0.1)
    for _ in range(round(craft.body.time_constant / H)):
        craft.step(commands, H, STILL)
    assert craft.speeds == pytest.approx([0.5 + 0.1 * (1.0 - math.exp(-1.0))] * 4)


@pytest.mark.parametrize(("name", "of"), [("pdot/da", 0), ("qdot/de", 1), ("rdot/dr", 2)])
def test_the_control_derivatives_are_those_of_the_physics(name: str, of: int) -> None:
    small = 1e-6
    craft, commands = hovering(**{name.partition("/")[2]: small})
    craft.speeds = commands
    craft.look(STILL)
    assert craft.acceleration[of] / small == pytest.approx(craft.body.derivatives()[name], rel=1e-4)


@pytest.mark.parametrize(("name", "of"), [("pdot/p", 0), ("qdot/q", 1)])
def test_turning_rotors_damp(name: str, of: int) -> None:
    craft, _ = hovering()
    craft.rates[of] = 1e-3
    craft.look(STILL)
    assert craft.acceleration[of] * 1e3 == pytest.approx(craft.body.derivatives()[name])


def test_falling_free_it_feels_drag_alone_and_keeps_its_energy_without() -> None:
    """Motors off, no drag: specific force zero, and the velocity that of a stone."""
    craft = Quadrotor(Body(drag=0.0, inflow=0.0))
    craft.rates, craft.speeds = [0.3, -0.2, 0.5], [0.0] * 4
    for _ in range(1000):
        craft.step([0.0] * 4, H, STILL)
    assert craft.force == [0.0, 0.0, 0.0]
    assert craft.sinking == pytest.approx(GRAVITY, rel=1e-4)
    assert craft.down == pytest.approx(0.5 * GRAVITY, rel=1e-4)


@pytest.fixture(scope="module")
def flight() -> Flight:
    segments = (Segment("multisine", start=2.0, amplitudes=AMPLITUDES, band=(0.2, 4.0)),)
    return fly(QuadrotorFlight(segments, 40.0, delay=0.012))


def test_it_is_identified_from_hover(flight: Flight) -> None:
    sensors = Sensors(rate=200.0, gyro_noise=0.01, accelerometer_noise=0.1, channels="quadrotor")
    identifier, coefficients = identify(measure(flight, sensors, 0))
    for name, truth in flight.local_truth.items():
        found = coefficients[identifier.structure.index(name)]
        assert found == pytest.approx(truth, rel=0.05), name
    assert np.degrees(np.abs(flight.extra["angles"][:, :2]).max()) < 10.0


def test_a_lost_one_ends_the_flight_with_a_word() -> None:
    wild = (Segment("multisine", amplitudes={"da": 0.9}),)
    with pytest.raises(SimulationError, match="lost at"):
        fly(QuadrotorFlight(wild, 20.0, delay=0.2))
    with pytest.raises(SimulationError, match=r"delay 0\.0005 s is no whole number"):
        QuadrotorFlight((), 1.0, delay=0.0005)


def test_the_command_flies_it_and_its_parameters_are_accepted(tmp_path: Path) -> None:
    bag = tmp_path / "quadrotor"
    assert main(["--output", str(bag), "--plant", "quadrotor", "--duration", "3"]) == 0
    values = load_parameters(bag / "identifier.yaml", "identifier")
    settings = Settings.from_values(values)
    assert settings.actuators.time_constant == Body().time_constant
    assert settings.actuators.channels == QUADROTOR.names
    assert settings.actuators.thrust_curve == (1.0,) * 4
