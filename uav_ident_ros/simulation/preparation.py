# SPDX-License-Identifier: Apache-2.0
"""Preparation of an aircraft for the loop: trim, excitation, identification.

The identifier runs over `EXCITED_TIME` of multisines, as in a first flight. Its coefficients become
the nominal set of the controller, and the initial ones of the identifier in the loop.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from uav_ident_ros.files.coefficients_file import save_coefficients
from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import INPUTS, FloatArray
from uav_ident_ros.share import shared
from uav_ident_ros.simulation.airframe import Airframe, airframe
from uav_ident_ros.simulation.flight import EPOCH_NS, SimulationError
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.jsbsim_flight import AircraftFlight, LiveAircraft
from uav_ident_ros.simulation.noise import Sensors, fed, measure
from uav_ident_ros.simulation.recording import parameters, yaml_text

CONFIG = shared("config/closed_loop")
"""Folder of the aircraft that are already identified."""

EXCITED_TIME = 90.0
"""Length of the identification flight, s."""

SENSORS = Sensors(
    rate=100.0, gyro_noise=0.005, accelerometer_noise=0.05, airspeed_noise=0.3, airspeed_bias=0.3
)
"""Sensors of that flight and in the loop: a MEMS Imu after its low-pass, and a pitot tube."""

EXCITED_SHARE = 0.1
"""Excitation in the loop, relative to half of the travel of each surface."""

BETWEEN_FLIGHTS = 0.2
"""Relative variation of a coefficient between flights, by load and weather. It is added to the
sigmas of the initial coefficients."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """An aircraft ready for the loop."""

    aircraft: str  # Its name, or the path of its file
    airframe: Airframe  # Its airframe, at the speed flown
    trim: FloatArray  # (4,) Elevator, rudder, aileron (rad) and throttle in steady flight
    limits: FloatArray  # (2, 4) Lower and upper limits of them
    coefficients: CoefficientSet  # As identified, sigmas widened


def prepare(
    name: str,  # As in `uav_ident_ros.simulation.airframe`
    speed: float | None = None,  # True airspeed in place of the airframe's, m/s
    time: float = EXCITED_TIME,  # Length of the identification flight, s
) -> Prepared:
    """Trim, excite and identify an aircraft."""
    frame = airframe(name, speed)
    segment = Segment("multisine", start=2.0, amplitudes=frame.excitation)
    m = measure(AircraftFlight((segment,), time, aircraft=name, speed=speed).fly(), SENSORS)
    settings = Settings.from_values(parameters(m) | {"airspeed.reference": frame.speed})
    identifier = OnlineIdentifier(settings)
    if not list(fed(identifier, m.messages())):
        raise SimulationError("the flight is too short to identify anything")
    found = identifier.coefficient_set()
    sigma = np.hypot(found.sigma, BETWEEN_FLIGHTS * np.abs(found.values))
    sigma = np.where(found.sigma > 0.0, sigma, 0.0)
    coefficients = CoefficientSet(found.structure, found.values, sigma, EPOCH_NS)
    live = LiveAircraft(name, SENSORS, speed=speed)
    return Prepared(name, frame, live.trim, live.aircraft.limits, coefficients)


def write(prepared: Prepared, folder: Path) -> None:
    """Write ``NAME_coefficients.yaml``, and ``NAME.yaml``, the parameters of all nodes.

    They are those of the c172p, adapted to the aircraft.
    """
    frame = prepared.airframe
    trim, least, largest = (v.tolist() for v in (prepared.trim, *prepared.limits))
    added = EXCITED_SHARE * 0.5 * (prepared.limits[1] - prepared.limits[0])
    added[INPUTS.index("dth")] = 0.0
    own: dict[str, dict[str, Any]] = {
        "identifier": {
            "structure": prepared.coefficients.structure,
            "actuators.trim": trim,
            "airspeed.reference": frame.speed,
            "excitation.amplitude": added.tolist(),
        },
        "controller": {
            "trim": trim,
            "least": least,
            "largest": largest,
            "excitation_limit": (1.2 * added).tolist(),
        },
        "simulated_plant": {"aircraft": prepared.aircraft, "speed": frame.speed},
        "rate_reference": {"airspeed": frame.speed},
    }
    nodes = yaml.safe_load((CONFIG / "c172p.yaml").read_text(encoding="utf-8"))
    for name, values in own.items():
        nodes[f"/**/{name}"]["ros__parameters"] |= values
    where = f"{frame.name} at {frame.speed:.1f} m/s and {frame.altitude:.0f} m"
    folder.mkdir(parents=True, exist_ok=True)
    save_coefficients(prepared.coefficients, folder / f"{frame.name}_coefficients.yaml")
    text = yaml_text(nodes, f"The closed loop of {where}.")
    (folder / f"{frame.name}.yaml").write_text(text, encoding="utf-8")
