# SPDX-License-Identifier: Apache-2.0
"""Time from excitation to known derivatives, and its Cramér-Rao bound: ``excitation_bound.py``.

The light aircraft flies turns on its autopilot in gusts, and is excited from the tenth second on.
The result is the time from then until six derivatives stay within 15 % of the truth.

The bound is the time of an efficient estimator on the same flights. The Cramér-Rao bound of a
flight is the covariance of the extended Kalman filter of states (rates, flow angles, the gusts in
them) and all coefficients of the structure, linearised about the true trajectory, with the true
statistics of gusts and noise and the same prior (Tichavský, Muravchik and Nehorai, "Posterior
Cramér-Rao bounds for discrete-time nonlinear filtering", IEEE Trans. Signal Processing 46, 1998).
The errors of an efficient estimator are Gaussian, and its correction between two times is
independent of its later error: errors can be drawn backwards in time.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import bench
import cases
import light_aircraft
import numpy as np
import verdict_flights
from light_aircraft import GUST_TIME, ROLL_GUST_TIME, SPEED, TRUTH

from uav_ident_ros.identification.filters import expm
from uav_ident_ros.identification.prior import weak_sigma
from uav_ident_ros.identification.structure import (
    FORCE_ROWS,
    KINEMATIC_ROWS,
    ROWS,
    STRUCTURES,
    FloatArray,
)
from uav_ident_ros.simulation.flight import Flight

GUSTS = {"light": 0.3, "moderate": 0.8, "heavy": 1.5}
"""Wind on each axis, m/s rms, at 20 m/s."""

START, DURATION = 10.0, 70.0
"""Start of the excitation and end of the flight, s: a run of ``excitation.duration``."""

PEAKS = dict.fromkeys(("de", "dr", "da"), 0.08)
"""Peaks, rad: a tenth of the range of surfaces with 0.4 rad on either side."""

BAND = (0.2, 2.0)
"""Default of ``excitation.band``, Hz."""

BOUNDED = (*cases.DOMINANT, "pdot/beta", "qdot/alpha", "rdot/beta")
"""The six derivatives that must be near the truth, and three that are only reported."""

SIX = len(cases.DOMINANT)
CONTROLS = slice(3, SIX)
NEAR = 0.15
KNOWN = 4.0
"""Smallest t-ratio of a known derivative: ``supervision.min_t_ratio``."""

DRAWS = 100
RATE = verdict_flights.SENSORS.rate
TICK = 5
"""Samples in a tick."""

STRUCTURE = STRUCTURES["flight_dynamics"]
STATES = 8
"""p q r, beta and alpha in still air, the additions of gusts to both, and the rolling gust."""


Found = dict[str, Any]
"""Results of one flight."""


def covariances(flight: Flight, gust: float) -> FloatArray:
    """Return the Cramér-Rao bound of the dominant derivatives at the ticks, (K, D, D)."""
    every = round(flight.rate / RATE)
    u, x = flight.extra["surfaces"][::every], flight.rates[::every]
    ay, az = flight.specific_force[::every, 1:].T
    beta = (ay - TRUTH["ay/dr"] * u[:, 1]) / TRUTH["ay/beta"]
    alpha = (az - TRUTH["az/de"] * u[:, 0]) / TRUTH["az/alpha"]
    f = STRUCTURE.regressor(x, u, np.stack((beta, alpha), axis=1))
    motion, sensed, steps = linearised(gust)
    free = np.array(STRUCTURE.free)
    labels = np.array(STRUCTURE.row_labels)[free[:, 0]]
    # Rows in which each coefficient's term enters: state equations, measured forces.
    enters, shows = np.zeros((STATES, len(free))), np.zeros((5, len(free)))
    for k, row in enumerate(ROWS):
        enters[k] = labels == row
    for k, (force, angle) in enumerate(zip(FORCE_ROWS, KINEMATIC_ROWS, strict=True)):
        enters[3 + k] = (labels == force) / SPEED + (labels == angle)
        shows[3 + k] = labels == force
    size = STATES + len(free)
    p = np.diag([1.0] * STATES + [weak_sigma(STRUCTURE)[i, j] ** 2 for i, j in free])
    p[STATES - 3 : STATES, STATES - 3 : STATES] = np.diag(steps)
    decay = np.diag(motion)[-3:] ** 2
    sensors = verdict_flights.SENSORS
    noise = np.diag([sensors.gyro_noise**2] * 3 + [sensors.accelerometer_noise**2] * 2)
    chosen = [STATES + STRUCTURE.names.index(name) for name in BOUNDED]
    step, h = np.eye(size), np.hstack((sensed, shows))
    step[:STATES, :STATES] = motion
    out = []
    for k, row in enumerate(f[:, free[:, 1]]):
        h[:, STATES:] = shows * row
        gain = p @ h.T
        p -= gain @ np.linalg.solve(h @ gain + noise, gain.T)
        if k % TICK == 0:
            out.append(p[np.ix_(chosen, chosen)])
        step[:STATES, STATES:] = enters * row / RATE
        p = step @ p @ step.T
        p[range(5, 8), range(5, 8)] += steps * (1.0 - decay)
        p = 0.5 * (p + p.T)
    return np.array(out)


def linearised(gust: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the state transition over a sample, the measurement matrix, the gust variances."""
    a = np.zeros((STATES, STATES))
    c = verdict_flights.coefficients(STRUCTURE, TRUTH)
    beta, alpha = (STRUCTURE.column(name) for name in ("beta", "alpha"))
    rates = slice(STRUCTURE.column("p"), STRUCTURE.column("r") + 1)
    rows = np.zeros((5, STATES))  # of the accelerations and forces
    rows[:, :3] = c[:5, rates]
    rows[:, 3] = rows[:, 5] = c[:5, beta]
    rows[:, 4] = rows[:, 6] = c[:5, alpha]
    rows[:, 7] = c[:5, rates.start]  # roll rate relative to the air
    a[:3], a[3:5] = rows[:3], rows[3:] / SPEED
    a[3, 2], a[4, 1] = -1.0, 1.0
    a[range(5, 8), range(5, 8)] = -1.0 / np.array([GUST_TIME, GUST_TIME, ROLL_GUST_TIME])
    variances = gust**2 * np.array([SPEED**-2, SPEED**-2, light_aircraft.LightFlight.roll_gust**2])
    sensed = np.vstack((np.eye(3, STATES), rows[3:]))
    return expm(a / RATE), sensed, variances


def for_good(near: FloatArray) -> dict[str, float]:
    """Return the median time until derivatives (..., K, D) stay near, s; inf if never."""
    chosen = {name: near[..., k] for k, name in enumerate(BOUNDED)}
    chosen["all"] = near[..., :SIX].all(axis=-1)
    out = {}
    for name, each in chosen.items():
        ticks = each.shape[-1] - np.cumprod(each[..., ::-1], axis=-1).sum(axis=-1)
        seconds = np.where(ticks < each.shape[-1], ticks * TICK / RATE, np.inf)
        out[name] = float(np.percentile(seconds, 50, method="nearest"))
    return out


def drawn(covariance: FloatArray, seed: int) -> FloatArray:
    """Draw errors of efficient estimators, (DRAWS, K, D), for a bound (K, D, D)."""
    rng = np.random.default_rng(seed)
    learned = np.concatenate((covariance[:-1] - covariance[1:], covariance[-1:]))
    values, vectors = np.linalg.eigh(learned)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
    steps = np.einsum("kij,nkj->nki", root, rng.standard_normal((DRAWS, *covariance.shape[:2])))
    return np.asarray(np.cumsum(steps[:, ::-1], axis=1)[:, ::-1])


def judge(job: tuple[str, int, bool]) -> Found:
    """Fly and identify one flight, and compute its bound."""
    gusts, seed, excited = job
    m = verdict_flights.fly(
        "light_aircraft", seed, excitation=((START, START + DURATION),) if excited else (),
        band=BAND, peaks=PEAKS, duration=DURATION, bank=20.0, wind=GUSTS[gusts],
    )  # fmt: skip
    flight = m.flight
    track = cases.identify(cases.measured(m), {}, given=flight.injected if excited else ())
    truth = np.array([TRUTH[name] for name in BOUNDED])
    rows, columns = cases.places(STRUCTURE, BOUNDED)
    values, sigmas = track.coefficients[:, rows, columns], track.sigma[:, rows, columns]
    usable = np.array([e.usable_rows for e in track.estimates])
    errors, allowed = np.abs(values - truth), NEAR * np.abs(truth)
    first = round(START * RATE / TICK)
    bound = {}
    if excited:
        error = drawn(covariances(flight, GUSTS[gusts])[first:], seed)
        bound = for_good(np.abs(error) <= allowed)
    wrong = (errors > 0.5 * np.abs(truth))[:, CONTROLS]
    known = (np.abs(values) > KNOWN * sigmas)[:, CONTROLS]
    return {
        "gusts": gusts, "seed": seed, "excited": excited,
        # Until near for good, s, and the same of efficient estimators, median
        "seconds": for_good((errors <= allowed)[first:]), "bound": bound,
        # Share of the ticks within two sigma, by derivative
        "within": (errors <= 2.0 * sigmas).mean(axis=0).tolist(),
        # ... with a known control derivative, with a usable row, with one off by more than half
        "known": float(known.any(axis=1).mean()),
        "usable": float(usable.any(axis=1).mean()),
        "wrong": float((usable & wrong).any(axis=1).mean()),
    }  # fmt: skip


def lines(found: Sequence[Found]) -> Iterator[str]:
    """Yield the tables."""
    names = (*BOUNDED, "all")
    yield "| gusts, flights | | " + " | ".join((*BOUNDED, "all six")) + " |"
    yield "|---" * (len(names) + 2) + "|"
    excited = [f for f in found if f["excited"]]
    for (gusts,), some in bench.grouped(excited, "gusts").items():

        def cells(what: str, some: Sequence[Found] = some) -> str:
            each = ([f[what][name] for f in some] for name in names)
            return " | ".join(f"{np.percentile(s, 50, method='nearest'):.1f}" for s in each)

        within = 100.0 * np.mean([f["within"] for f in some], axis=0)
        soon = sum(f["seconds"]["all"] <= 1.5 * f["bound"]["all"] for f in some)
        yield f"| {gusts}, {len(some)} | near for good, s | {cells('seconds')} |"
        yield f"| | bound, s | {cells('bound')} |"
        shares = " | ".join(f"{w:.0f}" for w in within)
        yield f"| | within 2 sigma, % | {shares} | {within[:SIX].mean():.1f} |"
        yield (
            f"{gusts}: {soon} of {len(some)} within 1.5 times the bound; usable and wrong "
            f"{100 * np.mean([f['wrong'] for f in some]):.1f} % of the time"
        )
    quiet = [f for f in found if not f["excited"]]
    for (gusts,), some in bench.grouped(quiet, "gusts").items():
        known, usable, wrong = (
            100.0 * np.mean([f[name] for f in some]) for name in ("known", "usable", "wrong")
        )
        within_2 = 100.0 * np.mean([f["within"][:SIX] for f in some])
        yield (
            f"{gusts}, without excitation, {len(some)}: of the time a control derivative known "
            f"{known:.0f} %, a row usable {usable:.0f} %, and wrong {wrong:.1f} %; the six within "
            f"2 sigma {within_2:.0f} %"
        )


def main() -> None:
    """Fly and print."""
    output = bench.BUILD / "excitation_bound.json"
    parser = bench.parser(__doc__, seeds=20, workers=2, output=output)
    parser.add_argument("--gusts", choices=tuple(GUSTS), action="append")
    parser.add_argument("--excited", action="store_true", help="leave out the flights without")
    options = parser.parse_args()
    jobs = [
        (gusts, seed, excited)
        for gusts in options.gusts or GUSTS
        for seed in range(1, options.seeds + 1)
        for excited in ((True,) if options.excited else (True, False))
    ]
    found = bench.done(judge, jobs, options.workers, lambda one: f"{one['seconds']['all']:.1f} s")
    bench.keep(options.output, found)
    print("\n".join(lines(found)))


if __name__ == "__main__":
    main()
