# SPDX-License-Identifier: Apache-2.0
"""Correctness of the verdict usable: ``python benchmarks/false_usable.py [--classes NAME ...]``.

It flies the trials of `verdict_flights.py`, identifies each and compares the outputs with the truth
at every tick: the *whole* control derivatives pdot/da, qdot/de and rdot/dr, at fixed rates and flow
angles. A derivative is wrong if its error exceeds three of its sigmas, and its sign is wrong or the
error is more than half of the value.
"""

import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import bench
import cases
import numpy as np
import verdict_flights
from verdict_flights import GLITCH_TIME, Trial

from uav_ident_ros.files.parameter_file import PARAMETER_FILE, load_parameters
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray, Structure
from uav_ident_ros.identification.supervision import State
from uav_ident_ros.offline.run import run_over
from uav_ident_ros.simulation.noise import Measurements
from uav_ident_ros.simulation.recording import write_bag

MAIN = ("pdot/da", "qdot/de", "rdot/dr")
"""The compared control derivative of each row."""

SIGMAS, LARGEST_ERROR = 3.0, 0.5
"""Limits of an error, in sigmas and relative to the truth; a wrong value exceeds both."""

START = 30.0
"""Start of the count of usable time, s, for the classes that should be usable."""

GLITCH_LOOK = 20.0
"""Time after the glitch in which a missing verdict counts, s."""

NAMED_WITHIN = 10.0
"""Latest time of flight to report a mistake, s."""


@dataclass(frozen=True)
class Outcome:
    """Result of one trial."""

    # kind, name, seed: The trial
    kind: str
    name: str
    seed: int
    duration: float  # Evaluated time, s
    usable: float  # Share of the time after `START` with the verdict, of all rows
    ever: float  # Share of the whole flight in which some row is usable
    # wrong, wrong_sign: Share of the whole flight with a usable row whose derivative, or its sign,
    # is wrong
    wrong: float
    wrong_sign: float
    # Share of the whole flight with a usable row whose published fit is below that of holding the
    # rate
    losing: float
    fault: float  # Share of the flight with a fault: right in the classes with mistakes only
    lost: float  # Time without the verdict in the seconds after the glitch, less those before, s
    # (one, two) Coverage at 1 and 2 sigma of the derivatives with sigma below half of the true
    # value; NaN without any
    within: tuple[float, float]
    counted: int  # Number of these values
    feedback: bool
    # The control derivatives at the end: estimate, sigma, truth
    last: Mapping[str, tuple[float, float, float]]
    named: float  # Time at which a mistake was reported, s; NaN if never
    reason: str  # Last reason of the identifier


def whole(
    structure: Structure,
    true: Mapping[str, float],
    name: str,
    values: FloatArray,
    sigma: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return a whole derivative and its sigma, shape (K,), from coefficients (K, rows, n).

    With the flow angles as regressors, or neither them nor forces, it is the coefficient itself.
    With the forces as regressors, the effect through the surface's force is added.
    """
    row, _, regressor = name.partition("/")
    i, j = structure.index(name)
    value, variance = values[:, i, j].copy(), sigma[:, i, j] ** 2
    for force in ("ay", "az"):
        if f"{row}/{force}" in structure.names:
            by_force = true.get(f"{force}/{regressor}", 0.0)
            k, m = structure.index(f"{row}/{force}")
            value += by_force * values[:, k, m]
            variance += (by_force * sigma[:, k, m]) ** 2
    return value, np.sqrt(variance)


def judge(value: FloatArray, spread: FloatArray, truth: FloatArray) -> tuple[Any, Any]:
    """Return where the estimate, and where its sign, is wrong at three sigma, (K,) bool arrays.

    A lost surface has no sign: an estimate of its effect is wrong, but not in sign.
    """
    error = np.abs(value - truth)
    sure = error > SIGMAS * spread
    sign = sure & (value * truth < 0.0) & (np.abs(value) > SIGMAS * spread)
    return sign | (sure & (error > LARGEST_ERROR * np.abs(truth))), sign


def run(trial: Trial, structure_name: str) -> Outcome:
    """Fly one trial, identify it as the node does, and compare with the truth."""
    flown = trial.fly()
    case = flown if isinstance(flown, cases.Case) else cases.measured(flown)
    flight = case.flight  # None of a recorded flight, without truth
    named = {"structure": structure_name} if structure_name else {}
    structure = STRUCTURES[case.settings({**named, **trial.settings}).structure]
    initial = None
    if trial.warm:
        assert flight is not None
        healthy = verdict_flights.truth(flight, -1.0)
        initial = verdict_flights.warm_start(structure, healthy, trial.warm)
    losing: Any = False
    estimates: Sequence[Estimate]
    if trial.replayed:
        assert isinstance(flown, Measurements)
        estimates = _replay(flown, named, initial)
    else:
        given = flight.injected if trial.published and flight is not None else ()
        track = cases.identify(case, {**named, **trial.settings}, initial=initial, given=given)
        estimates, losing = track.estimates, track.losing
    return _outcome(trial, case, structure, estimates, losing)


def _outcome(
    trial: Trial, case: cases.Case, structure: Structure, estimates: Sequence[Estimate], losing: Any
) -> Outcome:
    """Compare the estimates with the truth."""
    flight = case.flight
    time = np.array([(e.t_ns - int(case.samples.imu_t_ns[0])) * 1e-9 for e in estimates])
    found = np.array([e.coefficients for e in estimates])
    sigma = np.array([e.sigma for e in estimates])
    usable = np.array([e.usable_rows for e in estimates], dtype=bool)
    reasons = [e.reason for e in estimates]
    true = [{} if flight is None else verdict_flights.truth(flight, t) for t in time]
    wrong = np.zeros(len(time), dtype=bool)
    wrong_sign = wrong.copy()
    last = {}
    for row, name in enumerate(MAIN):
        value, spread = whole(structure, true[0], name, found, sigma)
        truth = np.array([at.get(name, np.nan) for at in true])
        far, sign = judge(value, spread, truth)
        wrong |= usable[:, row] & far
        wrong_sign |= usable[:, row] & sign
        last[name] = (float(value[-1]), float(spread[-1]), float(truth[-1]))
    within, counted = _coverage(structure, true, found, sigma, time)
    every = usable.all(axis=1)
    return Outcome(
        trial.kind, trial.name, trial.seed,
        duration=float(time[-1]),
        usable=float(every[time >= START].mean()),
        ever=float(usable.any(axis=1).mean()),
        wrong=float(wrong.mean()),
        wrong_sign=float(wrong_sign.mean()),
        losing=float(np.any(usable & losing, axis=1).mean()),
        fault=float(np.mean([e.state == State.FAULT for e in estimates])),
        lost=_lost(time, every),
        within=within,
        counted=counted,
        feedback=trial.feedback,
        last=last,
        named=next((float(t) for t, reason in zip(time, reasons, strict=True)
                    if trial.names and re.search(trial.names, reason)), float("nan")),
        reason=reasons[-1],
    )  # fmt: skip


def _replay(measured: Measurements, values: Mapping[str, Any], initial: Any) -> Sequence[Estimate]:
    """Identify a flight from a bag, as `replay` does."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag"
        write_bag(measured, path)
        known = load_parameters(path / PARAMETER_FILE, "identifier")
        return run_over(path, {**known, **values}, initial).estimates


def _coverage(
    structure: Structure,
    true: Sequence[Mapping[str, float]],
    values: FloatArray,
    sigma: FloatArray,
    time: FloatArray,
) -> tuple[tuple[float, float], int]:
    """Return the coverage at one and two sigma of known values, once a second, and their number."""
    chosen = np.flatnonzero(time >= START)[::20]
    ratios = [np.zeros(0)]
    for name in true[0]:
        if name not in structure.names or name.startswith(("ay", "az")):
            continue
        value, spread = whole(structure, true[0], name, values[chosen], sigma[chosen])
        truth = np.array([true[k][name] for k in chosen])
        known = (spread > 0.0) & (spread < LARGEST_ERROR * np.abs(truth))
        ratios.append(np.abs(value - truth)[known] / spread[known])
    ratio = np.concatenate(ratios)
    if not len(ratio):
        return (float("nan"), float("nan")), 0
    return (float(np.mean(ratio < 1.0)), float(np.mean(ratio < 2.0))), len(ratio)


def _lost(time: FloatArray, usable: Any) -> float:
    """Return the time without the verdict after the glitch, minus that before it, s."""
    if time[-1] < GLITCH_TIME:
        return 0.0
    before = (time < GLITCH_TIME) & (time >= GLITCH_TIME - GLITCH_LOOK)
    after = (time >= GLITCH_TIME) & (time < GLITCH_TIME + GLITCH_LOOK)
    return float(GLITCH_LOOK * (np.mean(usable[before]) - np.mean(usable[after])))


def report(outcomes: Sequence[Outcome]) -> str:
    """Return the table of the classes and the totals."""
    lines = [
        f"{'class':14} {'flights':>7} {'usable':>7} {'wrong':>7} {'wrong sign':>10} {'losing':>7} "
        f"{'1 sigma':>8} {'2 sigma':>8} {'fault':>7}   (usable after {START:g} s; wrong to losing: "
        "share of usable time; fault: of all)"
    ]
    for kind in dict.fromkeys(o.kind for o in outcomes):
        own = [o for o in outcomes if o.kind == kind]
        lines.append(_line(kind, own))
        if kind == "glitch":
            lost = ", ".join(f"{o.lost:.1f}" for o in own)
            lines.append(f"{'':14} verdict lost after the glitch, s: {lost}")
        if kind == "mistakes":
            lines += [
                f"{'':14} {o.name}: "
                + (
                    f"named at {o.named:.1f} s"
                    if o.named <= NAMED_WITHIN
                    else f"not named within {NAMED_WITHIN:g} s, but at {o.named:.1f} s"
                )
                for o in own
            ]
    lines.append(_line("all", outcomes))
    lines.append(_line("open loop", [o for o in outcomes if not o.feedback]))
    lines.append(_line("under feedback", [o for o in outcomes if o.feedback]))
    return "\n".join(lines)


def _line(label: str, outcomes: Sequence[Outcome]) -> str:
    if not outcomes:
        return f"{label:14} {0:7}"
    time = np.array([o.duration for o in outcomes])
    ever, wrong, sign, losing = (
        float(np.sum(time * [getattr(o, name) for o in outcomes]))
        for name in ("ever", "wrong", "wrong_sign", "losing")
    )
    counted = np.array([o.counted for o in outcomes])
    within = np.array([np.nan_to_num(o.within) for o in outcomes])
    coverage = counted @ within / counted.sum() if counted.any() else np.full(2, np.nan)
    fault = time @ np.array([o.fault for o in outcomes]) / time.sum()
    per_usable = 1.0 / ever if ever > 0.0 else 0.0
    return (
        f"{label:14} {len(outcomes):7} {np.mean([o.usable for o in outcomes]):7.1%} "
        f"{wrong * per_usable:7.1%} {sign * per_usable:10.1%} {losing * per_usable:7.1%} "
        f"{coverage[0]:8.0%} {coverage[1]:8.0%} {fault:7.1%}"
    )


def details(outcome: Outcome) -> str:
    """Return the line of a trial."""
    last = "  ".join(
        f"{name} {value:.1f}+-{spread:.1f} ({true:.1f})"
        for name, (value, spread, true) in outcome.last.items()
    )
    return (
        f"{outcome.kind:14} {outcome.name} [{outcome.seed}]: usable {outcome.usable:.0%}, wrong "
        f"{outcome.wrong:.0%}, sign {outcome.wrong_sign:.0%}, losing {outcome.losing:.0%}, fault "
        f"{outcome.fault:.0%} of the flight; {last}; {outcome.reason or '-'}"
    )


def main() -> None:
    """Run the campaign."""
    parser = bench.parser(__doc__, workers=1, output=bench.BUILD)
    parser.add_argument("--seeds", type=int, help="seeds 1 to N of each flight: 2, --short 1")
    parser.add_argument("--structure", choices=tuple(STRUCTURES), default="")
    parser.add_argument("--classes", nargs="+", choices=tuple(verdict_flights.CLASSES))
    parser.add_argument("--short", action="store_true", help="shorter flights, one seed")
    options = parser.parse_args()
    classes = options.classes or list(verdict_flights.CLASSES)
    seeds = range(1, (options.seeds or (1 if options.short else 2)) + 1)
    length = verdict_flights.SHORT if options.short else verdict_flights.LONG
    jobs = verdict_flights.trials(classes, tuple(seeds), length)
    judged = partial(run, structure_name=options.structure)
    outcomes = bench.done(judged, jobs, options.workers, details)
    print(report(outcomes))
    bench.keep(options.output / "false_usable.json", [asdict(o) for o in outcomes])


if __name__ == "__main__":
    main()
