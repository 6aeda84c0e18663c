# SPDX-License-Identifier: Apache-2.0
"""How long the verdict stands while a controller flies a healthy aircraft on correct coefficients.

The loop is closed by INDI on the identifier's own coefficients, which start from those that the
aircraft was prepared with. It follows bank and pitch manoeuvres, in calm air and in turbulence,
with an ordinary gyro and a noisy one. Nobody excites.

    python benchmarks/usable_in_loop.py --workers 2
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np

from uav_ident_ros.control.controller import OWN_GAINS, Law
from uav_ident_ros.identification.structure import MAIN_INPUTS, STRUCTURES
from uav_ident_ros.simulation.loop import (
    Mission,
    fly_loop,
    make_identifier,
    rate_controller,
)
from uav_ident_ros.simulation.preparation import SENSORS, Prepared, prepare

AIRCRAFT = ("c172p", "T37", "OV10", "pa28", "A4", "ultra_stick_25e")
MAIN = tuple(f"{row}/{surface}" for row, surface in MAIN_INPUTS.items())
START = 30.0
"""From when on the verdict counts, s: every surface has moved by then."""


@dataclass(frozen=True)
class Flight:
    """One flight."""

    aircraft: str
    turbulence: int
    noise: float  # Of the gyro, rad/s
    seed: int


@cache
def _prepared(aircraft: str) -> Prepared:
    return prepare(aircraft, None)


def fly(flight: Flight, duration: float) -> str:
    """Fly one, and return its line of the table."""
    prepared = _prepared(flight.aircraft)
    identifier = make_identifier(prepared)
    mission = Mission(
        duration,
        (f"0: turbulence {flight.turbulence}",) if flight.turbulence else (),
        flight.seed,
        replace(SENSORS, gyro_noise=flight.noise),
    )
    law = Law.INCREMENTAL
    outcome = fly_loop(
        prepared, mission, rate_controller(prepared, law, True, OWN_GAINS[law]), identifier
    )
    rows = np.array([rows for t, rows in outcome.usable if t >= START])
    end, known = identifier.coefficient_set(), prepared.coefficients
    index = [STRUCTURES[known.structure].index(name) for name in MAIN]
    ratios = " ".join(f"{end.values[i] / known.values[i]:5.2f}" for i in index)
    usable = " ".join(f"{100.0 * share:4.0f} %" for share in rows.mean(axis=0))
    lost = "" if outcome.lost is None else f"  lost at {outcome.lost:.0f} s"
    return (
        f"{flight.aircraft:16} {flight.turbulence:10} {flight.noise:9g} {flight.seed:5} "
        f"{100.0 * rows.all(axis=1).mean():6.0f} %   {usable}   {ratios}{lost}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly all and print the table; the status is 0 whatever comes out."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--aircraft", nargs="+", default=AIRCRAFT)
    parser.add_argument("--turbulence", nargs="+", type=int, default=(0, 3))
    parser.add_argument("--noise", nargs="+", type=float, default=(0.005, 0.03), help="rad/s")
    parser.add_argument("--seeds", nargs="+", type=int, default=(1, 2))
    parser.add_argument("--duration", type=float, default=90.0, help="s")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args(arguments)
    chosen = (options.aircraft, options.turbulence, options.noise, options.seeds)
    flights = [Flight(*values) for values in product(*chosen)]
    print(
        "aircraft         turbulence     gyro  seed  usable   pdot   qdot   rdot   main, relative"
    )
    with ProcessPoolExecutor(options.workers) as pool:
        for line in pool.map(fly, flights, [options.duration] * len(flights)):
            print(line, flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
