# SPDX-License-Identifier: Apache-2.0
"""Every shipped configuration loads, names what to enable, and maps its channels correctly."""

from pathlib import Path

import numpy as np
import pytest

from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.gates import at_limit
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.sampling import InputMap
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.messages.types import ACTUATOR_ADAPTERS, ActuatorReader, frame_fault
from uav_ident_ros.simulation.channels import QUADROTOR

CONFIG = Path(__file__).resolve().parents[1] / "config"
GENERAL = ("identifier", "paper_2006")
VEHICLES = sorted(path for path in CONFIG.glob("*.yaml") if path.stem not in GENERAL)


def settings(name: str) -> Settings:
    return Settings.from_values(load_parameters(CONFIG / f"{name}.yaml", "/identifier"))


@pytest.mark.parametrize("path", sorted(CONFIG.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_configuration_loads_and_is_valid_for_the_identifier(path: Path) -> None:
    values = load_parameters(path, "/drone1/identifier")
    assert values
    OnlineIdentifier(Settings.from_values(values))


@pytest.mark.parametrize("path", VEHICLES, ids=lambda path: path.stem)
def test_types_fields_and_axes_of_a_configuration_are_consistent(path: Path) -> None:
    own = settings(path.stem)
    ActuatorReader(own.actuators)  # field and named channels are checked against the type
    assert ACTUATOR_ADAPTERS[own.actuators.type]
    assert frame_fault(own.imu.convention, "base_link", own.imu.type) == ""
    text = path.read_text(encoding="utf-8")
    assert "nable" in text.split("/**:")[0], "what to enable on the autopilot"
    has_flow = OnlineIdentifier(own).structure.has_flow
    assert has_flow == ("airspeed.reference" in text), "what the flow angles need"


def is_normalised(name: str) -> bool:
    return "normalised" in ACTUATOR_ADAPTERS[settings(name).actuators.type].unit


def test_only_normalised_commands_have_configured_limits() -> None:
    limited = {path.stem for path in VEHICLES if settings(path.stem).actuators.lower_limit}
    assert limited == {path.stem for path in VEHICLES if is_normalised(path.stem)} != set()


@pytest.mark.parametrize("name", [path.stem for path in VEHICLES if is_normalised(path.stem)])
def test_limits_match_the_channels_and_detect_values_beyond(name: str) -> None:
    actuators = settings(name).actuators
    low, high = np.array(actuators.lower_limit), np.array(actuators.upper_limit)
    assert len(low) == len(high) == len(actuators.channels)
    assert (low >= -1.0).all() and (high <= 1.0).all()
    inside = np.vstack([actuators.trim, low + 0.01, high - 0.01])
    assert at_limit(inside, actuators) == ""
    for i, channel in enumerate(actuators.channels):
        for wild in (low[i], high[i], -10.0, 10.0):
            raw = np.array([actuators.trim])
            raw[0, i] = wild
            assert at_limit(raw, actuators) == f"channel {channel} is at its limit"


@pytest.mark.parametrize(
    ("name", "raw", "expected"),
    [
        # pulse widths become radians
        *((name, {0: 100.0, 1: -200.0}, [0.1, -0.2, 0.0, 0.0]) for name in ("px4", "mavros")),
        *((name, {2: 100.0, 3: 250.0}, [0.0, 0.0, 0.1, 0.25]) for name in ("px4", "mavros")),
        # symmetric elevons pitch, antisymmetric elevons roll
        ("mavros_elevon", {0: 100.0, 1: -100.0}, [0.1, 0.0, 0.0, 0.0]),
        ("mavros_elevon", {0: 100.0, 1: 100.0}, [0.0, 0.0, 0.1, 0.0]),
        ("gazebo", {2: 0.2, 3: -0.2}, [0.0, 0.0, 0.2, 0.0]),  # ailerons roll right
    ],
)
def test_deviations_from_trim_map_to_the_inputs(
    name: str, raw: dict[int, float], expected: list[float]
) -> None:
    """Channels are given by position."""
    mapping = InputMap(settings(name).actuators)
    values = mapping.trim.copy()
    values[list(raw)] += list(raw.values())
    np.testing.assert_allclose(mapping.apply(values), expected, atol=1e-15)


def test_pulse_widths_have_the_channel_order_of_the_airframe() -> None:
    assert {settings(name).actuators.channels for name in ("px4", "mavros")} == {(1, 3, 0, 2)}


@pytest.mark.parametrize("name", ["px4_quadrotor", "gazebo_quadrotor"])
def test_motors_have_the_mixing_of_the_simulation(name: str) -> None:
    actuators = settings(name).actuators
    mixing = InputMap(actuators).matrix / np.array(actuators.scale or (1.0,) * 4)
    np.testing.assert_allclose(mixing, QUADROTOR.mixing, atol=1e-12)
