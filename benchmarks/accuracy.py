# SPDX-License-Identifier: Apache-2.0
"""Prediction of the estimators: ``python benchmarks/accuracy.py [--quick] [--only PATTERN]``.

Every estimator with every structure makes one online pass over each flight of `FLIGHTS`, beside the
references of benchmarks/README.md. The score is the 1-second prediction fit over the last 40 % of
the flight, for structures with forces on the forces measured inside the window.
"""

import fnmatch
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import adaptive_filters
import bench
import cases
import numpy as np
import output_error
from free_prediction import SIMULATED

from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.simulation.noise import Measurements

FLIGHTS = (
    "exact_noise_002",
    "exact_pulses",
    "exact_aerobatic",
    "exact_gusts_10",
    "exact_out_of_trim",
    "exact_closed_loop",
    *SIMULATED,
    "thor75_auto",
)

QUICK = (
    "exact_noise_002",
    "exact_gusts_10",
    "c172p_calm",
    "c172p_turbulent",
    "t37_calm",
    "thor75_auto",
)

ESTIMATORS = ("gradient", "least_squares", "instrumental_variable")
PAPER = bench.ROOT / "config" / "paper_2006.yaml"

DEFAULT, REFERENCE = "instrumental_variable", "output error"

CLIP = -50.0
"""Fit at which a cell is clipped in averages, percent."""

HEAD = ("structure", "method", "measured rates", "sd", "noise-free rates", "six, %")

Cell = dict[str, Any]
"""Result of one method on one flight: names, fits of p, q, r (percent; NaN if missing), and largest
relative error of the dominant coefficients at the end (percent)."""


def _cell(case: cases.Case, structure: str, method: str, track: cases.Track) -> Cell:
    score = cases.score(case, track)
    # The criterion of the offline fit: a prediction with the measured forces of a past second.
    fits = {"model": cases.given_force(score), "hold": score.hold, "truth": np.full(3, np.nan)}
    if isinstance(case.samples, Measurements):
        fits["truth"] = cases.given_force(cases.score(case, track, case.samples.true_rates))
    return {
        "structure": structure,
        "method": method,
        **{kind: fit.tolist() for kind, fit in fits.items()},
        "coefficient_error": _dominant_error(case, track),
    }


def _dominant_error(case: cases.Case, track: cases.Track) -> float:
    flight = case.flight
    if flight is None or flight.coefficients is None:
        return float("nan")
    truth = cases.truth_in(track.structure, flight, flight.duration)
    where = cases.places(track.structure, cases.DOMINANT)
    return float(100.0 * np.max(np.abs(track.coefficients[-1][where] / truth[where] - 1.0)))


def run_flight(job: tuple[str, int | None]) -> list[Cell]:
    """Run every method on one flight."""
    case = cases.load(*job)
    values: Mapping[str, object] = load_parameters(PAPER, "identifier")
    out = [_cell(case, "paper (20)", "paper 2006", cases.identify(case, values))]
    for label, values in cases.MODELS.items():
        out += _run_structure(case, label, values)
    if case.flight is None:
        values = {**cases.MODELS["+ ay, az"], "actuators.estimate_delay": True}
        track = cases.identify(case, {**values, "actuators.delay": 0.0})
        out.append(_cell(case, "+ ay, az", "instrumental_variable, delay estimated", track))
    flown = dict(zip(("flight", "seed"), job, strict=True))
    return [flown | cell for cell in out]


def _run_structure(case: cases.Case, label: str, values: Mapping[str, object]) -> Iterator[Cell]:
    tracks = [cases.identify(case, {**values, "estimator": name}) for name in ESTIMATORS]
    for estimator, track in zip(ESTIMATORS, tracks, strict=True):
        yield _cell(case, label, estimator, track)
    yield from _run_adaptive(case, label, values)
    settings = case.settings(values)
    # Start from the online estimates at the end of the fitted part; the better fit counts.
    starts = [t.coefficients[t.at(output_error.TRAINING_PART * t.time[-1])] for t in tracks[1:]]
    found = output_error.fit(case, settings, starts)
    yield _cell(case, label, "output error", tracks[0].constant(found))


def _run_adaptive(case: cases.Case, label: str, values: Mapping[str, object]) -> Iterator[Cell]:
    track, recorder = adaptive_filters.recorded(case, values)
    ticks = len(track.t_ns) - len(recorder.y)  # the first ticks have no regressors
    methods = [("RLS", adaptive_filters.RLS_FORGETTING)]
    methods += [("NLMS", mu) for mu in adaptive_filters.NLMS_STEPS]
    for kind, mu in methods:
        found = adaptive_filters.run_filter(kind, mu, recorder)
        moved = replace(
            track, t_ns=track.t_ns[ticks:], coefficients=found, delay=track.delay[ticks:]
        )
        yield _cell(case, label, f"padasip {kind} {mu:g}", moved)


def _jobs(only: str, quick: bool, seeds: int) -> Iterator[tuple[str, int | None]]:
    """Yield the flights with their seeds; None for a recorded one."""
    for name in fnmatch.filter(QUICK if quick else FLIGHTS, only):
        if name not in cases.RECORDED_DELAY:
            yield from ((name, seed) for seed in range(1, 1 + (1 if quick else seeds)))
        elif cases.is_recorded(name):
            yield name, None
        else:
            print(f"{name}: left out, ../shared/bags/{name} is not there")


Group = Sequence[Cell]


def in_short(cells: Group) -> str:
    """Return a line with the fits of the default and the reference."""
    parts = [
        f"{structure} {method} {_fits([cell['model'] for cell in group])}"
        for (structure, method), group in bench.grouped(cells, "structure", "method").items()
        if method in (DEFAULT, REFERENCE)
    ]
    return f"{cells[0]['flight']} seed {cells[0]['seed']}: " + "; ".join(parts)


def _fits(fits: Sequence[Sequence[float]]) -> str:
    mean = np.mean(fits, axis=0)
    return "" if np.isnan(mean).all() else " / ".join(f"{value:.1f}" for value in mean)


def report(cells: Group) -> Iterator[str]:
    """Yield a table of each flight, the averages, and the distance from the output-error fit."""
    every = bench.grouped(cells, "structure", "method")
    # for each structure only the NLMS step with the best fit over all flights
    best: dict[str, tuple[float, str]] = {}
    for (structure, method), group in every.items():
        if "NLMS" in method:
            best[structure] = max(best.get(structure, (-np.inf, "")), (_clipped(group), method))
    left = {key for key in every if "NLMS" not in key[1] or best[key[0]][1] == key[1]}
    cells = [cell for cell in cells if (cell["structure"], cell["method"]) in left]
    for (flight,), own in bench.grouped(cells, "flight").items():
        yield f"\n{flight}, {len({cell['seed'] for cell in own})} seeds\n"
        yield from bench.table(HEAD, _flight_rows(own))
    families = {
        "exact": "exact",
        "JSBSim": ("c172p", "t37", "ov10"),
        "real": tuple(cases.RECORDED_DELAY),
    }
    yield f"\nMean of all axes and flights, each clipped at {CLIP:g}\n"
    yield from bench.table(("structure", "method", *families), _family_rows(cells, families))
    yield "\nOnline minus offline output error, same structure: mean, worst flight\n"
    yield from bench.table(("structure", "method", "mean", "worst"), _gap_rows(cells))


def _flight_rows(cells: Group) -> Iterator[Sequence[str]]:
    yield "", "hold the last rate", _fits([cell["hold"] for cell in cells]), "", "", ""
    for (structure, method), group in bench.grouped(cells, "structure", "method").items():
        fits = [cell["model"] for cell in group]
        spread = f"{np.std(fits, axis=0).max():.1f}" if len(fits) > 1 else ""
        error = float(np.mean([cell["coefficient_error"] for cell in group]))
        worst = "" if np.isnan(error) else f"{error:.1f}"
        known = _fits([cell["truth"] for cell in group])
        yield structure, method, _fits(fits), spread, known, worst


def _clipped(cells: Group) -> float:
    return float(np.maximum([cell["model"] for cell in cells], CLIP).mean()) if cells else np.nan


def _family_rows(cells: Group, families: Mapping[str, Any]) -> Iterator[Sequence[str]]:
    held = [cell | {"structure": "", "method": "hold", "model": cell["hold"]} for cell in cells]
    for key, group in bench.grouped([*held, *cells], "structure", "method").items():
        means = [
            _clipped([cell for cell in group if cell["flight"].startswith(names)])
            for names in families.values()
        ]
        yield *key, *("" if np.isnan(mean) else f"{mean:.1f}" for mean in means)


def _gap_rows(cells: Group) -> Iterator[Sequence[str]]:
    means = {
        key: np.maximum(np.mean([cell["model"] for cell in group], axis=0), CLIP)
        for key, group in bench.grouped(cells, "structure", "method", "flight").items()
    }
    for structure, method in bench.grouped(cells, "structure", "method"):
        gaps = {
            flight: fit - means[s, REFERENCE, flight]
            for (s, m, flight), fit in means.items()
            if (s, m) == (structure, method) and (s, REFERENCE, flight) in means
        }
        if gaps and method != REFERENCE:
            worst = min(gaps, key=lambda flight: float(gaps[flight].min()))
            mean = float(np.mean(list(gaps.values())))
            yield structure, method, f"{mean:.1f}", f"{gaps[worst].min():.1f}, {worst}"


def main() -> None:
    parser = bench.parser(__doc__, seeds=3, workers=2, output=bench.BUILD)
    parser.add_argument("--quick", action="store_true", help="six flights, one seed each")
    parser.add_argument("--only", default="*", metavar="PATTERN", help="flights, as in 'c172p_*'")
    options = parser.parse_args()
    jobs = list(_jobs(options.only, options.quick, options.seeds))
    if not jobs:
        parser.error(f"no flight matches '{options.only}': there are {', '.join(FLIGHTS)}")
    flown = bench.done(run_flight, jobs, options.workers, in_short)
    found = [cell for cells in flown for cell in cells]
    bench.keep(options.output / "accuracy.json", found)
    print(*report(found), sep="\n")


if __name__ == "__main__":
    main()
