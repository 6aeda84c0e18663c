# SPDX-License-Identifier: Apache-2.0
"""Faults at random times, and who brings the aircraft home.

Aircraft are trimmed, excited and identified; then each controller flies the same manoeuvres, and a
fault comes at a random time. Everything runs in one process, without ROS, so that a flight is the
same every time. The controllers:

inversion   inversion of the nominal model with a disturbance observer
PID         the usual rate loop: feed-forward, P, I, D, one surface for each axis
INDI        incremental inversion on the nominal control derivatives
adaptive    the same, on what is identified and measured in flight, axis by axis

All are tuned by one rule on the healthy aircraft's identified model: as fast as can be with a gain
margin of two, that is, so that they still settle when every input has twice its effect.

Tables go to the terminal, every flight to build/fault_campaign.json.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import uav_ident_ros  # noqa: F401  (first: it limits the threads of NumPy)
from uav_ident_ros.client import CoefficientSource, Fallback
from uav_ident_ros.control import Law
from uav_ident_ros.control.choice import control_derivatives
from uav_ident_ros.control.controller import OWN_GAINS
from uav_ident_ros.control.pid import SURFACES, PidController, PidGains
from uav_ident_ros.identification.structure import RATE_COLUMNS, FloatArray
from uav_ident_ros.simulation.airframe import airframe_names
from uav_ident_ros.simulation.flight import EPOCH_NS
from uav_ident_ros.simulation.loop import (
    DELAY,
    Controller,
    Mission,
    Outcome,
    fly_loop,
    make_identifier,
    nominal_of,
    rate_controller,
)
from uav_ident_ros.simulation.noise import Sensors
from uav_ident_ros.simulation.preparation import SENSORS, Prepared, prepare

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / "build" / "fault_campaign.json"

CONTROLLERS = ("inversion", "PID", "INDI", "adaptive")


@dataclass(frozen=True)
class Case:
    """What goes wrong in a flight."""

    commands: tuple[str, ...] = ()  # At the time of the fault
    axis: int = 0  # The one concerned: p, q, r
    delay: float = DELAY  # True one, s; the loop is told `DELAY`
    sensors: Sensors = SENSORS


FAULTS = {
    "healthy": Case(),
    "aileron halved": Case(("aileron effect 0.5",)),
    "elevator halved": Case(("elevator effect 0.5",), 1),
    "rudder halved": Case(("rudder effect 0.5",), 2),
    "elevator halved, pitch inertia +30 %": Case(("elevator effect 0.5", "pitch inertia 1.3"), 1),
    "aileron reversed": Case(("aileron effect -1",)),
    "elevator reversed": Case(("elevator effect -1",), 1),
    "aileron lost": Case(("aileron effect 0",)),
    "aileron jams": Case(("aileron jams",)),
    "rudder jams": Case(("rudder jams",), 2),
    "engine out": Case(("engine out",), 2),
    "cg aft 10 % of the chord": Case(("cg aft 0.1",), 1),
    "delay 60 ms, told 20": Case(delay=0.06),
    "gyro noise x 4, bias 0.02 rad/s": Case(
        sensors=replace(SENSORS, gyro_noise=0.02, gyro_bias=(0.02, -0.02, 0.02))
    ),
}
"""The last two are there from the start of the flight."""

BEFORE, AFTER = 15.0, 20.0
"""Least time before a fault and time flown after it, s."""

SPREAD = 10.0
"""The fault comes up to so much later, at random, s."""

RECOVERED = 1.2
"""Error over that of the healthy flight at which a fault counts as overcome."""

SPAN = 5.0
"""Length of the stretches that are compared for that, and the time in which it should be, s."""

NOTICED = 8.0
"""Time in which a fault should be noticed, s."""

FACTORS = tuple(1.15**k for k in range(-8, 9))
"""Speeds of a loop that are tried, over the laws' own."""

TITLES = (
    "controller", "before", "0 to 5 s", "5 to 15 s", "from 15 s", "other axes", "lost",
    f"noticed, s (within {NOTICED:g} s)", f"within 20 %, s (after {SPAN:g} s)",
)  # fmt: skip

Make = Callable[[CoefficientSource], Controller]


# --- the controllers, tuned ------------------------------------------------------------------


def pid_gains(prepared: Prepared, factor: float) -> PidGains:
    """PID of the same bandwidth as the laws': K over the effect, damping fed forward."""
    effect = control_derivatives(nominal_of(prepared))[0]
    main = np.array([effect[axis, column] for axis, column in enumerate(SURFACES)])
    rates = nominal_of(prepared).values[:3, RATE_COLUMNS].diagonal()
    k = factor * np.array(OWN_GAINS[Law.INCREMENTAL].rate)
    return PidGains(
        forward=-rates / main, proportional=k / main, integral=k**2 / 2.0 / main,
        derivative=0.1 / main,
    )  # fmt: skip


def make_controller(prepared: Prepared, name: str, factor: float) -> Make:
    """Return what makes a controller of that speed."""
    if name == "PID":
        gains = pid_gains(prepared, factor)
        return lambda source: PidController(prepared.limits - prepared.trim, gains)
    law = Law.INVERSION if name == "inversion" else Law.INCREMENTAL
    return rate_controller(prepared, law, name == "adaptive", OWN_GAINS[law].times(factor))


def tuned(prepared: Prepared, name: str) -> float:
    """Return the largest factor that settles with twice the effect: the rule."""
    passed = [f for f in FACTORS if settles(prepared, make_controller(prepared, name, f))]
    return max(passed, default=FACTORS[0])


def settles(prepared: Prepared, make: Make, effect: float = 2.0, seconds: float = 3.0) -> bool:
    """Whether a step is followed on the identified model with so much more effect."""
    nominal = nominal_of(prepared)
    source = CoefficientSource(Fallback.LAST_GOOD, nominal)
    controller = make(source)
    a = nominal.values[:3, RATE_COLUMNS]
    b = effect * control_derivatives(nominal)[0]
    x, dt, rates = np.zeros(3), 0.01, []
    underway = [np.zeros(4)] * round(DELAY / dt)
    for k in range(round(seconds / dt)):
        wanted = np.array([0.1, 0.05, 0.03])
        underway.append(controller.update(EPOCH_NS + round(k * dt * 1e9), x, wanted))
        u = underway.pop(0)
        for _ in range(5):
            x = x + 0.2 * dt * (a @ x + b @ u)
        rates.append(x)
        if not np.abs(x).max() < 10.0:
            return False
    last = np.array(rates)[-100:]
    return bool((np.ptp(last, axis=0) < 0.1 * wanted).all())


# --- flights ---------------------------------------------------------------------------------


def fault_time(seed: int) -> float:
    """Random time of the fault of a seed's flights, s."""
    rng = np.random.default_rng(seed)
    return round(BEFORE + SPREAD * float(rng.random()), 2)


def fly(prepared: Prepared, name: str, factor: float, fault: str, seed: int) -> dict[str, Any]:
    """Fly one controller through one fault; what is to be said of it."""
    when = fault_time(seed)
    case = FAULTS[fault]
    axis, commands = case.axis, tuple(f"{when}: {c}" for c in case.commands)
    mission = Mission(when + AFTER, commands, seed, case.sensors, case.delay)
    identifier = make_identifier(prepared) if name == "adaptive" else None
    outcome = fly_loop(prepared, mission, make_controller(prepared, name, factor), identifier)
    spans = ((5.0, when), (when, when + 5.0), (when + 5.0, when + 15.0), (when + 15.0, np.inf))
    return {
        "aircraft": prepared.airframe.name, "controller": name, "fault": fault, "seed": seed,
        "time": when, "axis": axis, "lost": outcome.lost,
        "errors": [outcome.error(*span).tolist() for span in spans],
        "in spans": [
            outcome.error(when + k * 1.0, when + k * 1.0 + SPAN).tolist()
            for k in range(int(AFTER - SPAN) + 1)
        ],
        "noticed": noticed(outcome, when, axis),
    }  # fmt: skip


def noticed(outcome: Outcome, when: float, axis: int) -> float | None:
    """Time from the fault until a coefficient of the axis is released, or its sign turned, s."""
    row = ("pdot", "qdot", "rdot")[axis]
    times = [t for t, name in outcome.changes if t > when and name.startswith(row)]
    times += [t for t, sources in outcome.sources if t > when and sources[axis] == "measured"]
    return min(times) - when if times else None


def recovered(flight: dict[str, Any], healthy: dict[str, Any]) -> float | None:
    """Time from the fault until the axis is within 20 % of healthy for good, s."""
    if flight["lost"] is not None:
        return None
    axis = flight["axis"]
    ratio = [
        f[axis] / h[axis] for f, h in zip(flight["in spans"], healthy["in spans"], strict=True)
    ]
    bad = [k for k, value in enumerate(ratio) if not value <= RECOVERED]
    return float(bad[-1] + 1) if bad and bad[-1] + 1 < len(ratio) else (None if bad else 0.0)


def campaign(
    names: Sequence[str], faults: Sequence[str], seeds: int, workers: int
) -> Iterator[dict[str, Any]]:
    """Fly everything, a fault on all aircraft before the next; yield each flight."""
    with ProcessPoolExecutor(workers) as pool:
        fleet = []
        for prepared in pool.map(prepare, names):
            factors = list(pool.map(tuned, [prepared] * len(CONTROLLERS), CONTROLLERS))
            fleet.append((prepared, factors))
            said = ", ".join(f"{n} {f:.2f}" for n, f in zip(CONTROLLERS, factors, strict=True))
            print(f"{prepared.airframe.name}: times their defaults, {said}", flush=True)
        jobs = [
            pool.submit(fly, prepared, name, factor, fault, seed)
            for seed in range(seeds)
            for fault in ("healthy", *faults)
            for prepared, factors in fleet
            for name, factor in zip(CONTROLLERS, factors, strict=True)
        ]
        for job in jobs:
            yield job.result()


# --- tables ----------------------------------------------------------------------------------


def lines(flights: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Tables of all and of each aircraft: errors in deg/s, crashes, what was noticed and when."""
    healthy = {
        (f["aircraft"], f["controller"], f["seed"]): f for f in flights if f["fault"] == "healthy"
    }
    names = list(dict.fromkeys(f["aircraft"] for f in flights))
    for aircraft in ["all aircraft", *names] if len(names) > 1 else names:
        own = [f for f in flights if aircraft in ("all aircraft", f["aircraft"])]
        yield f"\n| {aircraft} | " + " | ".join(TITLES) + " |"
        yield "|---" * (1 + len(TITLES)) + "|"
        for fault in dict.fromkeys(f["fault"] for f in own):
            for name in CONTROLLERS:
                some = [f for f in own if f["fault"] == fault and f["controller"] == name]
                if some:
                    yield "| " + " | ".join([fault, name, *cells(some, healthy)]) + " |"


def cells(some: Sequence[dict[str, Any]], healthy: dict[Any, dict[str, Any]]) -> list[str]:
    """Medians over the flights of a controller and a fault, and counts."""
    axis = some[0]["axis"]
    whole = [healthy[f["aircraft"], f["controller"], f["seed"]] for f in some]
    errors, reference = (
        np.array([f["errors"] for f in flights], dtype=float)  # flights, spans, axes
        for flights in (some, whole)
    )
    others = [i for i in range(3) if i != axis]
    ratio = (errors[:, 2] / reference[:, 2])[:, others].max(axis=1)  # NaN where it was lost
    back = [recovered(f, h) for f, h in zip(some, whole, strict=True)]
    return [
        *(_middle(errors[:, k, axis]) for k in range(4)),
        _middle(ratio, "x"),
        f"{sum(f['lost'] is not None for f in some)} of {len(some)}",
        _times([f["noticed"] for f in some], NOTICED),
        _times(back, SPAN),
    ]


def _middle(values: FloatArray, unit: str = "") -> str:
    finite = values[np.isfinite(values)]
    return f"{np.median(finite):.2f}{unit}" if len(finite) else "-"


def _times(values: Sequence[float | None], limit: float) -> str:
    """Median of those there are, and how many of all are within the limit."""
    known = [v for v in values if v is not None]
    soon = sum(v <= limit for v in known)
    return f"{np.median(known):.1f} ({soon} of {len(values)})" if known else "-"


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly the campaign; the return value is the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("aircraft", nargs="*", default=list(airframe_names()))
    parser.add_argument("--fault", action="append", choices=list(FAULTS)[1:], help="default: all")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--workers", type=int, default=max(1, (os.cpu_count() or 2) - 1))
    options = parser.parse_args(arguments)
    faults = options.fault or list(FAULTS)[1:]
    RESULT.parent.mkdir(exist_ok=True)
    flights: list[Any] = []
    for flight in campaign(options.aircraft, faults, options.seeds, options.workers):
        flights.append(flight)
        RESULT.write_text(json.dumps(flights), encoding="utf-8")
    for line in lines(flights):
        print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
