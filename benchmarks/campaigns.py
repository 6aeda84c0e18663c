# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo campaigns: ``python benchmarks/campaigns.py NAME [--seeds N] [--quick]``.

Each flies flights of `flights.yaml` with seeds 1 to N and identifies them in one online pass with
the defaults. It prints the results with their spread, and writes every figure to
``build/campaign_NAME.json``.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import adaptive_filters
import bench
import cases
import flights
import numpy as np
import output_error

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.regression import Regression, RowSamples
from uav_ident_ros.identification.structure import STRUCTURES, BoolArray, FloatArray
from uav_ident_ros.simulation.flight import Flight

IV, LS = "instrumental_variable", "least_squares"
EXCITATION_START = 2.0
"""Start of the multisines of every flight, s."""

WIDEST = "augmented"
"""The structure that contains those of all plants here."""

Result = dict[str, Any]
Job = tuple[Any, ...]


def _line(result: Result) -> str:
    return f"{result['flight']} {result['seed']} {result['estimator']} {result['structure']}"


def _flown(job: Job, until: float = np.inf) -> tuple[Flight, cases.Track, Result]:
    """Fly and identify a job: flight, seed, estimator, and structure if not the widest."""
    name, seed, estimator, structure = (*job, WIDEST)[:4]
    case = cases.load(name, seed)
    track = cases.identify(case, {"estimator": estimator, "structure": structure}, until=until)
    assert case.flight is not None
    what = {"flight": name, "seed": seed, "estimator": estimator, "structure": structure}
    return case.flight, track, what


METHODS = ((IV, WIDEST), (IV, "throttle_coupled"), (LS, WIDEST))
"""Estimators, with the default structure and with the plant's, which is smaller."""


def _fly(
    measure: Callable[[Job], Result],
    flights: Mapping[str, int],  # With their numbers of seeds
    methods: Sequence[Sequence[str]],  # Estimators, and structures if not the widest
    workers: int,
) -> list[Result]:
    """Measure all flights with every method and seed."""
    jobs = [(n, s, *m) for n, c in flights.items() for m in methods for s in range(1, c + 1)]
    return bench.done(measure, jobs, workers, _line)


def _groups(results: Sequence[Result], *keys: str) -> Iterator[tuple[str, list[Result]]]:
    """Yield the results grouped by some keys, with the values of the keys in columns."""
    for values, group in bench.grouped(results, *keys).items():
        yield "".join(f"{value:24}" for value in values), group


def _spread(values: Sequence[float]) -> str:
    """Return median and range."""
    v = np.asarray(values, dtype=float)
    return f"median {np.median(v):.2f}, {v.min():.2f} to {v.max():.2f}"


# -- convergence ---------------------------------------------------------------------------


CONVERGENCE_FLIGHTS = {"exact_convergence": 32.0, "exact_noise_003": 32.0, "exact_gusts_03": 62.0}
"""Flights, with the time that is flown, s."""


def convergence(seeds: int, workers: int) -> list[Result]:
    """Measure the time of excitation until the six dominant coefficients stay within 10 %."""
    names = dict.fromkeys(CONVERGENCE_FLIGHTS, seeds)
    results = _fly(_convergence_of, names, METHODS, workers)
    for label, group in _groups(results, "flight", "estimator", "structure"):
        times = [r["seconds"] for r in group]
        soon = sum(t <= 7.5 for t in times)
        last = max({r["last"] for r in group}, key=[r["last"] for r in group].count)
        print(
            f"{label}{_spread(times)} s; {soon} of {len(times)} within 7.5 s; last to settle: "
            f"{last}"
        )
    return results


def _convergence_of(job: Job) -> Result:
    flight, track, what = _flown(job, CONVERGENCE_FLIGHTS[job[0]])
    where = cases.places(track.structure, cases.DOMINANT)
    truth = cases.truth_in(track.structure, flight)[where]
    off = np.abs(track.coefficients[:, *where] / truth - 1.0) > 0.1
    # The tick after the last one outside; infinite if the last tick is outside.
    after = [int(np.flatnonzero(column)[-1]) + 1 if column.any() else 0 for column in off.T]
    latest = max(after)
    settled = track.time[latest] if latest < len(track.time) else np.inf
    last = cases.DOMINANT[int(np.argmax(after))]
    return what | {"seconds": float(settled - EXCITATION_START), "last": last}


# -- gusts ---------------------------------------------------------------------------------


def gusts(seeds: int, workers: int) -> list[Result]:
    """Measure the free-run fit, on a held-out calm flight, of models from gusts of 1 rad/s^2."""
    results = _fly(_final_of, {"exact_gusts_10": seeds}, METHODS, workers)
    held_out = cases.load("exact_held_out")
    for result, fit in zip(results, _free_run_fits(held_out, results), strict=True):
        result["fit"] = fit.tolist()
    for label, group in _groups(results, "estimator", "structure"):
        fits = np.array([r["fit"] for r in group])
        parts = (fits.mean(axis=0), fits.std(axis=0), fits.min(axis=0))
        mean, sd, worst = ("/".join(f"{v:.1f}" for v in part) for part in parts)
        print(f"exact_gusts_10 -> exact_held_out {label}mean {mean}, sd {sd}, worst {worst}")
    return results


def _final_of(job: Job) -> Result:
    flight, track, what = _flown(job)
    return what | _at(track, -1, cases.truth_in(track.structure, flight, flight.duration))


def _at(track: cases.Track, tick: int, truth: FloatArray) -> Result:
    """Return estimate and truth at a tick."""
    return {
        "coefficients": track.coefficients[tick].tolist(),
        "sigma": track.sigma[tick].tolist(),
        "truth": truth.tolist(),
    }


def _free_run_fits(held_out: cases.Case, results: Sequence[Result]) -> FloatArray:
    """Return the fits of p, q, r of models that run freely over the whole flight, percent."""
    blocks = held_out.blocks(held_out.settings({}))
    x = np.concatenate([blocks[0].x, *(b.x[1:] for b in blocks[1:])])
    u = np.concatenate([b.u for b in blocks])
    force = np.concatenate([blocks[0].force, *(b.force[1:] for b in blocks[1:])])
    windows = output_error.Windows(blocks[0].h, x[:, :, None], u[:, :, None], force[:, :, None])
    a = np.zeros((*STRUCTURES[WIDEST].mask.shape, len(results), 1))
    for k, result in enumerate(results):
        found = np.array(result["coefficients"])
        a[:, : found.shape[1], k, 0] = found  # the paper's columns come first in every structure
    start = np.repeat(x[0][:, None, None], len(results), axis=1)
    path = output_error.simulate(a, start, windows)[:, :, :, 0]
    error = np.sqrt(((path - x[:, :, None]) ** 2).sum(axis=0))
    spread = np.sqrt(((x - x.mean(axis=0)) ** 2).sum(axis=0))
    return np.asarray(100.0 * (1.0 - error / spread[:, None])).T


# -- coverage ------------------------------------------------------------------------------

OPEN_LOOP = ("exact_monte_carlo", "exact_gusts_03", "exact_gusts_10")
CLOSED_LOOP = ("exact_closed_loop", "exact_closed_loop_gusts_10")


def coverage(seeds: int, workers: int) -> list[Result]:
    """Measure the share of errors within one and two standard deviations after 120 s."""
    names = dict.fromkeys(OPEN_LOOP, seeds) | dict.fromkeys(CLOSED_LOOP, max(1, seeds // 3))
    results = _fly(_final_of, names, ((IV,), (LS,)), workers)
    for label, group in _groups(results, "flight", "estimator"):
        print(f"{label}{_coverage_line(group)}")
    pooled = [r for r in results if r["flight"] in OPEN_LOOP]
    for label, group in _groups(pooled, "estimator"):
        print(f"{'open loop, pooled':24}{label}{_coverage_line(group)}")
    return results


def _ratios(results: Sequence[Result], names: Sequence[str] | None = None) -> FloatArray:
    """Return errors over sigma of the free or the named coefficients, shape (results, k)."""
    structure = STRUCTURES[WIDEST]
    where = cases.places(structure, names or structure.names)
    out = []
    for result in results:
        error, sigma = (np.array(result[k])[where] for k in ("coefficients", "sigma"))
        out.append((error - np.array(result["truth"])[where]) / sigma)
    return np.array(out)


def _coverage_line(group: Sequence[Result]) -> str:
    everything, dominant = np.abs(_ratios(group)), np.abs(_ratios(group, cases.DOMINANT))
    structure = STRUCTURES[WIDEST]
    within = (everything < 1.0).mean(axis=0)
    lowest = int(np.argmin(within))
    return (
        f"{len(group)} flights: within 1 sigma {_percent(everything < 1.0)}, 2 sigma "
        f"{_percent(everything < 2.0)}; the six: {_percent(dominant < 1.0)}, "
        f"{_percent(dominant < 2.0)}; lowest {structure.names[lowest]} {100 * within[lowest]:.0f}"
    )


def _percent(flags: BoolArray) -> str:
    """Return the share of true flags, with its standard error over flights."""
    per_flight = 100.0 * flags.mean(axis=1)
    error = per_flight.std() / np.sqrt(len(per_flight))
    return f"{per_flight.mean():.1f} ± {error:.1f} %"


# -- quiet flight --------------------------------------------------------------------------

QUIET_START = 62.0
"""End of the excitation of the quiet flights, s."""


def quiet(seeds: int, workers: int) -> list[Result]:
    """Measure the moves of coefficients in ten quiet minutes, in initial sigmas."""
    names = dict.fromkeys(("exact_quiet_gusts_03", "exact_quiet_gusts_10"), seeds)
    results = _fly(_quiet_of, names, ((IV,), (LS,)), workers)
    for label, group in _groups(results, "flight", "estimator"):
        moves = [r["move"] for r in group]
        worst = max(group, key=lambda r: r["move"])
        z = np.abs(_ratios(group))
        print(
            f"{label}largest move {_spread(moves)} sigma ({worst['name']}); "
            f"rows learned {100 * np.mean([r['learned'] for r in group]):.1f} % of the quiet; "
            f"at its beginning within 1 sigma {_percent(z < 1.0)}, 2 sigma {_percent(z < 2.0)}"
        )
    return results


def _quiet_of(job: Job) -> Result:
    flight, track, what = _flown(job)
    begin = track.at(QUIET_START)
    mask = track.structure.mask
    sigma = track.sigma[begin][mask]
    moves = np.abs(track.coefficients[begin:, mask] - track.coefficients[begin, mask]) / sigma
    worst = moves.max(axis=0)
    return what | {
        "move": float(worst.max()),
        "name": track.structure.names[int(worst.argmax())],
        "learned": float(track.learning[begin:].mean()),
        **_at(track, begin, cases.truth_in(track.structure, flight)),
    }


# -- changes -------------------------------------------------------------------------------

WATCHED = 30.0
"""Time of observation after a change, s."""

PLANT_CHANGES = tuple(
    f"exact_halved_{surface}{air}" for air in ("", "_gusts_05") for surface in cases.PRIMARY
)
AIRCRAFT_CHANGES = ("c172p_halved_elevator", "c172p_halved_aileron")


def changes(seeds: int, workers: int) -> list[Result]:
    """Measure detection and tracking of a halved control derivative, and moves of the others."""
    names = dict.fromkeys(PLANT_CHANGES, seeds)
    names |= dict.fromkeys(AIRCRAFT_CHANGES, max(1, seeds // 5))
    results = _fly(_change_of, names, ((IV,),), workers)
    for label, group in _groups(results, "flight"):
        noticed = [r["noticed"] for r in group]
        followed = [r["followed"] for r in group]
        moved = [r["moved"] for r in group]
        print(
            f"{label:32}{len(group)} seeds: noticed {_spread(noticed)} s "
            f"({sum(t <= 6.0 for t in noticed)} within 6 s); within 15 % {_spread(followed)} s "
            f"({sum(t <= 10.0 for t in followed)} within 10 s); others moved by "
            f"{_spread(moved)} of what is allowed ({sum(m <= 1.0 for m in moved)} kept, worst "
            f"{max(group, key=lambda r: r['moved'])['mover']}); "
            f"other releases {sum(r['false'] for r in group)}"
        )
    return results


def _change_of(job: Job) -> Result:
    name = job[0]
    planned = flights.definition(name)
    when = float((planned.get("changes") or planned["faults"])[0]["time"])
    flight, track, what = _flown(job, when + WATCHED)
    primary = cases.PRIMARY[name.split("_")[2]]
    i, j = track.structure.index(primary)
    begin = track.at(when)
    old = track.coefficients[begin]
    if flight.coefficients is not None:
        new = float(cases.truth_in(track.structure, flight, when + 1.0)[i, j])
    else:
        new = 0.5 * float(old[i, j])
    found = [t - when for t, name in track.changes if name == primary and t > when]
    off = np.flatnonzero(np.abs(track.coefficients[begin:, i, j] / new - 1.0) > 0.15)
    last = begin + int(off[-1]) + 1
    others = [n for n in cases.DOMINANT if n != primary]
    where = cases.places(track.structure, others)
    allowed = np.maximum(2.0 * track.sigma[begin][where], 0.1 * np.abs(old[where]))
    moved = (np.abs(track.coefficients[begin:, *where] - old[where]) / allowed).max(axis=0)
    own = {name for change in flight.changes for name in change.factors}
    derivatives = track.structure.places.items()
    own = own or {name for name, (_, column) in derivatives if column == j}
    return what | {
        "noticed": min(found, default=np.inf),
        "followed": float(track.time[last] - when) if last < len(track.time) else np.inf,
        "moved": float(moved.max()),
        "mover": others[int(moved.argmax())],
        "false": sum(name not in own for _, name in track.changes),
        "changes": _rounded(track),
    }


def _rounded(track: cases.Track) -> list[tuple[float, str]]:
    return [(round(t, 1), name) for t, name in track.changes]


def alarms(seeds: int, workers: int) -> list[Result]:
    """Count the covariance resets in 30 minutes without a change."""
    names = dict.fromkeys(("exact_half_hour", "c172p_half_hour"), seeds)
    results = _fly(_alarms_of, names, ((IV,),), workers)
    for r in results:
        print(f"{r['flight']:20}seed {r['seed']}: {len(r['changes'])} releases {r['changes']}")
    return results


def _alarms_of(job: Job) -> Result:
    _, track, what = _flown(job)
    return what | {"changes": _rounded(track)}


# -- cost ----------------------------------------------------------------------------------

WARM_UP_TICKS = 100


def cost(seeds: int, workers: int) -> list[Result]:
    """Measure the processor time of an update of 10 gyro samples, sigma included, and of RLS."""
    results = []
    for seed in range(1, seeds + 1):
        case = cases.load("exact_noise_003", seed)
        timed = {}
        for estimator in ("gradient", LS, IV):
            timed[f"{estimator}, whole tick"], timed[estimator] = _update_times(case, estimator)
        timed["padasip RLS, 1 sample a tick"] = _rls_times(case, 1)
        timed["padasip RLS, 10 samples a tick"] = _rls_times(case, 10)
        for method, times in timed.items():
            p50, p99 = np.percentile(1e6 * times[WARM_UP_TICKS:], [50, 99])
            print(f"seed {seed} {method:36}p50 {p50:6.0f} us, p99 {p99:6.0f} us")
            results.append({"seed": seed, "method": method, "p50": p50, "p99": p99})
    return results


def _update_times(case: cases.Case, estimator: str) -> tuple[FloatArray, FloatArray]:
    """Return the processor times, s, of each tick and of the estimator's update in it."""
    identifier = OnlineIdentifier(case.settings({"estimator": estimator}))
    update, times, own = identifier.estimator.update, [], []

    def timed(samples: Regression, rows: RowSamples, white: RowSamples, weight: FloatArray) -> None:
        began = time.thread_time()
        update(samples, rows, white, weight)
        own.append(time.thread_time() - began)

    setattr(identifier.estimator, "update", timed)  # noqa: B010  (a method, to the type checker)
    for message in case.messages(identifier):
        message.give(identifier)
        while (due := identifier.intake.due) is not None:
            began = time.thread_time()
            identifier.update(due)
            times.append(time.thread_time() - began)
    return np.array(times), np.array(own)


def _rls_times(case: cases.Case, samples: int) -> FloatArray:
    """Return the processor time, s, of padasip's three filters for `samples` samples."""
    structure = STRUCTURES[WIDEST]
    recorder = adaptive_filters.recorded(case, {})[1]
    filters = [
        adaptive_filters.make_filter("RLS", int(row.sum()), adaptive_filters.RLS_FORGETTING)
        for row in structure.mask
    ]
    times = []
    for y, f in zip(recorder.y, recorder.f, strict=True):
        rows = [f[row] for row in structure.mask]
        began = time.thread_time()
        for _ in range(samples):
            for one, target, row in zip(filters, y, rows, strict=True):
                one.adapt(target, row)
        times.append(time.thread_time() - began)
    return np.array(times)


# -- command -------------------------------------------------------------------------------


CAMPAIGNS: Mapping[str, tuple[Callable[[int, int], list[Result]], int, int]] = {
    "convergence": (convergence, 10, 5),
    "gusts": (gusts, 20, 6),
    "coverage": (coverage, 200, 12),
    "quiet": (quiet, 5, 1),
    "changes": (changes, 20, 5),
    "alarms": (alarms, 3, 1),
    "cost": (cost, 3, 1),
}
"""The campaigns, with their numbers of seeds: default, and with ``--quick``."""


def main() -> None:
    parser = bench.parser(__doc__, seeds=0, workers=2, output=bench.BUILD)
    parser.add_argument("name", choices=CAMPAIGNS, metavar="NAME", help=", ".join(CAMPAIGNS))
    parser.add_argument("--quick", action="store_true", help="few seeds")
    options = parser.parse_args()
    run, usual, few = CAMPAIGNS[options.name]
    results = run(options.seeds or (few if options.quick else usual), options.workers)
    bench.keep(options.output / f"campaign_{options.name}.json", results)


if __name__ == "__main__":
    main()
