# SPDX-License-Identifier: Apache-2.0
"""Flights defined by plain values, as they stand in a YAML file or come from options."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from uav_ident_ros.simulation import plant, quadrotor_flight
from uav_ident_ros.simulation.disturbance import ColouredNoise
from uav_ident_ros.simulation.errors import SimulationError
from uav_ident_ros.simulation.flight import CoefficientChange, Flight
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.noise import Measurements, Sensors, measure
from uav_ident_ros.simulation.values import build
from uav_ident_ros.simulation.vehicles import vehicle

QUADROTOR = "quadrotor"
"""The plant that is no structure's."""

_NESTED = {
    "segments": (Segment, "input"),
    "changes": (CoefficientChange, "change"),
    "gusts": (ColouredNoise, "gusts"),
    "force": (ColouredNoise, "force"),
    "autopilot": (plant.Autopilot, "autopilot"),
}

VERSION = 1
"""Part of every key: raised when the same definition gives another flight."""


def build_flight(
    name: str,  # Name of the flight
    # Either ``plant: NAME`` and the fields of `PlantFlight` (those of `QuadrotorFlight` for the
    # `QUADROTOR`), or ``aircraft: NAME`` and those of
    # `uav_ident_ros.simulation.jsbsim_flight.AircraftFlight`; ``inputs`` is the list of segments.
    # ``sensors`` and ``description`` are left to others
    definition: Mapping[str, Any],
    seed: int | None = None,  # Seed of the disturbances instead of the definition's
) -> Flight:
    """Fly what a definition says.

    Raises
    ------
    SimulationError
        If the definition is wrong; the message names the flight and the field.
    """
    try:
        module, spec = flight_spec(definition, seed)
        flight: Flight = module.fly(spec, name)
    except (SimulationError, TypeError) as error:
        raise SimulationError(f"flight '{name}': {error}") from error
    return flight


def flight_spec(definition: Mapping[str, Any], seed: int | None = None) -> tuple[Any, Any]:
    """Return what flies a definition, a module with `fly`, and what it is to fly.

    Raises
    ------
    SimulationError
        If the definition is wrong.
    """
    values = {k: v for k, v in definition.items() if k not in ("sensors", "description")}
    values["segments"] = values.pop("inputs", ())
    if seed is not None:
        values["seed"] = seed
    if ("plant" in values) == ("aircraft" in values):
        raise SimulationError("it must have either 'plant' or 'aircraft'")
    if "aircraft" in values:
        from uav_ident_ros.simulation import jsbsim_flight

        return jsbsim_flight, build(
            jsbsim_flight.AircraftFlight, values, "aircraft flight", _NESTED
        )
    if (name := values.pop("plant")) == QUADROTOR:
        kind = quadrotor_flight.QuadrotorFlight
        return quadrotor_flight, build(kind, values, "quadrotor flight", _NESTED)
    values["vehicle"] = vehicle(name)
    return plant, build(plant.PlantFlight, values, "plant flight", _NESTED)


def build_sensors(definition: Mapping[str, Any], **changes: Any) -> Sensors:
    """Sensors of a definition, with changes by keyword."""
    values = {**definition.get("sensors", {}), **changes}
    sensors: Sensors = build(Sensors, values, "sensors")
    return sensors


def build_measurements(
    name: str, definition: Mapping[str, Any], seed: int | None = None, **sensor_changes: Any
) -> Measurements:
    """Fly and measure what a definition says; `sensor_changes` are fields of `Sensors`."""
    flight = build_flight(name, definition, seed)
    own_seed = definition.get("seed", 0) if seed is None else seed
    return measure(flight, build_sensors(definition, **sensor_changes), own_seed)


def definition_key(definition: Mapping[str, Any], seed: int | None = None) -> str:
    """Hash of what determines a flight, for caches."""
    values = {k: v for k, v in definition.items() if k not in ("sensors", "description")}
    if seed is not None:
        values["seed"] = seed
    text = json.dumps([VERSION, values], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
