# SPDX-License-Identifier: Apache-2.0
"""Estimates of transport delay and servo lag: ``python benchmarks/delays.py [--seeds N]``.

For each flight it prints the estimated sum, its sigma, and the largest error of a sure estimate in
sigmas. ``--told``: flights that publish the injected signal; the lag is printed, too. ``--quiet``:
flights with excitation in the first minute and the last 20 s, and the move of the delay in use in
between. ``--sweep``: free fits over 1 s of recorded flights, with fixed delays and with the
estimated one.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from operator import itemgetter
from typing import Any, NamedTuple

import bench
import cases
import numpy as np
from verdict_flights import UNTOLD, fly

from uav_ident_ros.identification.delay import SURE_SIGMA, DelayBank, DelayEstimate
from uav_ident_ros.identification.flow import FlowObserver
from uav_ident_ros.identification.prediction import HORIZONS
from uav_ident_ros.identification.prior import first_values
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.simulation.noise import Measurements, Sensors
from uav_ident_ros.simulation.quadrotor_flight import NAME as QUADROTOR
from uav_ident_ros.simulation.quadrotor_flight import Body

DURATION = 90.0
NOISY = Sensors(gyro_noise=0.02, accelerometer_noise=0.1, stamped=True)
LATE = ((0.0, 0.0), (0.05, 0.0), (0.1, 0.0), (0.15, 0.0), (0.0, 0.06), (0.08, 0.06), (0.02, 0.12),
        (0.15, 0.12))  # fmt: skip
"""Delays and lags, s."""

EXCITED = 60.0
"""Time of excitation on flights that publish the injected signal, s."""

QUIET_UNTIL, LONG = 360.0, 380.0
"""End of the quiet part, which starts at `EXCITED`, and of the flight, s."""

PIECE = 100
"""Cells of the bank's blocks: half a second or a second."""

SWEEP = (0.0, 0.04, 0.08, 0.1, 0.12, 0.16)
"""Fixed delays of the sweep over recorded flights, s."""


class Trial(NamedTuple):
    """A flight for the estimation of delay and lag."""

    name: str
    fly: Callable[[], Measurements]
    excited: bool = True
    published: bool = False  # Whether the injected signal is published


FLOWN: dict[str, tuple[str, dict[str, Any]]] = {
    "light_aircraft": ("light, {late}, wind {wind:g} m/s", {"bank": 20.0}),
    "c172p": ("c172p, {delay:.0f} ms, turbulence {wind}", {"bank": 20.0}),
    "small_uav": (
        "plant, {late}, gusts {wind:g} rad/s^2",
        {"sensors": NOISY, "excitation": ((0.0, DURATION),)},
    ),
    QUADROTOR: (
        "quadrotor, {late}, gusts {wind:g} rad/s^2",
        {"sensors": replace(NOISY, rate=100.0), "band": (0.2, 4.0), "period": 20.0},
    ),
}
"""Name of the trial and arguments of `fly` for each aircraft."""


def flown(
    seed: int,
    aircraft: str,
    delay: float,
    lag: float,
    wind: float,
    name: str = "",  # Of the trial, if not by `FLOWN`
    *,
    excited: bool = True,
    published: bool = False,
    **more: Any,
) -> Trial:
    """Return a trial of an aircraft; `more` are arguments of `fly`."""
    text, own = FLOWN[aircraft]
    late = f"{1e3 * delay:.0f} + {1e3 * lag:.0f} ms"
    name = (name or text).format(late=late, delay=1e3 * delay, wind=wind)
    own = {"duration": DURATION, **own, **more}
    flight = partial(fly, aircraft, seed, wind=wind, delay=delay, time_constant=lag, **own)
    return Trial(name, flight, excited, published)


def trials(seed: int) -> Iterator[Trial]:
    """Yield flights in open and closed loop, some without excitation."""
    of = partial(flown, seed)
    for delay, lag in LATE:
        for wind in (0.0, 0.5, 1.0):
            yield of("light_aircraft", delay, lag, wind, excitation=((2.0, DURATION),))
        for wind in (0.3, 1.0):
            yield of("small_uav", delay, lag, wind, autopilot=wind > 0.5 or lag > 0.0)
    for severity, delay in product((0, 3, 5), (0.0, 0.06, 0.15)):
        yield of("c172p", delay, 0.0, severity)
    for wind, delay in product((0.0, 0.1, 0.3, 1.0), (0.012, 0.06)):
        yield of(QUADROTOR, delay, Body.time_constant, wind)
    quiet = partial(of, excitation=(), excited=False)
    stiff = {"roll_gust": 0.5, "roll_gain": 0.8, "yaw_damper": 0.3}
    for wind in (0.3, 1.0):
        yield quiet("small_uav", 0.06, 0.0, wind, "plant, feedback, gusts {wind:g}", autopilot=True)
        for name, more in (("feedback", {}), ("stiff feedback", stiff)):
            yield quiet(
                "light_aircraft", 0.05, 0.0, wind, f"light, {name}, wind {{wind:g}}", **more
            )


def published_trials(seed: int) -> Iterator[Trial]:
    """Yield flights under autopilots that publish the injected signal."""
    end = EXCITED + 2.0
    of = partial(
        flown, seed, published=True, excitation=((2.0, end),), duration=end,
        surfaces=("de", "dr", "da"), period=10.0,
    )  # fmt: skip
    for wind, lag in product((0.0, 0.1, 0.2, 0.5, 1.0), (0.03, 0.05, 0.08)):
        yield of(QUADROTOR, 0.012, lag, wind)
    for name, aircraft, winds in (
        ("light", "light_aircraft", (0.0, 0.5, 1.0)), ("c172p", "c172p", (0, 2, 4)),
    ):  # fmt: skip
        text = f"{name}, {{late}}, wind {{wind:g}}"
        for wind, delay, lag in product(winds, (0.0, 0.06, 0.1), (0.0, 0.06, 0.12)):
            yield of(aircraft, delay, lag, wind, text, band=(0.2, 2.0))


def quiet_trials(seed: int) -> Iterator[Trial]:
    """Yield flights with a long quiet part."""
    of = partial(flown, seed, excitation=((2.0, EXCITED), (QUIET_UNTIL, LONG)), duration=LONG)
    for (delay, lag), wind in product(((0.0, 0.0), (0.06, 0.0), (0.08, 0.06)), (0.3, 1.0)):
        yield of("small_uav", delay, lag, wind, autopilot=True)
        yield of("light_aircraft", delay, lag, wind)
    for severity, delay in product((2, 4), (0.0, 0.06)):
        yield of("c172p", delay, 0.0, severity)


class Result(NamedTuple):
    """Result of one flight."""

    trial: Trial
    true: float  # Delay and lag, s
    lag: float  # Lag alone, s
    estimate: DelayEstimate
    worst: float  # Largest error of a sure estimate of the flight, in its sigmas


def held(trial: Trial) -> tuple[float, str]:
    """Fly a trial and identify it as the node does, without configured delay and lag.

    Returns the largest move of the delay in use after the excitation, s, and a line on it.
    """
    m = trial.fly()
    case = cases.measured(m)
    structure = "augmented" if trial.name.startswith("plant") else "flight_dynamics"
    track = cases.identify(case, UNTOLD | {"structure": structure})
    # Half a block later all excited samples are judged.
    after = track.delay[track.at(EXCITED + 0.5 * HORIZONS[-1]) :]
    moved = float(np.abs(after - after[0]).max())
    true = m.flight.delay + m.flight.time_constant
    return moved, (
        f"{trial.name:<36} true {1e3 * true:4.0f}  when the quiet begins {1e3 * after[0]:4.0f}, "
        f"moved by {1e3 * moved:3.0f}, at the end {1e3 * after[-1]:4.0f} ms"
    )


def judged(trial: Trial) -> Result:
    """Fly a trial and run the bank over the blocks of the identifier's sampler."""
    m = trial.fly()
    given = m.flight.injected if trial.published else None
    true = m.flight.delay + m.flight.time_constant
    structure = STRUCTURES["flight_dynamics"]
    speed = 20.0 if m.flight.airspeed is None else float(np.mean(m.flight.airspeed))
    case = cases.measured(m)
    settings = case.settings(UNTOLD | {"airspeed.reference": speed})
    bank, observer = DelayBank(0.3), FlowObserver(structure, 15.0, speed)
    worst = 0.0
    for block in case.blocks(settings, given):
        observer.follow(block, first_values(structure), None)
        for k in range(0, len(block.u), PIECE):
            if bank.add(cut(block, k, trial.name), 0.0) and bank.estimate.total_sure:
                off = abs(bank.estimate.total - true) / bank.estimate.total_sigma
                worst = max(worst, off)
    return Result(trial, true, m.flight.time_constant, bank.estimate, worst)


def cut(block: Block, k: int, name: str) -> Block:
    """Return the k-th piece of `PIECE` cells; only aircraft have flow angles."""
    cells, edges = slice(k, k + PIECE), slice(k, k + PIECE + 1)
    flies = not name.startswith(("plant", "quadrotor"))
    return replace(
        block, t_ns=block.t_ns[edges], u=block.u[cells],
        state=(block.state if flies else block.x)[edges],
        airspeed=block.airspeed if flies else None,
        excitation=None if block.excitation is None else block.excitation[cells],
        specific_force=block.specific_force[edges], restarted=block.restarted and k == 0,
    )  # fmt: skip


def line(r: Result) -> str:
    """Return the line of one flight."""
    e = r.estimate
    status = "sure" if e.total_sure else "delay" if e.sure else "not known"
    lag = f"  lag {1e3 * r.lag:3.0f}: {1e3 * e.lag:3.0f} +- {1e3 * e.lag_sigma:2.0f}"
    lag = lag if e.lag_sure else ""
    return (
        f"{r.trial.name:<36} true {1e3 * r.true:4.0f}  found {1e3 * e.total:4.0f} +- "
        f"{1e3 * e.total_sigma:3.0f} ms  {status:<10} worst {r.worst:.1f} sigma{lag}"
    )


def summary(results: Sequence[Result]) -> Iterator[str]:
    """Yield the figures of record."""
    for excited in (True, False):
        of = [r for r in results if r.trial.excited == excited]
        sure = [r for r in of if r.estimate.total_sure]
        off = [1e3 * abs(r.estimate.total - r.true) for r in sure]
        wrong = sum(r.worst > 3.0 for r in of)
        beyond = sum(error > 15.0 for error in off)
        yield (
            f"{'excited' if excited else 'feedback alone'}: {len(of)} flights, sum known in "
            f"{len(sure)}, delay with the lag in use in {sum(r.estimate.sure for r in of)}; "
            f"error rms {np.sqrt(np.mean(np.square(off or [0.0]))):.1f} ms, largest "
            f"{max(off, default=0.0):.1f}, beyond 15 ms {beyond}; "
            f"ever sure and wrong by 3 sigma: {wrong}"
        )
        split = [r for r in sure if r.estimate.lag_sure]
        if split:
            lags = np.array([1e3 * (r.estimate.lag - r.lag) for r in split])
            worst = max(abs(r.estimate.lag - r.lag) / r.estimate.lag_sigma for r in split)
            yield (
                f"lag known in {len(split)}: error rms {np.sqrt(np.mean(lags**2)):.1f} ms, largest "
                f"{np.abs(lags).max():.1f}, {worst:.1f} sigma"
            )


def sweep(name: str) -> str:
    """Return free 1-s fits of a recorded flight, with fixed delays and with the estimated one."""
    parts = []
    for delay in (*SWEEP, None):
        values: dict[str, Any] = {"actuators.delay": delay or 0.0}
        values["actuators.estimate_delay"] = delay is None
        case = cases.recorded(name)
        track = cases.identify(case, {"structure": "flight_dynamics", **values})
        fit = " / ".join(f"{v:.0f}" for v in cases.score(case, track).free[0])
        parts.append(
            f"{1e3 * track.delay[-1]:.0f} ms{'' if delay is not None else ' found'}: {fit}"
        )
    return f"{name}: " + ", ".join(parts)


def main() -> None:
    """Print the estimates."""
    parser = bench.parser(__doc__, seeds=2, workers=2)
    parser.add_argument("--told", action="store_true", help="the injected signal is published")
    parser.add_argument("--quiet", action="store_true", help="flights with long quiet parts")
    parser.add_argument("--sweep", action="store_true", help="recorded flights instead")
    options = parser.parse_args()
    if options.sweep:
        flights = filter(cases.is_recorded, cases.RECORDED_DELAY)
        bench.done(sweep, flights, options.workers)
        return
    chosen = quiet_trials if options.quiet else published_trials if options.told else trials
    todo = [trial for seed in range(1, options.seeds + 1) for trial in chosen(seed)]
    if options.quiet:
        flown = bench.done(held, todo, options.workers, itemgetter(1))
        beyond = sum(moved > SURE_SIGMA for moved, _ in flown)
        print(f"moved by more than {1e3 * SURE_SIGMA:g} ms: {beyond} of {len(flown)}")
        return
    print(*summary(bench.done(judged, todo, options.workers, line)), sep="\n")


if __name__ == "__main__":
    main()
