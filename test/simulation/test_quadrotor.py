# SPDX-License-Identifier: Apache-2.0
"""The quadrotor: its control derivatives, identification and control."""

from pathlib import Path

import numpy as np
import pytest
from flying import identified
from loop import Loop

from uav_ident_ros.client import Coefficients, CoefficientSource, Fallback
from uav_ident_ros.control import LAWS, RateController
from uav_ident_ros.files.coefficients_file import load_coefficients
from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.simulation.channels import QUADROTOR
from uav_ident_ros.simulation.cli import main
from uav_ident_ros.simulation.faults import parse_fault
from uav_ident_ros.simulation.flight import Flight
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.noise import Sensors, measure
from uav_ident_ros.simulation.quadrotor_flight import (
    AMPLITUDES,
    Body,
    LiveQuadrotor,
    QuadrotorFlight,
)
from uav_ident_ros.simulation.rate_reference import Manoeuvres

pytest.importorskip("jsbsim", reason="JSBSim is a development extra")


@pytest.mark.parametrize(("name", "of"), [("pdot/da", 0), ("qdot/de", 1), ("rdot/dr", 2)])
def test_the_control_derivatives_follow_from_the_physics(name: str, of: int) -> None:
    small = 1e-6
    craft = LiveQuadrotor(SENSORS)
    inputs = small * np.array([name.endswith(label) for label in INPUTS])
    craft.speeds = craft.motors(inputs).tolist()
    assert craft.loads()[1][of] / small == pytest.approx(craft.body.derivatives()[name], rel=1e-4)


@pytest.fixture(scope="module")
def flight() -> Flight:
    segments = (Segment("multisine", start=2.0, amplitudes=AMPLITUDES, band=(0.2, 4.0)),)
    return QuadrotorFlight(segments, 25.0, 500.0, delay=0.012).fly()


def test_the_true_derivatives_are_identified_in_hover(flight: Flight) -> None:
    sensors = Sensors(rate=250.0, gyro_noise=0.01, accelerometer_noise=0.1)
    identifier, (*_, last) = identified(measure(flight, sensors, 0))
    for name, truth in flight.local_truth.items():
        found = last.coefficients[identifier.structure.index(name)]
        assert found == pytest.approx(truth, rel=0.05), name
    assert np.degrees(np.abs(flight.extra["angles"][:, :2]).max()) < 10.0


def test_simulate_writes_valid_parameters_of_the_quadrotor(tmp_path: Path) -> None:
    bag = tmp_path / "quadrotor"
    assert main(["--output", str(bag), "--plant", "quadrotor", "--duration", "3"]) == 0
    values = load_parameters(bag / "identifier.yaml", "identifier")
    settings = Settings.from_values(values)
    assert settings.actuators.time_constant == Body().time_constant
    assert settings.actuators.channels == QUADROTOR.names
    assert settings.actuators.thrust_curve == (1.0,) * 4


FILES = Path(__file__).resolve().parents[2] / "config" / "closed_loop"
SENSORS = Sensors(rate=100.0, gyro_noise=0.005, accelerometer_noise=0.05)
START_NS = 1_700_000_000 * 10**9


def flown(
    seconds: float,
    *faults: str,
    identifier: OnlineIdentifier | None = None,
    adaptive: bool = False,
) -> FloatArray:
    """Return rates minus reference over time, rad/s, with the coefficients of the files.

    It has the manoeuvres of the loop.
    """
    known = Coefficients.from_file(FILES / "quadrotor_coefficients.yaml")
    controller = load_parameters(FILES / "quadrotor.yaml", "controller")
    limits = np.array([controller["least"], controller["largest"]]) - controller["trim"]
    source = CoefficientSource(Fallback.NOMINAL, known)
    chosen = LAWS[controller.get("law", "incremental")]
    law = RateController(source, known, limits, controller["delay"], chosen, adaptive)
    craft = LiveQuadrotor(SENSORS, 0.01, [parse_fault(text) for text in faults])
    guide = Manoeuvres(bank=0.2, pitch=0.2, hold=(2.0, 4.0), airspeed=1000.0, seed=0)
    loop = Loop(craft, craft.trim, guide, law, identifier)
    errors = []
    while craft.time < seconds:
        sample, reference = loop.answer()
        craft.advance()
        errors.append(sample.rates - reference)
    assert np.ptp(craft.outputs) < 1.0
    return np.array(errors)


@pytest.mark.parametrize("fault", ["9: motor_rear_right", "11.25: motor_front_left"])
def test_the_jerk_of_a_weak_motor_is_no_reversed_input(fault: str) -> None:
    """In these phases of the manoeuvres the controller answers against the jerk at once."""
    end = float(fault.split(":")[0]) + 2.0
    errors = flown(end, f"{fault} effect 0.7", adaptive=True)
    assert np.abs(errors).max() < 1.0


def test_a_weak_motor_is_a_change_of_the_constant_moments_and_is_relearned() -> None:
    """The controller responds with a step of its inputs; no control derivative changes much."""
    values = load_parameters(FILES / "quadrotor.yaml", "identifier")
    settings = Settings.from_values({**values, "imu.convention": "frd"})
    identifier = OnlineIdentifier(
        settings, load_coefficients(FILES / "quadrotor_coefficients.yaml")
    )
    errors = flown(25.0, "20: motor_front_left effect 0.7", identifier=identifier)
    found, names = identifier.coefficient_set().values, identifier.structure
    changed = [
        (change.name, change.t - START_NS * 1e-9) for change in identifier.supervisor.changed
    ]
    # the drag that is lost turns the vehicle far less than the thrust
    assert [name for name, _ in changed] == ["pdot/1", "qdot/1", "rdot/1"]
    assert changed[1][1] < 22.0
    for name, truth in Body().derivatives().items():
        if name[-2:] in ("de", "dr", "da"):  # a quarter of the effect falls to 0.7
            assert found[names.index(name)] == pytest.approx(0.925 * truth, rel=0.15), name
    healthy, after = errors[500:2000], errors[2200:]
    assert np.abs(errors[2000:2100]).max() > 0.2  # the fault has an effect
    assert (rms(after)[:2] < 1.3 * rms(healthy)[:2]).all()


def rms(errors: FloatArray) -> FloatArray:
    return np.sqrt(np.mean(errors**2, axis=0))


def test_motor_commands_follow_the_mixing_and_act_after_the_delay() -> None:
    craft = LiveQuadrotor(Sensors(rate=100.0), delay=0.02)
    assert craft.names == QUADROTOR.names
    craft.command(np.array([0.0, 0.0, 0.02]))
    np.testing.assert_allclose(craft.outputs, [0.49, 0.51, 0.51, 0.49])
    rolls = []
    for _ in range(4):
        craft.advance()
        rolls.append(float(craft.sample().rates[0]))
    assert rolls[1] == pytest.approx(0.0, abs=1e-12) and rolls[2] > 1e-3


def test_the_parameter_and_coefficients_files_are_consistent() -> None:
    values = load_parameters(FILES / "quadrotor.yaml", "identifier")
    settings = Settings.from_values(values)
    known = Coefficients.from_file(FILES / "quadrotor_coefficients.yaml")
    assert known.structure.name == settings.structure
    for name in settings.fixed_coefficients:
        assert known.sigma[known.structure.index(name)] == 0.0
