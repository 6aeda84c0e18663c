# SPDX-License-Identifier: Apache-2.0
"""Flights that test the verdict usable, by classes, with their true derivatives."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import cases
import numpy as np
import random_flights
from imperfections import IMPERFECTIONS, keep, multiply, slow
from light_aircraft import LightFlight
from numpy.typing import ArrayLike

from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.structure import INPUTS, ROWS, FloatArray, Structure
from uav_ident_ros.messages.types import FLU_TO_FRD
from uav_ident_ros.simulation.airframe import airframe
from uav_ident_ros.simulation.faults import SURFACE_NAMES, Fault
from uav_ident_ros.simulation.flight import CoefficientChange, Flight
from uav_ident_ros.simulation.inputs import ColouredNoise, Segment
from uav_ident_ros.simulation.jsbsim_flight import AircraftFlight
from uav_ident_ros.simulation.live import Plan
from uav_ident_ros.simulation.noise import Measurements, Sensors, measure
from uav_ident_ros.simulation.plant import PlantFlight
from uav_ident_ros.simulation.quadrotor_flight import AMPLITUDES, QuadrotorFlight
from uav_ident_ros.simulation.quadrotor_flight import NAME as QUADROTOR

EXCITED, CHANGED = 60.0, 75.0
"""End of the excitation in the flights of ``old_knowledge``, and time of the failure, s."""

FAILED = 50.0
"""Time of the (first) failure in ``jammed``, ``slowing``, ``fading`` and ``intermittent``, s."""

COMMAND_RATE = 50.0
"""Rate of the commands, Hz."""

FADING_TIME, LEFT = 40.0, 0.3
"""Time in which a surface of ``fading`` loses its effect, s, and the effect that is left."""

FLICKER_TIME, FLICKER = 3.0, 0.4
"""Time between the changes of a surface in ``intermittent``, s, and its lower effect."""

PEAK_TIME = 0.3
"""Time that a servo of ``slowing`` then needs for the peak of the excitation, s."""

GLITCH_TIME, GLITCH = 75.0, 34.9
"""Time of a wrong gyro sample, s, and its value, rad/s: 2000 deg/s."""

RETRIM, RETRIM_TIME = 0.1, 2.0
"""Change of a trim in flight, rad, and the time that it takes, s."""

CLIP = 0.4
"""Limit of a clipped record, relative to the largest command."""

WINDY: Mapping[str, float] = {"light_aircraft": 0.3, "c172p": 3, "T37": 3}
"""Aircraft of the classes that differ in the Imu or the trim alone, and their wind as in `fly`."""

IMPERFECT_AIRCRAFT = (
    ("light_aircraft", 0.3), ("ultra_stick_25e", 1), ("c172p", 3), ("T37", 3), ("J3Cub", 1),
)  # fmt: skip
"""Aircraft of the class ``imperfect``, which take turns, and their wind."""

FAILING = (
    ("light_aircraft", 0.3), ("c172p", 2), ("T37", 2), ("J3Cub", 1), ("ultra_stick_25e", 1),
)  # fmt: skip
"""Aircraft of ``slowing``, ``fading`` and ``intermittent``, and their wind; the last two also have
an OV10."""

LONG, SHORT = 1.0, 0.8
"""Relative length of the flights; `SHORT` still includes the failure and the glitch."""

PEAKS: Mapping[str, Mapping[str, float]] = {
    "light_aircraft": {"de": 0.06, "dr": 0.08, "da": 0.06, "dth": 0.1},
    "small_uav": {"de": 0.08, "dr": 0.12, "da": 0.06, "dth": 0.2},
    QUADROTOR: AMPLITUDES,
}
"""Peak excitation, rad and throttle; that of JSBSim's aircraft is in their files."""

RANDOM_FLIGHTS = 40
"""Number of flights of aircraft drawn at random, for each seed."""

AIRFRAMES = Path(__file__).parent / "airframes"
"""Folder of the aircraft of the benchmarks."""

DELAY = 0.02
"""Configured delay of the actuators, s."""

UNTOLD = {
    "actuators.delay": 0.0, "actuators.time_constant": 0.0, "actuators.estimate_delay": True,
}  # fmt: skip
"""Settings without delay and lag, which are estimated in flight."""

SENSORS = Sensors(rate=100.0, gyro_noise=0.01, accelerometer_noise=0.15, stamped=True)
WEAK = Sensors(rate=25.0, gyro_noise=0.03, accelerometer_noise=0.6, stamped=True)


@dataclass(frozen=True, eq=False)
class Trial:
    """One flight and the settings of its identifier."""

    kind: str  # Its class
    name: str  # Its description
    seed: int  # Seed of wind and noise
    # Returns the measurements, or a recorded flight without truth; called in the process of the
    # trial
    fly: Callable[[], Measurements | cases.Case]
    # Settings besides those for the topics
    settings: Mapping[str, Any] = field(default_factory=dict)
    # Factor on the true moments of the healthy aircraft for a warm start; zero for a cold one
    warm: float = 0.0
    feedback: bool = False  # Without excitation: coverage is counted apart
    replayed: bool = False  # Whether the flight is written as a bag and replayed
    published: bool = False  # Whether the injected signal is on the topic `excitation`
    names: str = ""  # Regular expression of the reason that must be reported; for mistakes only


def truth(flight: Flight, time: float) -> dict[str, float]:
    """Return the true derivatives at `time`, s, with all changes up to then."""
    out = dict(flight.local_truth)
    for change in flight.changes:
        if change.time <= time:
            for name in out:
                row, _, column = name.partition("/")
                out[name] *= change.factors.get(column, 1.0) * change.factors.get(row, 1.0)
    return out


def coefficients(structure: Structure, true: Mapping[str, float]) -> FloatArray:
    """Return the true derivatives as coefficients of a structure, shape of its mask.

    With the forces as regressors in place of the flow angles, the moment through a surface's force
    belongs to the force's coefficient.
    """
    out = np.zeros(structure.mask.shape)
    for name, value in true.items():
        if name in structure.names:
            out[structure.index(name)] = value
    if "az/1" in structure.names:
        out[structure.index("az/1")] = -GRAVITY
    for force, angle in (("ay", "beta"), ("az", "alpha")):
        for row in ("pdot", "qdot", "rdot"):
            if f"{row}/{force}" not in structure.names or f"{row}/{angle}" not in true:
                continue
            share = true[f"{row}/{angle}"] / true[f"{force}/{angle}"]
            out[structure.index(f"{row}/{force}")] = share
            if force == "az":  # in trim az carries the weight, and the moments are zero
                out[structure.index(f"{row}/1")] = share * GRAVITY
            for surface in ("de", "dr", "da"):
                name = f"{row}/{surface}"
                if name in structure.names:
                    out[structure.index(name)] -= share * true.get(f"{force}/{surface}", 0.0)
    return out


def warm_start(
    structure: Structure, true: Mapping[str, float], factor: float = 1.0
) -> CoefficientSet:
    """Return the set saved after a good flight of the healthy aircraft, moments times a factor."""
    values = coefficients(structure, true)
    values[: len(ROWS)] *= factor
    sigma = np.where(structure.mask, 0.05 * np.abs(values) + 0.02, 0.0)
    return CoefficientSet(structure.name, values, sigma)


Spoil = Callable[[Measurements], Measurements]


def _as_it_is(measured: Measurements) -> Measurements:
    return measured


def fly(
    aircraft: str,  # ``light_aircraft``, ``small_uav``, ``quadrotor`` in hover, or one of JSBSim
    seed: int,
    *,
    excitation: Sequence[tuple[float, float]] = ((2.0, 1e3),),  # All the time by default
    inputs: str = "multisine",
    band: tuple[float, float] = (0.1, 2.0),  # Of the multisines, Hz
    period: float | None = None,  # Of the multisines, s: two of their lowest frequency by default
    surfaces: Sequence[str] = INPUTS,  # The excited inputs
    peaks: Mapping[str, float] | None = None,  # Of the excitation, if not the aircraft's own
    scale: float = 1.0,
    duration: float = 120.0,
    # m/s rms; for JSBSim's aircraft the severity 0 to 7, for plant and quadrotor gusts, rad/s^2
    wind: float = 0.0,
    changes: tuple[CoefficientChange, ...] = (),
    jams: bool = False,  # Whether JSBSim's surfaces stay where they are in place of the changes
    slowing: Sequence[str] = (),  # Surfaces whose servos become slow
    delay: float = DELAY,
    time_constant: float = 0.0,
    sensors: Sensors = SENSORS,
    spoil: Spoil = _as_it_is,
    **own: Any,  # Fields of the aircraft's plan
) -> Measurements:
    """Fly an aircraft, all but the plant on an autopilot; return the measurements."""
    peaks = peaks or PEAKS.get(aircraft) or airframe(aircraft).excitation
    peaks = {name: scale * peak for name, peak in peaks.items() if name in surfaces}
    segments = [
        Segment(inputs, start, until - start, peaks, period or 2.0 / band[0], band, seed=seed)
        for start, until in excitation
    ]
    if slowing:
        own["actuators"] = Slowing(min(peaks[name] for name in slowing) / PEAK_TIME, slowing)
    own |= {"delay": delay, "time_constant": time_constant, "seed": seed}
    gusts = ColouredNoise(wind, 0.3)
    if aircraft == "light_aircraft":
        plan: Plan = LightFlight(segments, duration, gust=wind, changes=changes, **own)
    elif aircraft == "small_uav":
        plan = PlantFlight(segments, duration, 200.0, gusts=gusts, max_step=2.5e-3, **own)
    elif aircraft == QUADROTOR:
        plan = QuadrotorFlight(segments, duration, 500.0, gusts=gusts, **own)
    else:
        faults, effect = [], dict.fromkeys(INPUTS, 1.0)
        for change in changes:
            for name, factor in change.factors.items():
                effect[name] *= factor
                what, left = SURFACE_NAMES[INPUTS.index(name)], None if jams else effect[name]
                faults.append(Fault("jams" if jams else "effect", what, left, change.time))
        plan = AircraftFlight(
            segments, duration, 200.0, COMMAND_RATE, aircraft=aircraft, turbulence=int(wind),
            faults=faults, **own,
        )  # fmt: skip
    return spoil(measure(replace(plan.fly(), changes=changes), sensors, seed))


@dataclass(frozen=True)
class Series:
    """The trials of one class with one seed."""

    kind: str
    seed: int
    length: float  # Of the flights, relative

    def trial(self, aircraft: str, label: str, duration: float = 110.0, **values: Any) -> Trial:
        """Return a trial; `values` are fields of `Trial` and arguments of `fly`."""
        own = {name: values.pop(name) for name in OPTIONAL if name in values}
        flight = partial(fly, aircraft, self.seed, duration=self.length * duration, **values)
        return Trial(self.kind, f"{Path(aircraft).stem}, {label}", self.seed, flight, **own)


OPTIONAL = ("settings", "warm", "feedback", "replayed", "published", "names")
"""Optional fields of `Trial`."""


def _feedback(series: Series) -> Iterator[Trial]:
    """Bank commands, yaw damper and gusts, without excitation."""
    for aircraft, bank, wind, more in (
        ("light_aircraft", 30.0, 0.3, {}),
        ("light_aircraft", 30.0, 0.8, {}),
        ("light_aircraft", 15.0, 1.5, {}),
        # a span of 2 m, and a stiff autopilot with a strong response to gusts
        ("light_aircraft", 15.0, 0.5, {"roll_gust": 0.8, "roll_gain": 0.5, "yaw_damper": 0.5}),
        ("light_aircraft", 30.0, 1.0, {"roll_gust": 0.5, "roll_gain": 0.8, "yaw_damper": 0.3}),
        ("c172p", 30.0, 5, {}),
        ("T37", 30.0, 3, {}),
        ("OV10", 30.0, 3, {}),
        ("ultra_stick_25e", 20.0, 2, {}),
    ):
        label = f"wind {wind:g}" + "".join(f", {k} {v:g}" for k, v in more.items())
        yield series.trial(
            aircraft, label, 150.0, excitation=(), bank=bank, wind=wind, feedback=True,
            replayed=aircraft == "c172p", **more,
        )  # fmt: skip


def _old_knowledge(series: Series) -> Iterator[Trial]:
    """Excitation, then bank commands alone: a surface fails, or was reversed on the ground."""
    for aircraft, wind in (("light_aircraft", 0.5), ("c172p", 3)):
        for surface, factor in (("dr", -1.0), ("dr", 0.0), ("dr", 0.33), ("de", 0.33),
                                ("da", 0.33)):  # fmt: skip
            yield series.trial(
                aircraft, f"{surface} x {factor:g} after the excitation", 150.0, bank=20.0,
                wind=wind, changes=(CoefficientChange(CHANGED, {surface: factor}),),
                excitation=((2.0, EXCITED),),
            )  # fmt: skip
        yield series.trial(
            aircraft, "warm start, rudder reversed on the ground", 150.0, bank=20.0, wind=wind,
            changes=(CoefficientChange(0.0, {"dr": -1.0}),), excitation=(), warm=1.0,
            feedback=True,
        )  # fmt: skip


def _changed(series: Series) -> Iterator[Trial]:
    """Continuous excitation; a surface fails and must be relearned."""
    for aircraft, wind in (("light_aircraft", 0.3), ("c172p", 2), ("T37", 0),
                           ("ultra_stick_25e", 1)):  # fmt: skip
        for surface, factor in (("dr", -1.0), ("dr", 0.5), ("de", 0.5), ("da", 0.5)):
            changes = (CoefficientChange(series.length * CHANGED, {surface: factor}),)
            label = f"{surface} x {factor:g}"
            yield series.trial(aircraft, label, wind=wind, scale=0.5, changes=changes)


def _jammed(series: Series) -> Iterator[Trial]:
    """Excitation, then an autopilot alone: a surface jams, and its command stays near its place."""
    for aircraft, (surface, bank) in product(
        ("c172p", "T37", "OV10", "J3Cub"), (("de", 20.0), ("da", 0.0))
    ):
        yield series.trial(
            aircraft, f"{surface} jams", bank=bank, wind=2, jams=True,
            changes=(CoefficientChange(FAILED, {surface: 0.0}),), excitation=((2.0, 40.0),),
        )  # fmt: skip


class Slowing:
    """Servos of some surfaces that turn at a limited speed, rad/s, from `FAILED` on."""

    def __init__(self, speed: float, surfaces: Sequence[str]) -> None:
        self._reach, self._count = speed / COMMAND_RATE, 0
        self._slow = np.isin(INPUTS, surfaces)

    def __call__(self, before: FloatArray, commanded: FloatArray) -> FloatArray:
        """Return the deflections after a command."""
        self._count += 1
        if self._count < FAILED * COMMAND_RATE:
            return commanded
        return np.where(self._slow, slow(self._reach, before, commanded), commanded)


def _slowing(series: Series) -> Iterator[Trial]:
    """Excitation, in which the servos of all surfaces or of one become slow."""
    for (aircraft, wind), surfaces in product(FAILING, (("de", "dr", "da"), ("de",), ("da",))):
        label = f"servos of {', '.join(surfaces)} become slow"
        yield series.trial(aircraft, label, bank=20.0, wind=wind, slowing=surfaces)


def _fading(series: Series) -> Iterator[Trial]:
    """Excitation, in which a surface slowly loses its effect, as by ice."""
    for (aircraft, wind), surface in product((*FAILING, ("OV10", 2)), ("de", "dr", "da")):
        keep = {surface: LEFT ** (1.0 / FADING_TIME)}
        changes = tuple(CoefficientChange(FAILED + k, keep) for k in range(round(FADING_TIME)))
        label = f"{surface} fades to {LEFT:g}"
        yield series.trial(aircraft, label, 130.0, bank=20.0, wind=wind, changes=changes)


def _intermittent(series: Series) -> Iterator[Trial]:
    """Excitation, in which most of a surface's effect comes and goes, as by a loose linkage."""
    for (aircraft, wind), surface in product((*FAILING, ("OV10", 2)), ("de", "da")):
        times = np.arange(FAILED, 130.0, FLICKER_TIME).tolist()
        changes = tuple(
            CoefficientChange(t, {surface: 1.0 / FLICKER if k % 2 else FLICKER})
            for k, t in enumerate(times)
        )
        label = f"{surface} x {FLICKER:g} and 1 in turn"
        yield series.trial(aircraft, label, 130.0, bank=20.0, wind=wind, changes=changes)


def _thinned(measured: Measurements) -> Measurements:
    """Keep the commands of every tenth of a second."""
    step = round(0.1 / (np.median(np.diff(measured.actuator_t_ns)) * 1e-9))
    return keep(slice(None, None, step), "actuator", measured)


def _clipped(measured: Measurements) -> Measurements:
    """Clip each recorded channel at `CLIP` of its largest deviation from trim."""
    trim = measured.flight.channel_trim
    away = measured.actuators - trim
    limit = CLIP * np.abs(away).max(axis=0)
    return replace(measured, actuators=trim + np.clip(away, -limit, limit))


def _unmodelled(series: Series) -> Iterator[Trial]:
    """Excitation, with servos or a mounting that the settings do not contain."""
    light, late = {"bank": 20.0, "wind": 0.5}, DELAY + 0.15
    servos: list[dict[str, Any]] = [
        {"servo_speed": speed, "inputs": inputs, "wind": 0.3}
        for speed, inputs in product((0.3, 0.5), ("multisine", "doublet", "3211"))
    ]
    for aircraft, label, settings, flight in (
        ("light_aircraft", "servo lag 120 ms", {"actuators.time_constant": 0.0},
         {**light, "time_constant": 0.12}),
        ("light_aircraft", "delay 150 ms longer than told", {"actuators.delay": DELAY},
         {**light, "delay": late}),
        ("light_aircraft", "commands saturate", {}, {**light, "travel": 0.04, "scale": 2.5}),
        *(("light_aircraft", "servos of {servo_speed:g} rad/s, {inputs}".format(**servo), {}, servo)
          for servo in servos),
        ("c172p", "delay 150 ms longer than told", {"actuators.delay": DELAY}, {"delay": late}),
        *((aircraft, label, settings, flight) for aircraft in ("light_aircraft", "c172p", "T37")
          for label, settings, flight in (
              ("lag of 100 ms told, none there", {"actuators.time_constant": 0.1}, {}),
              ("lag of 50 ms told, none there, delay sought",
               {**UNTOLD, "actuators.time_constant": 0.05}, {}),
              ("delay 60 ms shorter than told", {"actuators.delay": DELAY + 0.06}, {}),
              ("commands recorded at 10 Hz", {}, {"spoil": _thinned}),
              ("commands clipped in the record", {}, {"spoil": _clipped}),
              ("Imu 15 cm above the centre of gravity", {"imu.lever_arm": [0.0, 0.0, 0.0]},
               {"sensors": replace(SENSORS, lever_arm=(0.0, 0.0, -0.15))}),
              ("Imu 15 cm below the centre of gravity", {"imu.lever_arm": [0.0, 0.0, 0.0]},
               {"sensors": replace(SENSORS, lever_arm=(0.0, 0.0, 0.15))}))),
    ):  # fmt: skip
        yield series.trial(aircraft, label, settings=settings, **flight)


def _untold(series: Series) -> Iterator[Trial]:
    """Excitation, with unconfigured delay and lag, which are estimated in flight."""
    late = ((0.0, 0.0), (0.05, 0.0), (0.0, 0.06), (0.05, 0.12))
    for aircraft, wind in (("light_aircraft", 0.5), ("c172p", 2), ("T37", 2), ("A4", 2),
                           ("ultra_stick_25e", 2)):  # fmt: skip
        for (delay, lag), rough in product(late, (False, True)):
            yield series.trial(
                aircraft,
                f"{1e3 * delay:.0f} + {1e3 * lag:.0f} ms, {'wind' if rough else 'calm'}",
                bank=20.0, wind=rough * wind, delay=delay, time_constant=lag, settings=UNTOLD,
            )  # fmt: skip


def _biased(series: Series) -> Iterator[Trial]:
    """Excitation, with a constant error of the gyro."""
    for aircraft, wind in WINDY.items():
        for size in (0.05, 0.1):
            sensors = replace(SENSORS, gyro_bias=(size, -size, 0.7 * size))
            label = f"gyro bias {size:g} rad/s"
            yield series.trial(aircraft, label, bank=20.0, wind=wind, sensors=sensors)


def imperfect(series: Series, aircraft: str, wind: float, label: str, **more: Any) -> Trial:
    """Return the trial of an aircraft with one of `IMPERFECTIONS`."""
    values = dict(IMPERFECTIONS[label])
    values["sensors"] = replace(SENSORS, **values.get("sensors", {}))
    if "spoil" in values:
        values["spoil"] = partial(values["spoil"], np.random.default_rng([series.seed, 13]))
    return series.trial(aircraft, label, bank=20.0, wind=wind, **values, **more)


def _imperfect(series: Series) -> Iterator[Trial]:
    """Excitation, with sensors, links and actuators as they are; each on one aircraft a seed."""
    for k, label in enumerate(IMPERFECTIONS):
        aircraft, wind = IMPERFECT_AIRCRAFT[(k + series.seed) % len(IMPERFECT_AIRCRAFT)]
        yield imperfect(series, aircraft, wind, label)


def _weak(series: Series) -> Iterator[Trial]:
    """Noisy sensors at 25 Hz, little excitation."""
    for aircraft, wind, scale in (
        ("light_aircraft", 0.5, 0.3), ("light_aircraft", 0.5, 1.0), ("c172p", 3, 0.3),
    ):  # fmt: skip
        label = f"25 Hz, excitation x {scale:g}"
        yield series.trial(aircraft, label, scale=scale, bank=20.0, wind=wind, sensors=WEAK)


def _glitched(measured: Measurements) -> Measurements:
    rates = measured.rates.copy()
    rates[
        np.searchsorted(measured.imu_t_ns, measured.imu_t_ns[0] + round(GLITCH_TIME * 1e9)), 0
    ] = GLITCH
    return replace(measured, rates=rates)


def _glitch(series: Series) -> Iterator[Trial]:
    """One gyro sample of 2000 deg/s in an excited flight."""
    for aircraft, bank, wind in (("light_aircraft", 20.0, 0.3), ("c172p", 0.0, 0)):
        label = f"bank {bank:g}, wind {wind:g}"
        yield series.trial(aircraft, label, bank=bank, wind=wind, spoil=_glitched)


def _clean(series: Series) -> Iterator[Trial]:
    """Excitation, with correct settings and without faults."""
    for aircraft, bank, wind in (
        ("light_aircraft", 0.0, 0.0), ("light_aircraft", 20.0, 0.3), ("light_aircraft", 20.0, 0.8),
        ("c172p", 0.0, 0), ("c172p", 20.0, 3), ("T37", 0.0, 0), ("OV10", 0.0, 0),
        ("ultra_stick_25e", 0.0, 0), ("ultra_stick_25e", 20.0, 2),
    ):  # fmt: skip
        label, replayed = f"bank {bank:g}, wind {wind:g}", aircraft == "OV10"
        yield series.trial(aircraft, label, bank=bank, wind=wind, replayed=replayed)


def _published(series: Series) -> Iterator[Trial]:
    """Excitation on the topic, with delay and lag configured correctly or not, or saturation."""
    rotors: Mapping[str, Any] = {"duration": 80.0, "wind": 0.5, "time_constant": 0.05}
    for aircraft, flight in (
        ("light_aircraft", {"bank": 20.0, "wind": 0.8}), ("c172p", {"bank": 20.0, "wind": 3}),
        ("ultra_stick_25e", {"bank": 20.0, "wind": 2}), (QUADROTOR, rotors),
    ):  # fmt: skip
        lag = flight.get("time_constant", 0.0)
        for name, true, wrong in (
            ("time_constant", lag, lag), ("time_constant", lag, lag + 0.07),
            ("delay", DELAY, DELAY + 0.06),
        ):  # fmt: skip
            label = f"{name} {1e3 * wrong:g} ms, true {1e3 * true:g}"
            settings = {f"actuators.{name}": wrong}
            yield series.trial(aircraft, label, settings=settings, published=True, **flight)
    yield series.trial(
        "light_aircraft", "commands saturate", bank=20.0, wind=0.5, travel=0.04, scale=2.5,
        published=True,
    )  # fmt: skip


def _in_turn(series: Series) -> Iterator[Trial]:
    """Excitation by 3-2-1-1 or doublets, one surface after the other."""
    for inputs, (aircraft, bank, wind) in product(("3211", "doublet"), (
        ("light_aircraft", 0.0, 0.3), ("c172p", 0.0, 0), ("c172p", 20.0, 3), ("T37", 0.0, 0),
        ("OV10", 0.0, 0), ("ultra_stick_25e", 0.0, 0),
    )):  # fmt: skip
        label, replayed = f"bank {bank:g}, wind {wind:g}, {inputs}", aircraft == "OV10"
        yield series.trial(aircraft, label, bank=bank, wind=wind, inputs=inputs, replayed=replayed)


def _partly(series: Series) -> Iterator[Trial]:
    """Excitation of one surface; the others move by the autopilot alone."""
    for (aircraft, bank, wind), surface in product((
        ("light_aircraft", 0.0, 0.0), ("light_aircraft", 20.0, 0.3), ("c172p", 0.0, 0),
        ("T37", 20.0, 2), ("A4", 0.0, 0), ("ultra_stick_25e", 20.0, 1),
    ), ("de", "dr", "da")):  # fmt: skip
        label = f"bank {bank:g}, wind {wind:g}, {surface} alone"
        yield series.trial(aircraft, label, bank=bank, wind=wind, surfaces=(surface,))


def _unseen(series: Series) -> Iterator[Trial]:
    """Aircraft that did not serve for tuning: with excitation, and on the autopilot alone."""
    for file in sorted(map(str, AIRFRAMES.glob("*.yaml"))):
        for bank, wind in ((0.0, 0), (20.0, 4)):
            yield series.trial(file, f"bank {bank:g}, wind {wind:g}", bank=bank, wind=wind)
        yield series.trial(
            file, "not excited", 150.0, excitation=(), bank=30.0, wind=4, feedback=True
        )


def _swaying(series: Series) -> Iterator[Trial]:
    """Excitation that makes large Dutch rolls: the nose sways, and the path hardly turns."""
    for aircraft, scale in (("t6texan2", 1.5), ("t6texan2", 2.0), ("c172r", 2.0)):
        file = str(AIRFRAMES / f"{aircraft}.yaml")
        yield series.trial(file, f"excitation x {scale:g}", scale=scale)
    yield series.trial("OV10", "excitation x 2", scale=2.0)


def _random(series: Series) -> Iterator[Trial]:
    """Aircraft, sensors, settings, excitation and failures drawn at random."""
    for k in range(series.seed * RANDOM_FLIGHTS, (series.seed + 1) * RANDOM_FLIGHTS):
        drawn = random_flights.draw(k)
        flight = partial(random_flights.fly, k)
        yield Trial("random", drawn.label, k, flight, drawn.settings, feedback=not drawn.excited)


def _closed_loop(series: Series) -> Iterator[Trial]:
    """Correct initial coefficients, excitation of every surface for ten seconds, then none."""
    for aircraft, wind, noise in (
        ("c172p", 3, 0.01), ("c172p", 3, 0.03), ("light_aircraft", 0.3, 0.03),
    ):  # fmt: skip
        yield series.trial(
            aircraft, f"gyro noise {noise:g}", excitation=((2.0, 12.0),), bank=20.0, wind=wind,
            sensors=replace(SENSORS, gyro_noise=noise), warm=1.0, feedback=True,
        )  # fmt: skip


def _told_wrong(series: Series) -> Iterator[Trial]:
    """Excitation, with the initial coefficients of another aircraft."""
    for factor in (0.4, 1.7):
        for aircraft, wind in (("light_aircraft", 0.3), ("c172p", 3)):
            label = f"told x {factor:g}"
            yield series.trial(aircraft, label, 120.0, bank=20.0, wind=wind, warm=factor)


def _warm(series: Series) -> Iterator[Trial]:
    """Excitation from correct coefficients; the surfaces, or their record, leave the commands."""
    for wind, travel, scale in ((0.3, 0.06, 2.5), (1.0, 0.06, 2.5), (0.3, 0.04, 1.0),
                                (1.0, 0.04, 2.5)):  # fmt: skip
        label = f"wind {wind:g}, travel {travel:g} rad, excitation x {scale:g}"
        yield series.trial(
            "light_aircraft", label, bank=20.0, wind=wind, travel=travel, scale=scale, warm=1.0
        )
    for aircraft, wind in (("c172p", 3), ("T37", 2), ("ultra_stick_25e", 2)):
        label = "commands clipped in the record"
        yield series.trial(aircraft, label, bank=20.0, wind=wind, spoil=_clipped, warm=1.0)
    for aircraft, wind, label in (
        ("J3Cub", 1, "backlash of 2 deg"), ("OV10", 3, "dead band of 0.7 deg"),
    ):  # fmt: skip
        yield imperfect(series, aircraft, wind, label, warm=1.0)


def _mounted(matrix: ArrayLike) -> Spoil:
    return partial(multiply, matrix, matrix)


def _ordered(order: Sequence[int], measured: Measurements) -> Measurements:
    """Change the order of the channels."""
    return replace(measured, actuators=measured.actuators[:, order])


def _two_publishers(measured: Measurements) -> Measurements:
    """Add a second publisher, of trim at the same rate."""
    half = np.diff(measured.actuator_t_ns)[0] // 2
    both = np.repeat(measured.actuators, 2, axis=0)
    both[1::2] = measured.flight.channel_trim
    t_ns = np.repeat(measured.actuator_t_ns, 2)
    t_ns[1::2] += half
    return replace(measured, actuators=both, actuator_t_ns=t_ns, actuator_log_ns=t_ns)


def _weightless(measured: Measurements) -> Measurements:
    """Remove the mean, nearly gravity, from the specific force."""
    force = measured.specific_force
    return replace(measured, specific_force=force - force.mean(axis=0))


def _pulses(measured: Measurements) -> Measurements:
    return replace(measured, actuators=1500.0 + 500.0 * measured.actuators)


MISTAKES: Sequence[tuple[str, Spoil, dict[str, Any], str]] = (
    ("imu.convention frd for flu", _as_it_is, {"imu.convention": "frd"}, "'flu' would"),
    ("board upside down", _mounted(np.diag([1.0, -1.0, -1.0])), {}, "3.14, 0.00, yaw"),
    ("board pitched by 90 deg", _mounted([[0, 0, -1], [0, 1, 0], [1, 0, 0]]), {}, "1.57"),
    ("gyro in deg/s", partial(multiply, 57.3 * np.eye(3), np.eye(3)), {}, "to rad/s"),
    ("accelerometer in g", partial(multiply, np.eye(3), np.eye(3) / GRAVITY), {}, "looks like g"),
    ("gravity taken out of the force", _weightless, {}, "taken out"),
    ("rudder and aileron swapped", partial(_ordered, [0, 2, 1, 3]), {}, "swapped"),
    ("elevator and aileron swapped", partial(_ordered, [2, 1, 0, 3]), {}, "swapped"),
    ("elevator and rudder swapped", partial(_ordered, [1, 0, 2, 3]), {}, "swapped"),
    ("two publishers", _two_publishers, {}, "two publishers"),
    ("trim in degrees", _as_it_is, {"actuators.trim": [2.0, -1.0, 1.5, 0.5]}, "in degrees"),
    ("pulse widths without trim", _pulses, {"actuators.trim": []}, "microseconds"),
    ("aileron reversed", _as_it_is, {"actuators.mixing.da": [0.0, 0.0, -1.0, 0.0],
     "supervision.expected_signs": ["+pdot/da", "-qdot/de", "-rdot/dr"]}, "wrong way round"),
)  # fmt: skip
"""Mistakes in the reading of the signals: name, change of the measurements, settings, and reason
that must be reported."""


CARRIED_TURN, CARRIED_SWAY = 0.2, 1.0
"""Rotation, rad, and shaking, m/s^2, of a carried aircraft."""

CARRIED_BAND = (0.15, 0.9)
"""Frequency band of these, Hz, as in walking."""


def carried(seconds: float, seed: int, measured: Measurements) -> Measurements:
    """Precede the flight by a carried, stabilised aircraft: surfaces move without effect."""
    rng, imu = np.random.default_rng([seed, 11]), measured.sensors
    every = [np.diff(t)[0] for t in (measured.imu_t_ns, measured.actuator_t_ns)]
    times = [np.arange(round(seconds * 1e9 / step)) * step * 1e-9 for step in every]
    omega = 2.0 * np.pi * rng.uniform(*CARRIED_BAND, (4, 1, 6))
    phase = rng.uniform(0.0, 2.0 * np.pi, omega.shape)
    size = np.array([CARRIED_TURN] * 3 + [CARRIED_SWAY] * 3) / np.sqrt(2.0)
    turned = [size * np.sin(omega * t[:, None] + phase).sum(axis=0) for t in times]
    rates = [(size * omega * np.cos(omega * t[:, None] + phase)).sum(axis=0) for t in times]
    tilt = np.column_stack([turned[0][:, 1], -turned[0][:, 0], -np.ones(len(times[0]))])
    noise = rng.standard_normal((2, len(times[0]), 3))
    gyro = rates[0][:, :3] + imu.gyro_noise * noise[0]
    force = GRAVITY * tilt + turned[0][:, 3:] + imu.accelerometer_noise * noise[1]
    (roll, pitch, _), (p, q, r) = turned[1][:, :3].T, rates[1][:, :3].T
    answer = [0.3 * pitch + 0.05 * q, 0.1 * r, -0.3 * roll - 0.03 * p, 0.0 * p]
    channels = measured.flight.channel_trim + np.column_stack(answer)
    imu_t_ns = measured.imu_t_ns[0] + every[0] * np.arange(len(gyro) + len(measured.rates))
    actuators = np.concatenate([channels, measured.actuators])
    actuator_t_ns = measured.actuator_t_ns[0] + every[1] * np.arange(len(actuators))
    return replace(
        measured,
        rates=np.concatenate([gyro * FLU_TO_FRD, measured.rates]),
        specific_force=np.concatenate([force * FLU_TO_FRD, measured.specific_force]),
        actuators=actuators,
        imu_t_ns=imu_t_ns, imu_log_ns=imu_t_ns, true_t_ns=imu_t_ns,
        actuator_t_ns=actuator_t_ns, actuator_log_ns=actuator_t_ns,
    )  # fmt: skip


def _launched(series: Series) -> Iterator[Trial]:
    """Carried to the launch with the node running, then excitation, without an armed topic."""
    for aircraft, wind in (("light_aircraft", 0.3), ("ultra_stick_25e", 1)):
        for seconds in (20.0, 60.0):
            spoil = partial(carried, seconds, series.seed)
            label = f"carried for {seconds:g} s"
            yield series.trial(aircraft, label, 150.0, bank=20.0, wind=wind, spoil=spoil)


def _pitot(reads: float, until: float, measured: Measurements) -> Measurements:
    """Scale the measured airspeed to a share `reads`, from `GLITCH_TIME` to `until`."""
    time = (measured.airspeed_t_ns - measured.imu_t_ns[0]) * 1e-9
    wrong = (time >= GLITCH_TIME) & (time < until)
    return replace(measured, airspeed=np.where(wrong, reads, 1.0) * measured.airspeed)


def _blocked(series: Series) -> Iterator[Trial]:
    """Excitation, with an airspeed; the pitot tube is blocked for ten seconds or for good."""
    for aircraft, wind in (("light_aircraft", 0.3), ("c172p", 2)):
        for reads, until in ((0.0, GLITCH_TIME + 10.0), (0.0, 1e3), (0.5, 1e3)):
            yield series.trial(
                aircraft,
                f"reads {reads:g} of the airspeed" + (", for good" if until == 1e3 else ""),
                130.0, bank=20.0, wind=wind, sensors=replace(SENSORS, airspeed_noise=0.5),
                spoil=partial(_pitot, reads, until),
            )  # fmt: skip


def _noisy_airspeed(series: Series) -> Iterator[Trial]:
    """Excitation, with an airspeed as noisy as that of a light aircraft's pitot tube, or more."""
    for (aircraft, wind, more), noise in product(
        (("light_aircraft", 0.3, {"speed": 13.0}), ("ultra_stick_25e", 1, {}), ("c172p", 3, {})),
        (0.5, 3.0),
    ):
        sensors = replace(SENSORS, airspeed_noise=noise)
        label = f"airspeed with a noise of {noise:g} m/s"
        yield series.trial(aircraft, label, bank=20.0, wind=wind, sensors=sensors, **more)


def _loaded(series: Series) -> Iterator[Trial]:
    """Excitation; a load is dropped or added, and the whole row changes with the inertia."""
    for rows, factor in (
        ("pdot qdot rdot", 0.7), ("pdot qdot rdot", 1.4), ("pdot", 0.6), ("qdot", 0.5),
    ):  # fmt: skip
        when, label = series.length * CHANGED, f"{rows} x {factor:g}"
        changes = (CoefficientChange(when, dict.fromkeys(rows.split(), factor)),)
        yield series.trial("light_aircraft", label, 130.0, bank=20.0, wind=0.3, changes=changes)


def _retrim(surface: int, when: float, measured: Measurements) -> Measurements:
    """Move the recorded channel by `RETRIM` over two seconds, as flaps move the trim."""
    time = (measured.actuator_t_ns - measured.imu_t_ns[0]) * 1e-9
    actuators = measured.actuators.copy()
    actuators[:, surface] += RETRIM * np.clip((time - when) / RETRIM_TIME, 0.0, 1.0)
    return replace(measured, actuators=actuators)


def _retrimmed(series: Series) -> Iterator[Trial]:
    """Excitation; the trim changes, as by flaps or a shifted load, and no channel shows it."""
    for aircraft, wind in WINDY.items():
        for name in ("de", "da"):
            spoil = partial(_retrim, INPUTS.index(name), 0.6 * series.length * CHANGED)
            label = f"trim of {name} + {RETRIM:g} rad"
            yield series.trial(aircraft, label, bank=20.0, wind=wind, spoil=spoil)


def _mistakes(series: Series) -> Iterator[Trial]:
    """Excitation, with one mistake in each flight."""
    for aircraft, wind in (("light_aircraft", 0.3), ("c172p", 0)):
        for mistake, spoil, settings, named in MISTAKES:
            yield series.trial(
                aircraft, mistake, 60.0, excitation=((0.0, 1e3),), bank=20.0, wind=wind,
                spoil=spoil, settings=settings, names=named,
            )  # fmt: skip


def _reversed(series: Series) -> Iterator[Trial]:
    """Excitation in level flight, with an Imu turned round or one axis of its gyro reversed."""
    backwards = _mounted(np.diag([-1.0, -1.0, 1.0]))
    pitched = partial(multiply, np.diag([1.0, -1.0, 1.0]), np.eye(3))
    for aircraft, wind in (
        ("light_aircraft", 0.0), ("light_aircraft", 0.5), ("c172p", 3), ("T37", 0), ("OV10", 0),
        ("ultra_stick_25e", 2),
    ):  # fmt: skip
        for mistake, spoil, named in (
            ("the Imu points backwards", backwards, "points backwards"),
            ("axis y of the gyro reversed", pitched, "axis y of the gyro"),
        ):
            label = f"wind {wind:g}, {mistake}"
            yield series.trial(aircraft, label, wind=wind, spoil=spoil, names=named)


def _recorded(series: Series) -> Iterator[Trial]:
    """Real flights, each once, if available."""
    for name in filter(cases.is_recorded, cases.RECORDED_DELAY if series.seed == 1 else ()):
        settings = {"actuators.estimate_delay": True}
        yield Trial("recorded", name, series.seed, partial(cases.recorded, name), settings)


CLASSES = {
    make.__name__.removeprefix("_"): make
    for make in (
        _feedback, _old_knowledge, _changed, _jammed, _slowing, _fading, _intermittent, _unmodelled,
        _untold, _biased, _imperfect, _weak, _glitch, _clean, _published, _in_turn, _partly,
        _unseen, _swaying, _random, _closed_loop, _told_wrong, _warm, _launched, _blocked,
        _noisy_airspeed, _loaded, _retrimmed, _mistakes, _reversed, _recorded,
    )
}  # fmt: skip
"""Generator of the trials of each class."""


def trials(classes: Sequence[str], seeds: Sequence[int], length: float = LONG) -> list[Trial]:
    """Return the trials of the named classes, with each seed."""
    return [
        trial
        for kind, seed in product(classes, seeds)
        for trial in CLASSES[kind](Series(kind, seed, length))
    ]
