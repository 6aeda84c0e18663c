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
from pathlib import Path
from typing import Any

import numpy as np

import uav_ident_ros  # noqa: F401  (first: it limits the threads of NumPy)
from uav_ident_ros.client import CoefficientSource, Fallback
from uav_ident_ros.control import Law
from uav_ident_ros.control.choice import control_derivatives
from uav_ident_ros.control.controller import OWN_GAINS
from uav_ident_ros.control.pid import SURFACES, PidGains
from uav_ident_ros.identification.structure import RATE_COLUMNS, FloatArray
from uav_ident_ros.simulation.airframe import airframe_names
from uav_ident_ros.simulation.flight import EPOCH_NS
from uav_ident_ros.simulation.loop import (
    DELAY,
    Controller,
    Mission,
    Outcome,
    PidController,
    fly_loop,
    make_identifier,
    nominal_of,
    rate_controller,
)
from uav_ident_ros.simulation.preparation import Prepared, prepare

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / "build" / "fault_campaign.json"

CONTROLLERS = ("inversion", "PID", "INDI", "adaptive")

FAULTS: dict[str, tuple[tuple[str, ...], int]] = {
    "healthy": ((), 0),
    "aileron halved": (("aileron effect 0.5",), 0),
    "elevator halved": (("elevator effect 0.5",), 1),
    "rudder halved": (("rudder effect 0.5",), 2),
    "aileron reversed": (("aileron effect -1",), 0),
    "elevator reversed": (("elevator effect -1",), 1),
    "aileron lost": (("aileron effect 0",), 0),
    "rudder jams": (("rudder jams",), 2),
    "elevator halved, pitch inertia +30 %": (("elevator effect 0.5", "pitch inertia 1.3"), 1),
}
"""What goes wrong, and the axis concerned (p, q, r)."""

BEFORE, AFTER = 15.0, 25.0
"""Least time before a fault and time flown after it, s."""

SPREAD = 10.0
"""The fault comes up to so much later, at random, s."""

RECOVERED = 1.2
"""Error over that of the healthy flight at which a fault counts as overcome."""

SPAN = 5.0
"""Length of the stretches that are compared for that, s."""

FACTORS = tuple(1.15**k for k in range(-8, 9))
"""Speeds of a loop that are tried, over the laws' own."""

TITLES = (
    "controller", "before", "0 to 5 s", "5 to 15 s", "from 15 s", "other axes", "lost",
    "noticed, s", "recovered, s",
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
    commands, axis = FAULTS[fault]
    mission = Mission(when + AFTER, tuple(f"{when}: {c}" for c in commands), seed)
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


def campaign(names: Sequence[str], faults: Sequence[str], seeds: int, workers: int) -> list[Any]:
    """Fly everything."""
    flights: list[Any] = []
    with ProcessPoolExecutor(workers) as pool:
        for aircraft, prepared in zip(names, pool.map(prepare, names), strict=True):
            factors = list(pool.map(tuned, [prepared] * 4, CONTROLLERS))
            print(f"{aircraft}: {dict(zip(CONTROLLERS, np.round(factors, 2), strict=True))}")
            jobs = [
                pool.submit(fly, prepared, name, factor, fault, seed)
                for name, factor in zip(CONTROLLERS, factors, strict=True)
                for fault in ("healthy", *faults)
                for seed in range(seeds)
            ]
            flights += [job.result() for job in jobs]
    return flights


# --- tables ----------------------------------------------------------------------------------


def lines(flights: Sequence[dict[str, Any]]) -> Iterator[str]:
    """One table for each aircraft: errors in deg/s, crashes, time to notice and to recover."""
    for aircraft in dict.fromkeys(f["aircraft"] for f in flights):
        own = [f for f in flights if f["aircraft"] == aircraft]
        healthy = {(f["controller"], f["seed"]): f for f in own if f["fault"] == "healthy"}
        yield f"\n| {aircraft} | " + " | ".join(TITLES) + " |"
        yield "|---" * (1 + len(TITLES)) + "|"
        for fault in dict.fromkeys(f["fault"] for f in own):
            for name in CONTROLLERS:
                some = [f for f in own if f["fault"] == fault and f["controller"] == name]
                if not some:
                    continue
                yield "| " + " | ".join([fault, name, *cells(some, healthy)]) + " |"


def cells(some: Sequence[dict[str, Any]], healthy: dict[Any, dict[str, Any]]) -> list[str]:
    """Medians over the flights of a controller and a fault."""
    axis = some[0]["axis"]
    errors = np.array([f["errors"] for f in some], dtype=float)  # flights, spans, axes
    others = [i for i in range(3) if i != axis]
    reference = np.array([healthy[f["controller"], f["seed"]]["errors"] for f in some], dtype=float)
    ratio = errors[:, 2][:, others] / reference[:, 2][:, others]
    lost = sum(f["lost"] is not None for f in some)
    back = [recovered(f, healthy[f["controller"], f["seed"]]) for f in some]
    return [
        *(_middle(errors[:, k, axis]) for k in range(4)),
        _middle(np.nanmax(ratio, axis=1) if np.isfinite(ratio).any() else ratio.ravel(), "x"),
        f"{lost} of {len(some)}",
        _times([f["noticed"] for f in some]),
        _times(back),
    ]


def _middle(values: FloatArray, unit: str = "") -> str:
    finite = values[np.isfinite(values)]
    return f"{np.median(finite):.2f}{unit}" if len(finite) else "-"


def _times(values: Sequence[float | None]) -> str:
    known = [v for v in values if v is not None]
    return f"{np.median(known):.1f} ({len(known)} of {len(values)})" if known else "-"


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
    flights = campaign(options.aircraft, faults, options.seeds, options.workers)
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps(flights), encoding="utf-8")
    for line in lines(flights):
        print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
