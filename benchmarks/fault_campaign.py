# SPDX-License-Identifier: Apache-2.0
"""Control after faults at random times, with adaptive and fixed controllers.

Each controller flies the same manoeuvres, in one process, without ROS:

inversion   inversion of the nominal model with a disturbance observer
PID         the usual rate loop: feed-forward, P, I, D, one surface for each axis
INDI        incremental inversion on the nominal control derivatives
adaptive    the same, on the derivatives identified and measured in flight, axis by axis
oracle      the same, on the true control derivatives after the fault, for a reduced effect

All have the largest bandwidth with a gain margin of two: they still settle if every input of the
healthy aircraft has twice its effect. The random order of the flights contains every aircraft and
fault once before any repetition: a stopped campaign is a fair sample. The fixed controllers fly the
cases in which the adaptive one lost the aircraft, or all (``--all``).

Tables go to the terminal, every flight to build/fault_campaign.jsonl.
"""

import json
import os
import pickle
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import bench
import numpy as np
from loop import (
    DELAY,
    Controller,
    Mission,
    Outcome,
    fly_loop,
    make_identifier,
    nominal_of,
    rate_controller,
)
from pid import SURFACES, PidController, PidGains

from uav_ident_ros.client import CoefficientSource, Fallback
from uav_ident_ros.control import IncrementalLaw, InversionLaw
from uav_ident_ros.control.choice import control_derivatives
from uav_ident_ros.identification.flow import FlowState
from uav_ident_ros.identification.structure import INPUT_COLUMNS, RATE_COLUMNS, FloatArray
from uav_ident_ros.simulation.aircraft import Aircraft, differentiate, settle
from uav_ident_ros.simulation.airframe import airframe_names
from uav_ident_ros.simulation.faults import SURFACE_NAMES
from uav_ident_ros.simulation.flight import EPOCH_NS
from uav_ident_ros.simulation.live import SIMULATION_RATE
from uav_ident_ros.simulation.noise import Sensors
from uav_ident_ros.simulation.preparation import SENSORS, Prepared, prepare

ADAPTIVE, ORACLE = "adaptive", "oracle"
FIXED = ("inversion", "PID", "INDI")
CONTROLLERS = (*FIXED, ADAPTIVE, ORACLE)

AIRCRAFT = ("c172p", "pa28", "T37", "J3Cub", "OV10", "ultra_stick_25e")
TIMES, SEEDS = 5, 3
"""Numbers of random fault times, and of seeds of noise and manoeuvres, per aircraft and fault."""

HEALTHY = "healthy"


@dataclass(frozen=True)
class Case:
    """A fault of a flight, or another error."""

    commands: tuple[str, ...] = ()  # At the time of the fault
    axis: int = 0  # The affected axis: p, q, r
    delay: float = DELAY  # True delay, s; the loop is configured for `DELAY`
    sensors: Sensors = SENSORS
    # Remaining shares of the effects of de, dr, da, and of the effects on the axis
    reduced: tuple[tuple[float, float, float], float] | None = None


FAULTS = {
    HEALTHY: Case(),
    "aileron halved": Case(("aileron effect 0.5",), reduced=((1.0, 1.0, 0.5), 1.0)),
    "elevator halved": Case(("elevator effect 0.5",), 1, reduced=((0.5, 1.0, 1.0), 1.0)),
    "rudder halved": Case(("rudder effect 0.5",), 2, reduced=((1.0, 0.5, 1.0), 1.0)),
    "elevator halved, pitch inertia +30 %": Case(
        ("elevator effect 0.5", "pitch inertia 1.3"), 1, reduced=((0.5, 1.0, 1.0), 1.0 / 1.3)
    ),
    "aileron reversed": Case(("aileron effect -1",)),
    "elevator reversed": Case(("elevator effect -1",), 1),
    "aileron lost": Case(("aileron effect 0",)),
    "elevator lost": Case(("elevator effect 0",), 1),
    "aileron jams": Case(("aileron jams",)),
    "aileron jams 0.05 rad off": Case(("aileron jams 0.05",)),
    "rudder jams": Case(("rudder jams",), 2),
    "roll inertia +50 %": Case(("roll inertia 1.5",)),
    "engine out": Case(("engine out",), 2),
    "cg aft 10 % of the chord": Case(("cg aft 0.1",), 1),
    "delay 60 ms, told 20": Case(delay=0.06),
    "gyro noise x 4, bias 0.02 rad/s": Case(
        sensors=replace(SENSORS, gyro_noise=0.02, gyro_bias=(0.02, -0.02, 0.02))
    ),
}
"""The faults; the last two hold from the start of the flight."""

BEFORE, AFTER = 15.0, 20.0
"""Shortest flight before a fault, and flight after it, s."""

SPREAD = 10.0
"""Range of the random time of the fault, s."""

RECOVERED = 1.2
"""Error after recovery, relative to the healthy flight."""

SPAN = 5.0
"""Length of the intervals of this comparison, and longest time to recovery, s."""

NOTICED = 8.0
"""Longest time to notice a fault, s."""

FACTORS = tuple(1.15**k for k in range(-8, 9))
"""Bandwidths in the search, relative to the default of the laws."""

WHOLE = 1.3
"""Largest relative error of the unaffected axes, 5 to 15 s after a jam or a loss."""

Make = Callable[[CoefficientSource], Controller]


# --- the controllers, tuned ------------------------------------------------------------------


def pid_gains(prepared: Prepared, factor: float) -> PidGains:
    """Return PID gains of the laws' bandwidth: K over the effect, feed-forward of the damping."""
    effect = control_derivatives(nominal_of(prepared))[0]
    main = np.array([effect[axis, column] for axis, column in enumerate(SURFACES)])
    rates = nominal_of(prepared).values[:3, RATE_COLUMNS].diagonal()
    k = factor * np.array(IncrementalLaw.gains.rate)
    return PidGains(
        forward=-rates / main, proportional=k / main, integral=k**2 / 2.0 / main,
        derivative=0.1 / main,
    )  # fmt: skip


def make_controller(prepared: Prepared, name: str, factor: float) -> Make:
    """Return a factory of a controller with that relative bandwidth."""
    if name == "PID":
        gains = pid_gains(prepared, factor)
        return lambda source: PidController(prepared.limits - prepared.trim, gains)
    law = InversionLaw if name == "inversion" else IncrementalLaw
    return rate_controller(prepared, name in (ADAPTIVE, ORACLE), law, law.gains.times(factor))


class Oracle:
    """Adaptive controller on the true control derivatives, from the fault on."""

    def __init__(
        self, prepared: Prepared, case: Case, when: float, make: Make, source: CoefficientSource
    ) -> None:
        nominal, speed = nominal_of(prepared), prepared.airframe.speed
        flow = FlowState(0.0, 0.0, 0.0, 0.0, roll=0.0, pitch=0.0, airspeed=speed)
        self._source, self._controller = source, make(source)
        self._before = replace(nominal, sigma=np.zeros_like(nominal.sigma), flow=flow)
        values, (surfaces, axis) = nominal.values.copy(), case.reduced or ((1.0, 1.0, 1.0), 1.0)
        values[:3, INPUT_COLUMNS] *= (*surfaces, 1.0)
        values[case.axis] *= axis
        self._after = replace(self._before, values=values)
        self._when_ns = EPOCH_NS + round(when * 1e9)
        self._last_ns, self._flow = EPOCH_NS, flow

    def update(self, t_ns: int, x: FloatArray, reference: FloatArray) -> FloatArray:
        """Return de, dr, da, dth, deviations from trim."""
        true = self._after if t_ns >= self._when_ns else self._before
        roll = self._flow.roll + (t_ns - self._last_ns) * 1e-9 * float(x[0])
        self._last_ns, self._flow = t_ns, self._flow._replace(roll=roll)
        self._source.add(replace(true, t_ns=t_ns, flow=self._flow))
        return self._controller.update(t_ns, x, reference)


def tuned(prepared: Prepared, name: str) -> float:
    """Return the largest bandwidth factor that settles with twice the effect."""
    passed = [f for f in FACTORS if settles(prepared, make_controller(prepared, name, f))]
    return max(passed, default=FACTORS[0])


def settles(prepared: Prepared, make: Make) -> bool:
    """Return whether a step settles in 3 s on the identified model with twice the effect."""
    nominal = nominal_of(prepared)
    source = CoefficientSource(Fallback.LAST_GOOD, nominal)
    controller = make(source)
    a = nominal.values[:3, RATE_COLUMNS]
    b = 2.0 * control_derivatives(nominal)[0]
    x, dt, rates = np.zeros(3), 0.01, []
    underway = [np.zeros(4)] * round(DELAY / dt)
    for k in range(round(3.0 / dt)):
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

Cell = tuple[str, str, int, int]
"""Aircraft, fault, time (counted) and seed."""


def design(names: Sequence[str], faults: Sequence[str]) -> list[Cell]:
    """Return all cells, in an order with a fair sample in every beginning."""
    rng = np.random.default_rng(16)
    pairs = [(name, fault) for fault in faults for name in names]
    turns = {pair: rng.permutation(TIMES * SEEDS) for pair in pairs}
    return [
        (*pairs[i], *map(int, divmod(turns[pairs[i]][k], SEEDS)))
        for k in range(TIMES * SEEDS)
        for i in rng.permutation(len(pairs))
    ]


def fault_time(k: int, seed: int) -> float:
    """Return the random time of the k-th fault of a seed's flights, s."""
    return round(BEFORE + SPREAD * float(np.random.default_rng([seed, k]).random()), 2)


def fly(prepared: Prepared, name: str, factor: float, cell: Cell) -> dict[str, Any]:
    """Fly one controller through one fault; return the results."""
    aircraft, fault, k, seed = cell
    case, when = FAULTS[fault], fault_time(k, seed)
    axis, commands = case.axis, tuple(f"{when}: {c}" for c in case.commands)
    mission = Mission(
        duration=AFTER + (BEFORE + SPREAD if fault == HEALTHY else when), faults=commands,
        seed=seed, sensors=case.sensors, delay=case.delay,
    )  # fmt: skip
    identifier = make_identifier(prepared) if name == ADAPTIVE else None
    make = make_controller(prepared, name, factor)
    if name == ORACLE:
        make = partial(Oracle, prepared, case, when, make)
    outcome = fly_loop(prepared, mission, make, identifier)
    # a healthy flight has the intervals of all fault times
    times = [fault_time(k, seed) for k in range(TIMES)] if fault == HEALTHY else [when]
    return {
        "aircraft": aircraft, "fault": fault, "k": k, "seed": seed, "controller": name,
        "time": when, "axis": axis, "lost": outcome.lost,
        "errors": [stretches(outcome, t) for t in times],
        "in spans": [
            [outcome.error(t + s, t + s + SPAN).tolist() for s in range(int(AFTER - SPAN) + 1)]
            for t in times
        ],
        "noticed": noticed(outcome, when, axis),
    }  # fmt: skip


def stretches(outcome: Outcome, when: float) -> list[list[float]]:
    """Return the errors before the fault and in three intervals after it, deg/s."""
    edges = (5.0, when, when + 5.0, when + 15.0, when + AFTER)
    return [outcome.error(*span).tolist() for span in pairwise(edges)]


def noticed(outcome: Outcome, when: float, axis: int) -> float | None:
    """Return the time to a covariance reset of the axis, or to a changed sign, s."""
    row = ("pdot", "qdot", "rdot")[axis]
    times = [t for t, name in outcome.changes if t > when and name.startswith(row)]
    times += [t for t, sources in outcome.sources if t > when and sources[axis] == "measured"]
    return min(times) - when if times else None


def recovered(flight: dict[str, Any], healthy: dict[str, Any]) -> float | None:
    """Return the time until the axis's error stays within 20 % of the healthy one, s."""
    if flight["lost"] is not None:
        return None
    ratio = relative(flight, healthy, "in spans")[:, flight["axis"]]
    bad = [k for k, value in enumerate(ratio) if not value <= RECOVERED]
    return float(bad[-1] + 1) if bad and bad[-1] + 1 < len(ratio) else (None if bad else 0.0)


def relative(flight: dict[str, Any], healthy: dict[str, Any], key: str) -> FloatArray:
    """Return errors relative to the healthy flight at the same time, shape (n, 3)."""
    return np.asarray(np.array(flight[key][0], float) / np.array(healthy[key][flight["k"]], float))


class Fleet:
    """Prepared aircraft with the bandwidths of their controllers, cached on disk."""

    def __init__(self, folder: Path, pool: ProcessPoolExecutor) -> None:
        self._folder, self._pool = folder, pool
        self._known: dict[str, tuple[Prepared, dict[str, float]]] = {}

    def __getitem__(self, name: str) -> tuple[Prepared, dict[str, float]]:
        """Return an aircraft and the bandwidth factors of its controllers."""
        file = self._folder / f"fault_campaign_{name}.pickle"
        if name not in self._known and file.exists():
            self._known[name] = pickle.loads(file.read_bytes())
        if name not in self._known:
            prepared = self._pool.submit(prepare, name).result()
            found = self._pool.map(tuned, [prepared] * len(CONTROLLERS), CONTROLLERS)
            self._known[name] = prepared, dict(zip(CONTROLLERS, found, strict=True))
            file.write_bytes(pickle.dumps(self._known[name]))
        return self._known[name]


def campaign(
    cells: Sequence[Cell],
    flown: list[dict[str, Any]],  # Earlier flights
    everyone: bool,  # Whether the fixed controllers fly all cells
    workers: int,
    folder: Path,  # Cache of the prepared aircraft
    end: float,  # Last start of a flight, on the steady clock, s
) -> Iterator[dict[str, Any]]:
    """Fly the missing flights and yield each."""
    done = {key(flight): flight for flight in flown}

    def fly_all(jobs: Sequence[tuple[str, Cell]]) -> Iterator[dict[str, Any]]:
        new = [pool.submit(fly, *arguments(*job)) for job in dict.fromkeys(jobs) if job not in done]
        for future in new:
            flight = future.result()
            done[key(flight)] = flight
            yield flight

    def arguments(name: str, cell: Cell) -> tuple[Prepared, str, float, Cell]:
        prepared, factors = fleet[cell[0]]
        return prepared, name, factors[name], cell

    with ProcessPoolExecutor(workers) as pool:
        fleet = Fleet(folder, pool)
        for start in range(0, len(cells), workers):
            some = cells[start : start + workers]
            if time.monotonic() > end:
                return
            healthy = [(aircraft, HEALTHY, 0, seed) for aircraft, _, _, seed in some]
            yield from fly_all([(ADAPTIVE, cell) for cell in (*healthy, *some)])
            pairs = list(zip(healthy, some, strict=True))
            reduced = [cell for pair in pairs if FAULTS[pair[1][1]].reduced for cell in pair]
            yield from fly_all([(ORACLE, cell) for cell in reduced])
            fixed = [
                (name, one)
                for pair in pairs
                if everyone or done[ADAPTIVE, pair[1]]["lost"] is not None
                for one in (pair if everyone else pair[1:])
                for name in FIXED
            ]
            yield from fly_all(fixed)


def key(flight: dict[str, Any]) -> tuple[str, Cell]:
    """Return controller and cell of a flight."""
    return flight["controller"], (
        flight["aircraft"], flight["fault"], flight["k"], flight["seed"]
    )  # fmt: skip


# --- the limit of any controller ---------------------------------------------------------------


def jam_limits(names: Sequence[str], jam: float) -> Iterator[str]:
    """Yield the table of the least errors with an aileron jammed at `jam` rad from trim.

    In steady flight sideslip and rudder balance its moments, by the true derivatives. At constant
    bank the aircraft then turns at ``ay / V`` beyond the coordinated rate, with any controller.
    """
    rows = []
    for name in names:
        aircraft = Aircraft(name, SIMULATION_RATE)
        settle(aircraft, SENSORS.rate)
        found = differentiate(aircraft)
        a = np.array(
            [
                [found.derivatives[f"{row}/{column}"] for column in ("beta", "r", "dr", "da")]
                for row in ("pdot", "rdot", "ay")
            ]
        )
        a[2] /= -found.airspeed  # r = ay / V
        a[2, 1] += 1.0
        beta, r, rudder = np.linalg.solve(a[:, :3], -jam * a[:, 3])
        least, most = aircraft.limits[:, SURFACE_NAMES.index("rudder")]
        rolls = -a[0, 3] * jam / found.derivatives["pdot/p"]
        rows.append(
            (
                name, *(f"{abs(np.degrees(x)):.1f}" for x in (rolls, beta)),
                f"{abs(rudder) / min(-least, most):.1f}", f"{abs(np.degrees(r)):.2f}",
            )
        )  # fmt: skip
    head = ("aircraft", "rolls without help, deg/s", "sideslip, deg", "rudder, of its travel")
    return bench.table((*head, "yaw error, deg/s"), rows)


# --- tables ----------------------------------------------------------------------------------

TITLES = (
    "fault", "controller", "flights", "before", "0 to 5 s", "5 to 15 s", "from 15 s", "other axes",
    "lost", f"noticed, s (within {NOTICED:g} s)", f"within 20 %, s (after {SPAN:g} s)",
    f"others within {100 * WHOLE - 100:.0f} %",
)  # fmt: skip


def lines(flights: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield the table of all aircraft, errors in deg/s, and the lost flights."""
    healthy = {
        (n, a, s): f for f in flights for n, (a, fault, _, s) in [key(f)] if fault == HEALTHY
    }
    groups = {
        (fault, name): [f for f in flights if f["fault"] == fault and f["controller"] == name]
        for fault in FAULTS
        for name in CONTROLLERS
    }
    rows = ((*key, *cells_of(some, healthy)) for key, some in groups.items() if some)
    yield from bench.table(TITLES, rows)
    fates: dict[Cell, dict[str, float | None]] = {}
    for flight in flights:
        name, cell = key(flight)
        fates.setdefault(cell, {})[name] = flight["lost"]
    for (aircraft, fault, k, seed), fate in fates.items():
        if fate.get(ADAPTIVE) is not None:
            also = ", ".join(name for name in FIXED if fate.get(name) is not None) or "nobody"
            yield f"lost: {aircraft}, {fault}, time {k}, seed {seed}; also by {also}"


def cells_of(some: Sequence[dict[str, Any]], healthy: dict[Any, dict[str, Any]]) -> list[str]:
    """Return the medians over the flights of a controller and a fault, and counts."""
    axis = some[0]["axis"]
    errors = np.array([f["errors"][0] for f in some], dtype=float)  # flights, spans, axes
    own = [(f, healthy.get((f["controller"], f["aircraft"], f["seed"]))) for f in some]
    compared = [(f, h) for f, h in own if h is not None and f is not h]
    others = [i for i in range(3) if i != axis]
    ratio = np.array([relative(f, h, "errors")[2, others].max() for f, h in compared])
    return [
        str(len(some)),
        *(_middle(errors[:, k, axis]) for k in range(4)),
        _middle(ratio, "x"),
        str(sum(f["lost"] is not None for f in some)),
        _times([f["noticed"] for f in some], NOTICED),
        _times([recovered(f, h) for f, h in compared], SPAN),
        f"{(ratio <= WHOLE).sum()} of {len(ratio)}",
    ]


def _middle(values: FloatArray, unit: str = "") -> str:
    finite = values[np.isfinite(values)]
    return f"{np.median(finite):.2f}{unit}" if len(finite) else "-"


def _times(values: Sequence[float | None], limit: float) -> str:
    """Return the median of the values that exist, and the count of those within the limit."""
    known = [v for v in values if v is not None]
    soon = sum(v <= limit for v in known)
    return f"{np.median(known):.1f} ({soon} of {len(values)})" if known else "-"


def main() -> None:
    """Fly the campaign."""
    result, workers = bench.BUILD / "fault_campaign.jsonl", max(1, (os.cpu_count() or 2) - 1)
    parser = bench.parser(__doc__, minutes=np.inf, result=result, workers=workers)
    parser.add_argument("aircraft", nargs="*", default=AIRCRAFT, help=", ".join(airframe_names()))
    parser.add_argument("--fault", action="append", choices=list(FAULTS)[1:], help="default: all")
    parser.add_argument("--cells", type=int, help="how many of the design at most")
    parser.add_argument("--all", action="store_true", help="every controller flies every cell")
    parser.add_argument(
        "--jam", type=float, help="fly nothing: least cost of an aileron jammed so far, rad"
    )
    options = parser.parse_args()
    if options.jam is not None:
        print(*jam_limits(options.aircraft, options.jam), sep="\n")
        return
    cells = design(options.aircraft, options.fault or list(FAULTS)[1:])[: options.cells]
    options.result.parent.mkdir(exist_ok=True)
    flights: list[Any] = []
    if options.result.exists():
        flights += map(json.loads, options.result.read_text(encoding="utf-8").splitlines())
    end = time.monotonic() + 60.0 * options.minutes
    with options.result.open("a", encoding="utf-8") as file:
        for flight in campaign(
            cells, flights, options.all, options.workers, options.result.parent, end
        ):
            flights.append(flight)
            print(json.dumps(flight), file=file, flush=True)
    for line in lines(flights):
        print(line)


if __name__ == "__main__":
    main()
