# SPDX-License-Identifier: Apache-2.0
"""Flights defined by plain values, as they stand in a YAML file or come from options."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Any

from uav_ident_ros.simulation import quadrotor
from uav_ident_ros.simulation.disturbance import ColouredNoise
from uav_ident_ros.simulation.errors import SimulationError
from uav_ident_ros.simulation.flight import CoefficientChange, Flight
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.noise import Measurements, Sensors, measure
from uav_ident_ros.simulation.plant import Autopilot, PlantFlight, fly
from uav_ident_ros.simulation.vehicles import vehicle

QUADROTOR = "quadrotor"
"""The plant that is no structure's."""

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
    values = {k: v for k, v in definition.items() if k not in ("sensors", "description")}
    if seed is not None:
        values["seed"] = seed
    kinds = [kind for kind in ("plant", "aircraft") if kind in values]
    if len(kinds) != 1:
        raise SimulationError(f"flight '{name}' must have either 'plant' or 'aircraft'")
    try:
        if values.get("plant") == QUADROTOR:
            return quadrotor.fly(_quadrotor_flight(values), name)
        if kinds == ["plant"]:
            return fly(_plant_flight(values), name)
        from uav_ident_ros.simulation import jsbsim_flight

        return jsbsim_flight.fly(_aircraft_flight(values), name)
    except (SimulationError, TypeError) as error:
        raise SimulationError(f"flight '{name}': {error}") from error


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


def build(cls: Any, values: Mapping[str, Any], where: str) -> Any:
    """Build a dataclass from a mapping; lists become tuples.

    Raises
    ------
    SimulationError
        If a name is no field of it.
    """
    known = [item.name for item in dataclasses.fields(cls)]
    for key in values:
        if key not in known:
            raise SimulationError(f"{where} has no '{key}': fields are {', '.join(known)}")
    return cls(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})


def _common(values: Mapping[str, Any]) -> dict[str, Any]:
    out = {k: v for k, v in values.items() if k not in ("inputs", "changes")}
    out["segments"] = tuple(build(Segment, s, "input") for s in values.get("inputs", ()))
    out["changes"] = tuple(build(CoefficientChange, c, "change") for c in values.get("changes", ()))
    return out


def _plant_flight(values: Mapping[str, Any]) -> PlantFlight:
    out = _common(values)
    out["vehicle"] = vehicle(out.pop("plant"))
    for name in ("gusts", "force"):
        if name in out:
            out[name] = build(ColouredNoise, out[name], name)
    if "autopilot" in out:
        out["autopilot"] = build(Autopilot, out["autopilot"], "autopilot")
    flight: PlantFlight = build(PlantFlight, out, "plant flight")
    return flight


def _quadrotor_flight(values: Mapping[str, Any]) -> quadrotor.QuadrotorFlight:
    out = {k: v for k, v in _common(values).items() if k not in ("plant", "changes")}
    if "gusts" in out:
        out["gusts"] = build(ColouredNoise, out["gusts"], "gusts")
    flight: quadrotor.QuadrotorFlight = build(quadrotor.QuadrotorFlight, out, "quadrotor flight")
    return flight


def _aircraft_flight(values: Mapping[str, Any]) -> Any:
    from uav_ident_ros.simulation.jsbsim_flight import AircraftFlight

    return build(AircraftFlight, _common(values), "aircraft flight")
