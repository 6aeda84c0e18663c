# SPDX-License-Identifier: Apache-2.0
"""Share of usable time while a controller flies a healthy aircraft on correct coefficients.

INDI on the identifier's coefficients closes the loop, without excitation. Below each flight stand
the reasons against the verdict, without numbers, and their shares of the time.
"""

import re
from collections import Counter
from dataclasses import replace
from functools import cache, partial
from itertools import product

import bench
import numpy as np
from loop import Mission, fly_loop, make_identifier, rate_controller

from uav_ident_ros.identification.structure import MAIN_DERIVATIVES
from uav_ident_ros.simulation.preparation import SENSORS, Prepared, prepare

AIRCRAFT = ("c172p", "T37", "OV10", "pa28", "A4", "ultra_stick_25e")
START = 30.0
"""Start of the count, s: every surface has moved by then."""
NUMBER = re.compile(r" ?\(.*\)| -?[0-9.]+ ?%?")


@cache
def _prepared(aircraft: str) -> Prepared:
    return prepare(aircraft, None)


def fly(flight: tuple[str, int, float, int], duration: float, airspeed: bool) -> str:
    """Fly a flight (aircraft, turbulence, gyro noise in rad/s, seed); return its lines."""
    aircraft, turbulence, noise, seed = flight
    prepared = _prepared(aircraft)
    identifier = make_identifier(prepared, **({} if airspeed else {"airspeed.type": ""}))
    faults = (f"0: turbulence {turbulence}",) if turbulence else ()
    sensors = replace(SENSORS, gyro_noise=noise)
    mission = Mission(duration=duration, faults=faults, seed=seed, sensors=sensors)
    outcome = fly_loop(prepared, mission, rate_controller(prepared), identifier)
    rows = np.array([rows for t, rows in outcome.usable if t >= START])
    end, known = identifier.coefficient_set(), prepared.coefficients
    kept = end.values[MAIN_DERIVATIVES] / known.values[MAIN_DERIVATIVES]
    ratios = " ".join(f"{ratio:5.2f}" for ratio in kept)
    usable = " ".join(f"{100.0 * share:4.0f} %" for share in rows.mean(axis=0))
    reasons = Counter(
        NUMBER.sub("", reason)
        for t, why in outcome.denied
        for reason in why.split("; ")
        if why and t >= START
    )
    denied = "".join(
        f"\n{100.0 * n / len(rows):10.0f} % {why}" for why, n in reasons.most_common(4)
    )
    lost = "" if outcome.lost is None else f"  lost at {outcome.lost:.0f} s"
    return (
        f"{aircraft:16} {turbulence:10} {noise:9g} {seed:5} "
        f"{100.0 * rows.all(axis=1).mean():6.0f} %   {usable}   {ratios}{lost}{denied}"
    )


def main() -> None:
    """Fly all and print the table."""
    parser = bench.parser(__doc__, duration=90.0, workers=1)
    parser.add_argument("--aircraft", nargs="+", default=AIRCRAFT)
    parser.add_argument("--turbulence", nargs="+", type=int, default=(0, 3))
    parser.add_argument("--noise", nargs="+", type=float, default=(0.005, 0.03), help="rad/s")
    parser.add_argument("--without-airspeed", action="store_true", help="measure no airspeed")
    parser.add_argument("--seeds", nargs="+", type=int, default=(1, 2))
    options = parser.parse_args()
    flights = product(options.aircraft, options.turbulence, options.noise, options.seeds)
    print(
        "aircraft         turbulence     gyro  seed  usable   pdot   qdot   rdot   main, relative"
    )
    bench.done(
        partial(fly, duration=options.duration, airspeed=not options.without_airspeed),
        flights,
        options.workers,
    )


if __name__ == "__main__":
    main()
