# SPDX-License-Identifier: Apache-2.0
"""Every ready configuration loads, says what to enable, and means what it says."""

from pathlib import Path

import numpy as np
import pytest

from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.gates import LimitGate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.inputs import InputMap
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.messages.types import ACTUATORS, ActuatorReader, frame_fault
from uav_ident_ros.simulation.channels import QUADROTOR

CONFIG = Path(__file__).resolve().parents[1] / "config"
GENERAL = ("identifier", "paper_2006")
VEHICLES = sorted(path for path in CONFIG.glob("*.yaml") if path.stem not in GENERAL)


def settings(name: str) -> Settings:
    return Settings.from_values(load_parameters(CONFIG / f"{name}.yaml", "/identifier"))


def inputs(name: str, **raw: float) -> FloatArray:
    """Return de, dr, da, dth where channels, by position as ``c0``, are off trim by the values."""
    actuators = settings(name).actuators
    mapping = InputMap(actuators)
    values = mapping.trim.copy()
    for key, value in raw.items():
        values[int(key[1:])] += value
    return mapping.apply(values)


@pytest.mark.parametrize("path", sorted(CONFIG.glob("*.yaml")), ids=lambda path: path.stem)
def test_it_loads_and_the_identifier_takes_it(path: Path) -> None:
    values = load_parameters(path, "/drone1/identifier")
    assert values
    OnlineIdentifier(Settings.from_values(values))


@pytest.mark.parametrize("path", VEHICLES, ids=lambda path: path.stem)
def test_its_types_fields_and_axes_agree(path: Path) -> None:
    own = settings(path.stem)
    ActuatorReader(own.actuators)  # field and named channels are checked against the type
    assert ACTUATORS[own.actuators.type]
    assert frame_fault(own.imu.convention, "base_link", own.imu.type) == ""
    text = path.read_text(encoding="utf-8")
    assert "nable" in text.split("/**:")[0], "what to enable on the autopilot"


def is_normalised(name: str) -> bool:
    return "normalised" in ACTUATORS[settings(name).actuators.type].unit


def test_only_normalised_commands_have_a_range_that_is_known_beforehand() -> None:
    limited = {path.stem for path in VEHICLES if settings(path.stem).actuators.lower_limit}
    assert limited == {path.stem for path in VEHICLES if is_normalised(path.stem)} != set()


@pytest.mark.parametrize("name", [path.stem for path in VEHICLES if is_normalised(path.stem)])
def test_limits_fit_the_channels_and_stop_what_is_wild(name: str) -> None:
    actuators = settings(name).actuators
    low, high = np.array(actuators.lower_limit), np.array(actuators.upper_limit)
    assert len(low) == len(high) == len(actuators.channels)
    assert (low >= -1.0).all() and (high <= 1.0).all()
    gate = LimitGate(actuators)
    inside = np.vstack([actuators.trim, low + 0.01, high - 0.01])
    assert gate.check(inside) == ""
    for i, channel in enumerate(actuators.channels):
        for wild in (low[i], high[i], -10.0, 10.0):
            raw = np.array([actuators.trim])
            raw[0, i] = wild
            assert gate.check(raw) == f"channel {channel} is at its limit"


@pytest.mark.parametrize("name", ["px4", "mavros"])
def test_pulse_widths_become_radians(name: str) -> None:
    assert settings(name).actuators.channels == (1, 3, 0, 2)
    np.testing.assert_allclose(inputs(name, c0=100.0), [0.1, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(inputs(name, c1=-200.0), [0.0, -0.2, 0.0, 0.0])
    np.testing.assert_allclose(inputs(name, c2=100.0, c3=250.0), [0.0, 0.0, 0.1, 0.25])


def test_elevons_together_pitch_and_against_each_other_roll() -> None:
    together, against = (inputs("mavros_elevon", c0=100.0, c1=c) for c in (-100.0, 100.0))
    np.testing.assert_allclose(together, [0.1, 0, 0, 0], atol=1e-15)
    np.testing.assert_allclose(against, [0, 0, 0.1, 0], atol=1e-15)


@pytest.mark.parametrize("name", ["px4_quadrotor", "gazebo_quadrotor"])
def test_motors_are_mixed_as_in_the_simulation(name: str) -> None:
    actuators = settings(name).actuators
    mixing = InputMap(actuators).matrix / np.array(actuators.scale or (1.0,) * 4)
    np.testing.assert_allclose(mixing, QUADROTOR.mixing, atol=1e-12)


def test_ailerons_of_the_gazebo_model_roll_right() -> None:
    np.testing.assert_allclose(inputs("gazebo", c2=0.2, c3=-0.2), [0, 0, 0.2, 0], atol=1e-15)
