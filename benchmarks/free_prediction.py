# SPDX-License-Identifier: Apache-2.0
"""Free predictions over 1, 3 and 5 s: ``python benchmarks/free_prediction.py [FLIGHT ...]``.

The scores are those of one online pass with defaults over each flight: p / q / r over the last
40 %, against the measured rates. Beside them are holding the rate, the model with the forces
measured inside the window, and `augmented` with measured forces. Recorded flights have their delay,
and an airspeed of 17 m/s; with ``--airspeed`` that of their bag.
"""

from functools import partial

import bench
import cases

from uav_ident_ros.identification.structure import FloatArray

SIMULATED = tuple(
    f"{aircraft}_{kind}"
    for aircraft in ("c172p", "t37", "ov10")
    for kind in ("calm", "banked", "turbulent", "unexcited")
)


def row(airspeed: str, flight: str) -> str:
    """Return the row of a flight, with an airspeed of that type or without."""
    case = cases.load(flight)
    free, augmented = (
        cases.score(case, cases.identify(case, {"structure": structure, "airspeed.type": airspeed}))
        for structure in ("flight_dynamics", "augmented")
    )
    columns = (
        *free.free, free.hold, free.measured_force, augmented.measured_force
    )  # fmt: skip
    return f"| {flight} | " + " | ".join(map(triple, columns)) + " |"


def triple(fit: FloatArray) -> str:
    """Return the fits of p, q, r as text."""
    return " / ".join(f"{value:.0f}" for value in fit)


def main() -> None:
    """Print the table."""
    parser = bench.parser(__doc__, workers=2)
    parser.add_argument("flights", nargs="*", metavar="FLIGHT")
    parser.add_argument("--airspeed", action="store_true", help="that of the bag")
    options = parser.parse_args()
    flights = options.flights or [*filter(cases.is_recorded, cases.RECORDED_DELAY), *SIMULATED]
    print("| flight | 1 s | 3 s | 5 s | holding, 1 s | forces measured | augmented, measured |")
    print("|---|---|---|---|---|---|---|")
    airspeed = cases.AIRSPEED_TYPE if options.airspeed else ""
    bench.done(partial(row, airspeed), flights, options.workers)


if __name__ == "__main__":
    main()
