# SPDX-License-Identifier: Apache-2.0
"""Errors of the parts around the loop: settings, messages, clocks, a killed identifier.

The adaptive loop and INDI on fixed coefficients fly each hazard with the same manoeuvres, in one
process, with the aircraft and bandwidths of ``fault_campaign.py``. The adaptive loop must not be
lost where the fixed one survives.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import bench
import numpy as np
from fault_campaign import ADAPTIVE, AIRCRAFT, Fleet
from loop import DELAY, Mission, Random, fly_loop, make_identifier, rate_controller

from uav_ident_ros.client import Coefficients
from uav_ident_ros.control import IncrementalLaw
from uav_ident_ros.identification.structure import INPUT_COLUMNS, FloatArray
from uav_ident_ros.simulation.flight import EPOCH_NS, SimulationError
from uav_ident_ros.simulation.preparation import Prepared

DURATION = 45.0
SPANS = ((5.0, 15.0), (15.0, 30.0), (30.0, DURATION))
"""Compared intervals, s: before, during and after most hazards."""

Delivered = Callable[[float, Coefficients, Random], list[Coefficients]]


@dataclass(frozen=True, kw_only=True)
class Hazard(Mission):
    """An error of the settings or of the parts around the loop."""

    configured: float = DELAY  # Configured delay of controller and identifier, s
    trim: tuple[float, float, float] = (0.0, 0.0, 0.0)  # Error of the configured trim, rad
    speed: float = 1.0  # Airspeed relative to that of the coefficients
    airspeed: bool = True  # Whether it is measured


def lost(share: float) -> Delivered:
    """Return a channel that loses a share of all messages."""
    return lambda t, c, rng: [] if rng.random() < share else [c]


def scaled(c: Coefficients, factor: float) -> Coefficients:
    """Return coefficients with the effects of the inputs times a factor."""
    values = c.values.copy()
    values[:3, INPUT_COLUMNS] *= factor
    return replace(c, values=values)


def also(factor: float) -> Delivered:
    """Return a channel with a second publisher, of another aircraft, from 15 s on."""
    return lambda t, c, rng: [c, scaled(c, factor)] if t > 15.0 else [c]


def stamped(seconds: float, after: float = 15.0) -> Delivered:
    """Return a channel with a constant error of the stamps."""
    off_ns = round(seconds * 1e9)
    return lambda t, c, rng: [replace(c, t_ns=c.t_ns + off_ns) if t > after else c]


def gaps(length: float, period: float) -> Callable[..., FloatArray | None]:
    """Return an Imu with periodic gaps, s."""
    return lambda t, x, rng: None if t > period and t % period < length else x


def excited(t: float) -> FloatArray:
    """Return an excitation that is aborted in the middle of a swing."""
    swing = np.array([0.04, 0.04, 0.05, 0.0]) * np.sin([9 * t, 7 * t, 11 * t, 0])
    return np.asarray((10.0 < t < 20.3) * swing)


HALVED = ("20: aileron effect 0.5",)

HAZARDS = {
    "none": Hazard(),
    "delay 40 ms, told 20": Hazard(delay=0.04),
    "delay 60 ms, told 20": Hazard(delay=0.06),
    "delay 20 ms, told 40": Hazard(configured=0.04),
    "delay 20 ms, told 60": Hazard(configured=0.06),
    "delay 60 ms, told 20, aileron halved": Hazard(faults=HALVED, delay=0.06),
    "trim off by 0.05, 0.03, 0.05 rad": Hazard(trim=(0.05, 0.03, 0.05)),
    "trim off, aileron halved": Hazard(faults=HALVED, trim=(-0.05, -0.03, -0.05)),
    "a tenth of the coefficients lost": Hazard(messages=lost(0.1)),
    "half of them lost, aileron halved": Hazard(faults=HALVED, messages=lost(0.5)),
    "silent for 2 s, elevator halved in it": Hazard(
        faults=("18.5: elevator effect 0.5",),
        messages=lambda t, c, _: [] if 18.0 < t < 20.0 else [c],
    ),
    "identifier killed 15 to 25 s, aileron halved": Hazard(faults=HALVED, dead=(15.0, 25.0)),
    "identifier killed, next one cold": Hazard(dead=(15.0, 25.0), cold=True),
    "stamps stand still, aileron halved": Hazard(
        faults=HALVED,
        messages=lambda t, c, _: [replace(c, t_ns=min(c.t_ns, EPOCH_NS + 15 * 10**9))],
    ),
    "stamps 5 s ahead": Hazard(messages=stamped(5.0)),
    "another publisher, effects a third": Hazard(messages=also(1.0 / 3.0)),
    "another publisher, effects threefold": Hazard(messages=also(3.0)),
    "another publisher, effects reversed": Hazard(messages=also(-1.0)),
    "speed 0.8": Hazard(speed=0.8),
    "speed 1.25": Hazard(speed=1.25),
    "speed 0.8, not measured": Hazard(speed=0.8, airspeed=False),
    "speed 1.25, not measured": Hazard(speed=1.25, airspeed=False),
    "a tenth of the Imu lost": Hazard(imu=lambda t, x, rng: None if rng.random() < 0.1 else x),
    "half of the Imu lost": Hazard(imu=lambda t, x, rng: None if rng.random() < 0.5 else x),
    "gaps of 0.15 s in the Imu, trim off": Hazard(imu=gaps(0.15, 3.0), trim=(0.05, 0.03, 0.05)),
    "a gap of 0.5 s in the Imu": Hazard(imu=lambda t, x, _: None if 20.0 < t < 20.5 else x),
    "one sample not a number": Hazard(
        imu=lambda t, x, _: np.full(3, np.nan) if abs(t - 20.0) < 0.004 else x
    ),
    "clock 5 s forward": Hazard(clock=lambda t: 5.0 * (t > 20.0)),
    "clock 5 s back, aileron halved": Hazard(
        faults=("20.2: aileron effect 0.5",), clock=lambda t: -5.0 * (t > 20.0)
    ),
    "excitation aborted": Hazard(excitation=excited),
}


def fly(
    prepared: Prepared, factor: float, adaptive: bool, hazard: Hazard, seed: int
) -> dict[str, Any]:
    """Fly once; return errors in deg/s, sources of the axes, and the time of a loss."""
    mission = replace(hazard, duration=DURATION, seed=seed)
    live = mission.take_off(prepared.aircraft, prepared.airframe.speed * hazard.speed)
    trim = live.trim + np.append(hazard.trim, 0.0)
    flown = replace(prepared, trim=trim, limits=live.aircraft.limits)
    settings: dict[str, Any] = {"actuators.delay": hazard.configured}
    settings |= {} if hazard.airspeed else {"airspeed.type": ""}
    gains = IncrementalLaw.gains.times(factor)
    make = rate_controller(flown, adaptive, gains=gains, delay=hazard.configured)
    identifier = make_identifier(flown, **settings) if adaptive else None
    outcome = fly_loop(flown, mission, make, identifier, live)
    flown_on = zip(*(sources for _, sources in outcome.sources), strict=True)
    return {
        "lost": outcome.lost,
        "errors": [outcome.error(*s).tolist() for s in SPANS if outcome.lost is None],
        "sources": [sorted(set(axis)) for axis in flown_on],
    }


def line(flight: dict[str, Any]) -> str:
    """Return the errors of roll, pitch and yaw in the intervals, or the time of the loss."""
    if flight["lost"] is not None:
        return f"**lost** at {flight['lost']:.0f} s"
    return ", ".join(" / ".join(f"{x:.1f}" for x in error) for error in flight["errors"][1:])


def lines(found: dict[str, list[dict[str, Any]]]) -> Iterator[str]:
    """Yield the table of all flights."""
    spans = " and ".join(f"{a:.0f} to {b:.0f}" for a, b in SPANS[1:])
    head = ("hazard", "aircraft", f"adaptive, deg/s, {spans} s", "INDI, fixed", "flown on")
    rows = []
    for key, (adaptive, fixed) in found.items():
        hazard, aircraft = key.split(": ")
        on = "; ".join(", ".join(axis) for axis in adaptive["sources"])
        rows.append((hazard, aircraft, line(adaptive), line(fixed), on))
    yield from bench.table(head, rows)
    worse = [k for k, (a, f) in found.items() if a["lost"] is not None and f["lost"] is None]
    yield f"lost where the fixed loop survives: {', '.join(worse) or 'none'}"


def main() -> None:
    """Fly the hazards."""
    parser = bench.parser(__doc__, seed=3, output=bench.BUILD / "loop_hazards.json")
    parser.add_argument("aircraft", nargs="*", default=AIRCRAFT[:1])
    parser.add_argument("--hazard", action="append", choices=list(HAZARDS), help="default: all")
    options = parser.parse_args()
    found: dict[str, Any] = {}
    bench.BUILD.mkdir(exist_ok=True)
    with ProcessPoolExecutor(1) as pool:
        fleet = Fleet(bench.BUILD, pool)
        for hazard in options.hazard or HAZARDS:
            for name in options.aircraft:
                prepared, factors = fleet[name]
                try:
                    pair = [
                        fly(prepared, factors[who], who == ADAPTIVE, HAZARDS[hazard], options.seed)
                        for who in (ADAPTIVE, "INDI")
                    ]
                except SimulationError as error:  # no trim at that speed
                    print(hazard, name, error, sep="  ", flush=True)
                    continue
                found[f"{hazard}: {name}"] = pair
                print(hazard, name, *map(line, pair), sep="  ", flush=True)
    bench.keep(options.output, found)
    print("\n".join(lines(found)))


if __name__ == "__main__":
    main()
