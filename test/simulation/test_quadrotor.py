# SPDX-License-Identifier: Apache-2.0
"""The quadrotor: its physics by hand, and that the identifier finds what it is."""

from pathlib import Path

import numpy as np
import pytest
from flying import identified

from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.simulation.channels import QUADROTOR
from uav_ident_ros.simulation.cli import main
from uav_ident_ros.simulation.flight import Flight
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.noise import Sensors, measure
from uav_ident_ros.simulation.quadrotor_flight import AMPLITUDES, Body, Quadrotor, QuadrotorFlight


def hovering(**inputs: float) -> tuple[Quadrotor, list[float]]:
    """A quadrotor in hover, and its motors' commands for small inputs."""
    craft = Quadrotor(Body())
    values = [inputs.get(name, 0.0) for name in ("de", "dr", "da", "dth")]
    trim = np.array([0.0, 0.0, 0.0, craft.body.hover])
    return craft, QUADROTOR.raw(np.array(values), trim).tolist()


@pytest.mark.parametrize(("name", "of"), [("pdot/da", 0), ("qdot/de", 1), ("rdot/dr", 2)])
def test_the_control_derivatives_are_those_of_the_physics(name: str, of: int) -> None:
    small = 1e-6
    craft, commands = hovering(**{name.partition("/")[2]: small})
    craft.speeds = commands
    assert craft.loads()[1][of] / small == pytest.approx(craft.body.derivatives()[name], rel=1e-4)


@pytest.fixture(scope="module")
def flight() -> Flight:
    segments = (Segment("multisine", start=2.0, amplitudes=AMPLITUDES, band=(0.2, 4.0)),)
    return QuadrotorFlight(segments, 25.0, delay=0.012).fly()


def test_it_is_identified_from_hover(flight: Flight) -> None:
    sensors = Sensors(rate=200.0, gyro_noise=0.01, accelerometer_noise=0.1, channels="quadrotor")
    identifier, (*_, last) = identified(measure(flight, sensors, 0))
    for name, truth in flight.local_truth.items():
        found = last.coefficients[identifier.structure.index(name)]
        assert found == pytest.approx(truth, rel=0.05), name
    assert np.degrees(np.abs(flight.extra["angles"][:, :2]).max()) < 10.0


def test_the_command_flies_it_and_its_parameters_are_accepted(tmp_path: Path) -> None:
    bag = tmp_path / "quadrotor"
    assert main(["--output", str(bag), "--plant", "quadrotor", "--duration", "3"]) == 0
    values = load_parameters(bag / "identifier.yaml", "identifier")
    settings = Settings.from_values(values)
    assert settings.actuators.time_constant == Body().time_constant
    assert settings.actuators.channels == QUADROTOR.names
    assert settings.actuators.thrust_curve == (1.0,) * 4
