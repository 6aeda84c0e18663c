# SPDX-License-Identifier: Apache-2.0
"""The flights of `flights.yaml`, flown at their first use and cached if that took long.

``python benchmarks/flights.py`` lists them; ``python benchmarks/flights.py NAME ...`` flies the
named ones and prints their results.
"""

import hashlib
import json
import os
import pickle
import tempfile
import time
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import bench
import yaml

from uav_ident_ros import simulation
from uav_ident_ros.identification import waveforms
from uav_ident_ros.simulation.airframe import build
from uav_ident_ros.simulation.faults import Fault
from uav_ident_ros.simulation.flight import CoefficientChange, Flight, SimulationError
from uav_ident_ros.simulation.inputs import ColouredNoise, Segment
from uav_ident_ros.simulation.jsbsim_flight import AircraftFlight
from uav_ident_ros.simulation.live import Plan
from uav_ident_ros.simulation.noise import Measurements, Sensors, measure
from uav_ident_ros.simulation.plant import VEHICLES, PlantFlight
from uav_ident_ros.simulation.quadrotor_flight import NAME as QUADROTOR
from uav_ident_ros.simulation.quadrotor_flight import QuadrotorFlight

DEFINITIONS = Path(__file__).with_name("flights.yaml")
CACHE = bench.BUILD / "flights"
WORTH_KEEPING = 1.0
"""Shortest computing time of a flight that is cached on disk, s."""


@cache
def definitions() -> dict[str, dict[str, Any]]:
    """Return every flight's definition by name."""
    content = yaml.safe_load(DEFINITIONS.read_text(encoding="utf-8"))
    return {name: value for name, value in content.items() if not name.startswith(".")}


def definition(name: str) -> dict[str, Any]:
    """Return the definition of one flight."""
    try:
        return definitions()[name]
    except KeyError:
        raise SimulationError(
            f"flight '{name}' is not in {DEFINITIONS.name}: it has {', '.join(definitions())}"
        ) from None


NESTED = {
    "segments": (Segment, "input"),
    "changes": (CoefficientChange, "change"),
    "faults": (Fault, "fault"),
    "gusts": (ColouredNoise, "gusts"),
    "force": (ColouredNoise, "force"),
}


def plan_of(
    # ``plant: NAME`` with the fields of `PlantFlight` or `QuadrotorFlight`, or ``aircraft: NAME``
    # with those of `AircraftFlight`; ``inputs`` are the segments
    definition: Mapping[str, Any],
    seed: int | None = None,  # Seed of the disturbances instead of the definition's
) -> Plan:
    """Return the flight of a definition."""
    values = _flown(definition, seed)
    values["segments"] = values.pop("inputs", [])
    if ("plant" in values) == ("aircraft" in values):
        raise SimulationError("it must have either 'plant' or 'aircraft'")
    kind: type[Plan] = AircraftFlight
    if (name := values.pop("plant", "")) == QUADROTOR:
        kind = QuadrotorFlight
    elif name:
        kind, values["vehicle"] = PlantFlight, VEHICLES[name]
    for key, (inner, noun) in NESTED.items():
        if isinstance(given := values.get(key), list):
            values[key] = tuple(build(inner, entry, noun) for entry in given)
        elif key in values:
            values[key] = build(inner, given, noun)
    plan: Plan = build(kind, values, "flight")
    return plan


def sensors_of(definition: Mapping[str, Any], **changes: Any) -> Sensors:
    """Return the sensors of a definition, with changes by keyword."""
    sensors: Sensors = build(Sensors, {**definition.get("sensors", {}), **changes}, "sensors")
    return sensors


def _flown(definition: Mapping[str, Any], seed: int | None) -> dict[str, Any]:
    """Return the entries of a definition that determine the flight."""
    values = {k: v for k, v in definition.items() if k not in ("sensors", "description")}
    return values if seed is None else values | {"seed": seed}


def key_of(definition: Mapping[str, Any], seed: int | None = None) -> str:
    """Return a hash of all that determines a flight."""
    text = json.dumps(_flown(definition, seed), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def load_flight(
    name: str,  # Name in `flights.yaml`
    seed: int | None = None,  # Seed of gusts or turbulence instead of the definition's
) -> Flight:
    """Return the noise-free record of a flight."""
    own = definition(name)
    path = CACHE / f"{name}-{key_of(own, seed)}-{_source_key()}.pickle"
    if path.exists():
        with path.open("rb") as file:
            flight: Flight = pickle.load(file)
        return flight
    start = time.monotonic()
    flight = plan_of(own, seed).fly(name)
    if time.monotonic() - start > WORTH_KEEPING:
        _keep(flight, path)
    return flight


def load(
    name: str,  # In `flights.yaml`
    seed: int | None = None,  # Of everything random, instead of the definition's
    **sensor_changes: Any,  # Fields of `Sensors` that differ
) -> Measurements:
    """Return the measurements of a flight."""
    own = definition(name)
    flight = load_flight(name, seed)
    return measure(
        flight, sensors_of(own, **sensor_changes), own.get("seed", 0) if seed is None else seed
    )


@cache
def _source_key() -> str:
    """Return a hash of the source of simulation and signals: changes invalidate cached flights."""
    digest = hashlib.sha256()
    for path in (*sorted(Path(simulation.__path__[0]).glob("*.py")), Path(waveforms.__file__)):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:8]


def _keep(flight: Flight, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent)
    with os.fdopen(handle, "wb") as file:
        pickle.dump(flight, file, protocol=pickle.HIGHEST_PROTOCOL)
    os.replace(temporary, path)  # atomic, also with concurrent writers


def main() -> None:
    """List the flights, or fly the named ones."""
    parser = bench.parser(__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="flights to fly (none)")
    wanted = parser.parse_args().names
    for name in wanted or definitions():
        try:
            own = definition(name)
        except SimulationError as error:
            parser.error(str(error))
        print(f"{name}: {own['description']}")
        if wanted:
            flight = load_flight(name)
            rms = ", ".join(f"{v:.3f}" for v in flight.rates.std(axis=0))
            print(f"  {flight.duration:g} s at {flight.rate:g} Hz, rates {rms} rad/s rms")


if __name__ == "__main__":
    main()
