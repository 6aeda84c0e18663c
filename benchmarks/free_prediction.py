# SPDX-License-Identifier: Apache-2.0
"""Free predictions over 1, 3 and 5 s: ``python benchmarks/free_prediction.py [FLIGHT ...]``.

One online pass over each flight with defaults, p / q / r over the last 40 %, against the measured
rates; beside it holding the rate, the model with the forces measured inside the window, and
`augmented` with the forces measured. Recorded flights get their delay, and an airspeed of 17 m/s.
"""

import bench
import cases

from uav_ident_ros.identification.structure import FloatArray

RECORDED = ("thor75_flight", "thor75_auto", "proto_flt09", "skywalker_manual")
SIMULATED = tuple(
    f"{aircraft}_{kind}"
    for aircraft in ("c172p", "t37", "ov10")
    for kind in ("calm", "banked", "turbulent", "unexcited")
)
RECORDED_SPEED = 17.0
"""Usual airspeed of the recorded aircraft, m/s."""


def row(flight: str) -> str:
    """One row of the table."""
    case = cases.load(flight)
    speed = {"airspeed.reference": RECORDED_SPEED} if flight in RECORDED else {}
    free = cases.score(case, cases.identify(case, {"structure": "flight_dynamics", **speed}))
    augmented = cases.score(case, cases.identify(case, {"structure": "augmented"}))
    columns = (
        *free.free, free.hold, free.measured_force, augmented.measured_force
    )  # fmt: skip
    return f"| {flight} | " + " | ".join(map(triple, columns)) + " |"


def triple(fit: FloatArray) -> str:
    """Fits of p, q, r."""
    return " / ".join(f"{value:.0f}" for value in fit)


def main() -> None:
    """Print the table."""
    parser = bench.parser(__doc__, workers=2)
    parser.add_argument("flights", nargs="*", metavar="FLIGHT")
    options = parser.parse_args()
    known = [name for name in RECORDED if cases.is_recorded(name)]
    flights = options.flights or [*known, *SIMULATED]
    print("| flight | 1 s | 3 s | 5 s | holding, 1 s | forces measured | augmented, measured |")
    print("|---|---|---|---|---|---|---|")
    bench.done(row, flights, options.workers)


if __name__ == "__main__":
    main()
