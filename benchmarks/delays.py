# SPDX-License-Identifier: Apache-2.0
"""Delay and servo lag found from the flight: ``python benchmarks/delays.py [--seeds N] [--told]``.

Simulated flights of three aircraft, in the open and the closed loop, in gusts from none to strong,
with every delay and lag, told neither; flights of a quadrotor, whose autopilot answers every gust;
and flights on which nobody excites. Printed for each: the sum that was found, its sigma, and the
largest error in sigmas of any estimate of the flight that was sure.

With ``--told`` flights of a hovering quadrotor, the light aircraft and the c172p, all under
autopilots, of which it is told what is injected: the lag is printed, too.

With ``--quiet`` flights that are excited for a minute and again for the last 20 s, with five
minutes under the autopilot alone between: the delay in use when the quiet begins, how far it moves
from there at most, and what it is at the end.

With ``--sweep`` recorded flights: the free fits over 1 s with fixed delays, and with the delay
estimated.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import bench
import cases
import numpy as np
import verdict_flights
from light_aircraft import LightFlight

from uav_ident_ros.identification.delay import SURE_SIGMA, DelayBank, DelayEstimate
from uav_ident_ros.identification.flow import FlowObserver
from uav_ident_ros.identification.prediction import HORIZONS
from uav_ident_ros.identification.prior import first_values
from uav_ident_ros.identification.sampling import Block, FlowSignals
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.simulation import jsbsim_flight
from uav_ident_ros.simulation.airframe import airframe
from uav_ident_ros.simulation.inputs import ColouredNoise, Segment
from uav_ident_ros.simulation.live import Plan
from uav_ident_ros.simulation.noise import Measurements, Sensors, measure
from uav_ident_ros.simulation.plant import PlantFlight, vehicle
from uav_ident_ros.simulation.quadrotor_flight import AMPLITUDES, QuadrotorFlight

DURATION = 90.0
NOISY = Sensors(gyro_noise=0.02, accelerometer_noise=0.1, stamped=True)
PEAKS = {"de": 0.08, "dr": 0.12, "da": 0.06, "dth": 0.2}
LATE = ((0.0, 0.0), (0.05, 0.0), (0.1, 0.0), (0.15, 0.0), (0.0, 0.06), (0.08, 0.06), (0.02, 0.12),
        (0.15, 0.12))  # fmt: skip
"""Delays and lags, s."""

EXCITED = 60.0
"""Time of excitation on flights that say what is injected, s."""

QUIET_UNTIL, LONG = 360.0, 380.0
"""When a long quiet part, which begins at `EXCITED`, ends, and the flight, s."""

PIECE = 100
"""Cells that the bank sees at a time: half a second or a second."""

SWEEP = (0.0, 0.04, 0.08, 0.1, 0.12, 0.16)
"""Fixed delays of the sweep over recorded flights, s."""


class Result(NamedTuple):
    """What came of one flight."""

    name: str
    excited: bool
    true: float  # Delay and lag, s
    lag: float  # Lag alone, s
    estimate: DelayEstimate
    worst: float  # Largest error of a sure estimate in its sigmas, any time


def plant(
    seed: int,
    delay: float,
    lag: float,
    gusts: float,
    closed: bool,
    excitation: Sequence[tuple[float, float]] = ((0.0, DURATION),),
    duration: float = DURATION,
) -> Measurements:
    """Fly the aircraft of the paper's structure."""
    segments = [
        Segment("multisine", start, until - start, PEAKS, seed=seed) for start, until in excitation
    ]
    flight = PlantFlight(
        segments, duration, vehicle=vehicle("small_uav"), rate=200.0, max_step=2.5e-3,
        delay=delay, time_constant=lag, gusts=ColouredNoise(gusts, 0.3), autopilot=closed,
        seed=seed,
    )  # fmt: skip
    return measure(flight.fly(), NOISY, seed)


def light(seed: int, delay: float, lag: float, gusts: float, **more: Any) -> Measurements:
    """Fly the light aircraft on its autopilot, which turns."""
    flown: dict[str, Any] = {"excitation": ((2.0, DURATION),), "duration": DURATION, "bank": 20.0}
    return verdict_flights._fly(
        "light_aircraft", seed, wind=gusts, delay=delay, time_constant=lag, **(flown | more)
    )


def quadrotor(seed: int, delay: float, gusts: float) -> Measurements:
    """Let the quadrotor hover."""
    segments = (Segment("multisine", 2.0, DURATION, AMPLITUDES, band=(0.2, 4.0), seed=seed),)
    flight = QuadrotorFlight(
        segments, DURATION, 500.0, delay=delay, gusts=ColouredNoise(gusts, 0.3), seed=seed
    )
    return measure(flight.fly(), replace(NOISY, rate=100.0), seed)


def trials(seed: int) -> Iterator[tuple[str, bool, Any]]:
    """Yield name, whether it is excited and what flies it."""
    for delay, lag in LATE:
        name = f"{1e3 * delay:.0f} + {1e3 * lag:.0f} ms"
        for gusts in (0.0, 0.5, 1.0):
            yield (f"light, {name}, wind {gusts:g} m/s", True,
                   partial(light, seed, delay, lag, gusts))  # fmt: skip
        for gusts in (0.3, 1.0):
            closed = gusts > 0.5 or lag > 0.0
            yield (f"plant, {name}, gusts {gusts:g} rad/s^2", True,
                   partial(plant, seed, delay, lag, gusts, closed))  # fmt: skip
    for turbulence in (0, 3, 5):
        for delay in (0.0, 0.06, 0.15):
            yield (f"c172p, {1e3 * delay:.0f} ms, turbulence {turbulence}", True,
                   partial(verdict_flights._fly, "c172p", seed, excitation=((2.0, 1e3),),
                           duration=DURATION, wind=turbulence, delay=delay, bank=20.0))  # fmt: skip
    for gusts in (0.0, 0.1, 0.3, 1.0):
        for delay in (0.012, 0.06):
            yield (f"quadrotor, {1e3 * delay:.0f} + 50 ms, gusts {gusts:g} rad/s^2", True,
                   partial(quadrotor, seed, delay, gusts))  # fmt: skip
    for gusts in (0.3, 1.0):
        yield (f"plant, feedback, gusts {gusts:g}", False,
               partial(plant, seed, 0.06, 0.0, gusts, True, ()))  # fmt: skip
        yield (f"light, feedback, wind {gusts:g}", False,
               partial(light, seed, 0.05, 0.0, gusts, excitation=()))  # fmt: skip
        yield (f"light, stiff feedback, wind {gusts:g}", False,
               partial(light, seed, 0.05, 0.0, gusts, excitation=(), roll_gust=0.5, roll_gain=0.8,
                       yaw_damper=0.3))  # fmt: skip


def told(kind: str, seed: int, delay: float, lag: float, gusts: float) -> Measurements:
    """Fly one that is excited while an autopilot answers the gusts."""
    peaks, band = verdict_flights.PEAKS, (0.2, 2.0)
    if kind == "quadrotor":
        peaks, band = AMPLITUDES, (0.2, 4.0)
    elif kind == "c172p":
        peaks = dict(airframe(kind).excitation)
    peaks = {name: peak for name, peak in peaks.items() if name != "dth"}
    segments = (Segment("multisine", 2.0, EXCITED, peaks, 2.0 / band[0], band, seed=seed),)
    common: dict[str, Any] = {"delay": delay, "seed": seed}
    plan: Plan
    if kind == "quadrotor":
        air = ColouredNoise(gusts, 0.3)
        plan = QuadrotorFlight(
            segments, EXCITED + 2.0, 500.0, time_constant=lag, gusts=air, **common
        )
        sensors = replace(NOISY, rate=100.0)
    elif kind == "light":
        plan = LightFlight(
            segments, EXCITED + 2.0, bank=20.0, gust=gusts, time_constant=lag, **common
        )
        sensors = verdict_flights.SENSORS
    else:
        plan = jsbsim_flight.AircraftFlight(
            segments, EXCITED + 2.0, 200.0, 50.0, aircraft=kind, bank=20.0, turbulence=int(gusts),
            **common,
        )  # fmt: skip
        sensors = verdict_flights.SENSORS
    with verdict_flights.lagging(lag):
        flight = replace(plan.fly(), time_constant=lag)
    return measure(flight, sensors, seed)


def told_trials(seed: int) -> Iterator[tuple[str, bool, Any]]:
    """Yield name, whether it is excited and what flies it, of flights that say what is injected."""
    for gusts, lag in product((0.0, 0.1, 0.2, 0.5, 1.0), (0.03, 0.05, 0.08)):
        name = f"quadrotor, 12 + {1e3 * lag:.0f} ms, gusts {gusts:g} rad/s^2"
        yield name, True, partial(told, "quadrotor", seed, 0.012, lag, gusts)
    for kind, airs in (("light", (0.0, 0.5, 1.0)), ("c172p", (0, 2, 4))):
        for air, delay, lag in product(airs, (0.0, 0.06, 0.1), (0.0, 0.06, 0.12)):
            name = f"{kind}, {1e3 * delay:.0f} + {1e3 * lag:.0f} ms, wind {air:g}"
            yield name, True, partial(told, kind, seed, delay, lag, air)


def quiet_trials(seed: int) -> Iterator[tuple[str, Any]]:
    """Yield name and what flies it, of flights with a long quiet part."""
    spans: dict[str, Any] = {
        "excitation": ((2.0, EXCITED), (QUIET_UNTIL, LONG)), "duration": LONG,
    }  # fmt: skip
    for (delay, lag), gusts in product(((0.0, 0.0), (0.06, 0.0), (0.08, 0.06)), (0.3, 1.0)):
        name = f"{1e3 * delay:.0f} + {1e3 * lag:.0f} ms"
        yield (f"plant, {name}, gusts {gusts:g} rad/s^2",
               partial(plant, seed, delay, lag, gusts, True, **spans))  # fmt: skip
        yield (f"light, {name}, wind {gusts:g} m/s",
               partial(light, seed, delay, lag, gusts, **spans))  # fmt: skip
    for turbulence, delay in product((2, 4), (0.0, 0.06)):
        yield (f"c172p, {1e3 * delay:.0f} ms, turbulence {turbulence}",
               partial(verdict_flights._fly, "c172p", seed, wind=turbulence, delay=delay,
                       bank=20.0, **spans))  # fmt: skip


class Held(NamedTuple):
    """Delay in use over one flight with a long quiet part, s."""

    name: str
    true: float  # Delay and lag
    first: float  # When the quiet begins
    moved: float  # How far it went from there at most
    end: float


def held(trial: tuple[str, Any]) -> Held:
    """Fly one as the node would, told neither delay nor lag."""
    name, fly_it = trial
    m = fly_it()
    case = cases.measured(m, name, None)
    structure = "augmented" if name.startswith("plant") else "flight_dynamics"
    track = cases.identify(case, verdict_flights.UNTOLD | {"structure": structure})
    # Half a block later all that was excited is judged.
    begun = track.at(EXCITED + 0.5 * HORIZONS[-1])
    after = track.delay[begun:]
    moved = float(np.abs(after - after[0]).max())
    true = m.flight.delay + m.flight.time_constant
    return Held(name, true, float(after[0]), moved, float(after[-1]))


def held_line(h: Held) -> str:
    """One flight in a line."""
    return (
        f"{h.name:<36} true {1e3 * h.true:4.0f}  when the quiet begins {1e3 * h.first:4.0f}, "
        f"moved by {1e3 * h.moved:3.0f}, at the end {1e3 * h.end:4.0f} ms"
    )


def judged(trial: tuple[str, bool, Any], is_told: bool) -> Result:
    """Fly one, and let the bank see it as the identifier's sampler cuts it."""
    name, excited, fly_it = trial
    m = fly_it()
    given = m.flight.injected if is_told else None
    true = m.flight.delay + m.flight.time_constant
    structure = STRUCTURES["flight_dynamics"]
    speed = 20.0 if m.flight.airspeed is None else float(np.mean(m.flight.airspeed))
    unset = verdict_flights.UNTOLD | {"airspeed.reference": speed}
    case = cases.measured(m, name, None)
    bank, observer = DelayBank(0.3), FlowObserver(structure, 15.0, speed)
    worst = 0.0
    for block in case.blocks(case.settings(unset), given):
        block.flow = observer.follow(block, first_values(structure), None)
        for k in range(0, len(block.u), PIECE):
            if bank.add(cut(block, k, name), 0.0) and bank.estimate.total_sure:
                off = abs(bank.estimate.total - true) / bank.estimate.total_sigma
                worst = max(worst, off)
    return Result(name, excited, true, m.flight.time_constant, bank.estimate, worst)


def cut(block: Block, k: int, name: str) -> Block:
    """Cut a piece of `PIECE` cells; others than aircraft have no flow."""
    cells, edges = slice(k, k + PIECE), slice(k, k + PIECE + 1)
    whole, flow = block.flow, None
    if whole is not None and not name.startswith(("plant", "quadrotor")):
        flow = FlowSignals(whole.states[edges], whole.airspeed)
    return replace(
        block, t_ns=block.t_ns[edges], x=block.x[edges], u=block.u[cells], flow=flow,
        excitation=None if block.excitation is None else block.excitation[cells],
        specific_force=block.specific_force[edges], restarted=block.restarted and k == 0,
    )  # fmt: skip


def line(r: Result) -> str:
    """One flight in a line."""
    e = r.estimate
    word = "sure" if e.total_sure else "delay" if e.sure else "not known"
    lag = f"  lag {1e3 * r.lag:3.0f}: {1e3 * e.lag:3.0f} +- {1e3 * e.lag_sigma:2.0f}"
    lag = lag if e.lag_sure else ""
    return (
        f"{r.name:<36} true {1e3 * r.true:4.0f}  found {1e3 * e.total:4.0f} +- "
        f"{1e3 * e.total_sigma:3.0f} ms  {word:<10} worst {r.worst:.1f} sigma{lag}"
    )


def summary(results: Sequence[Result]) -> Iterator[str]:
    """Yield the figures of record."""
    for excited in (True, False):
        of = [r for r in results if r.excited == excited]
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
    """Free 1-s fits of a recorded flight with fixed delays, and with the delay estimated."""
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
    """Print what was found."""
    parser = bench.parser(__doc__, seeds=2, workers=2)
    parser.add_argument("--told", action="store_true", help="flights that say what is injected")
    parser.add_argument("--quiet", action="store_true", help="flights with long quiet parts")
    parser.add_argument("--sweep", action="store_true", help="recorded flights instead")
    options = parser.parse_args()
    if options.sweep:
        flights = filter(cases.is_recorded, cases.RECORDED_DELAY)
        bench.done(sweep, flights, options.workers)
        return
    if options.quiet:
        quiet = [trial for seed in range(1, options.seeds + 1) for trial in quiet_trials(seed)]
        flown = bench.done(held, quiet, options.workers, held_line)
        moved = sum(h.moved > SURE_SIGMA for h in flown)
        print(f"moved by more than {1e3 * SURE_SIGMA:g} ms: {moved} of {len(flown)}")
        return
    chosen = told_trials if options.told else trials
    todo = [trial for seed in range(1, options.seeds + 1) for trial in chosen(seed)]
    look = partial(judged, is_told=options.told)
    print(*summary(bench.done(look, todo, options.workers, line)), sep="\n")


if __name__ == "__main__":
    main()
