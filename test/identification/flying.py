# SPDX-License-Identifier: Apache-2.0
"""Simulated flights, their measurements, and runs of the identifier on them."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from light_aircraft import TRUTH, LightFlight

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.identification.estimate import CoefficientSet, Estimate
from uav_ident_ros.identification.estimators import Estimator
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.samples import EXCITATION
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray, Structure
from uav_ident_ros.offline.inputs import choose_inputs
from uav_ident_ros.offline.run import OfflineRun
from uav_ident_ros.simulation.flight import Flight
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.live import Plan
from uav_ident_ros.simulation.noise import Measurements, Sensors, SentSample, fed, measure
from uav_ident_ros.simulation.plant import SMALL_UAV, PlantFlight
from uav_ident_ros.simulation.recording import parameters

AMPLITUDES = {"de": 0.08, "dr": 0.12, "da": 0.06, "dth": 0.2}
RECORDED = Path(__file__).resolve().parents[3] / "shared" / "bags"
TICK = 0.05
"""Time between ticks, s."""
DOMINANT = ("pdot/p", "qdot/q", "rdot/r", "pdot/da", "qdot/de", "rdot/dr")


def by_ticks(measured: Measurements) -> tuple[FloatArray, FloatArray]:
    """Return the mean rates and specific forces of each tick."""
    signals = np.hstack([measured.rates, measured.specific_force])
    samples = round(TICK * measured.sensors.rate)
    means = signals[:-1].reshape(-1, samples, 6).mean(axis=1)
    return means[:, :3], means[:, 3:]


_FLOWN: dict[str, Flight] = {}


def flight_of(plan: Plan) -> Flight:
    """Return the flight of a plan; each plan is simulated once."""
    key = repr(plan)
    if key not in _FLOWN:
        _FLOWN[key] = plan.fly()
    return _FLOWN[key]


def plant_flight(duration: float, **changes: Any) -> Flight:
    """Multisines on the small aircraft with known coefficients."""
    values: dict[str, Any] = {
        "vehicle": SMALL_UAV,
        "segments": (Segment("multisine", amplitudes=AMPLITUDES, seed=1),),
        "duration": duration,
        "rate": 200.0,
        "max_step": 2.5e-3,
        "seed": 1,
    }
    return flight_of(PlantFlight(**{**values, **changes}))


def measured(duration: float, noise: float = 0.02, **changes: Any) -> Measurements:
    """Measurements of `plant_flight` with a noisy gyro."""
    return measure(plant_flight(duration, **changes), Sensors(gyro_noise=noise), seed=2)


SURFACES = {"de": 0.06, "dr": 0.08, "da": 0.06}
PEAKS = SURFACES | {"dth": 0.1}
LIGHT_SENSORS = {"rate": 100.0, "gyro_noise": 0.01, "accelerometer_noise": 0.15}


def light_measured(
    seconds: float,
    peaks: Mapping[str, float] = PEAKS,
    start: float = 2.0,
    sensors: Mapping[str, Any] | None = None,
    noise_seed: int = 0,
    **aircraft: Any,
) -> Measurements:
    """Measurements of multisines on an aircraft with flow angles, in light gusts.

    Without `peaks` only the autopilot moves the inputs.
    """
    imu = Sensors(**{**LIGHT_SENSORS, **(sensors or {})})
    values: dict[str, Any] = {"gust": 0.3, "seed": 1, "rate": imu.rate, **aircraft}
    excited = Segment("multisine", start, seconds, peaks, seed=values["seed"])
    segments = values.pop("segments", (excited,) if peaks else ())
    flight = flight_of(LightFlight(segments, seconds, **values))
    return measure(flight, imu, noise_seed)


def light_errors(
    estimate: Estimate, *names: str, factor: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """Errors from `factor` times the light aircraft's coefficients: relative, and in sigmas."""
    places = tuple(zip(*map(STRUCTURES["flight_dynamics"].index, names), strict=True))
    true = factor * np.array([TRUTH[name] for name in names])
    error = np.abs(estimate.coefficients[places] - true)
    return error / np.abs(true), error / estimate.sigma[places]


def stiff_autopilot(seconds: float, seed: int) -> Measurements:
    """Measurements of the light aircraft, not excited: a high-gain autopilot in strong gusts."""
    air = {"bank": 30.0, "gust": 1.0, "roll_gust": 0.5, "roll_gain": 0.8, "yaw_damper": 0.3}
    imu = {"rate": 200.0, "gyro_noise": 0.02, "accelerometer_noise": 0.1}
    return light_measured(seconds, {}, sensors=imu, noise_seed=seed, seed=seed, **air)


def settings(measurements: Measurements, **changes: Any) -> Settings:
    """Settings for the measurements; in the keywords ``__`` stands for the dot of a name.

    Ten ticks a second cost much less than the usual twenty, and the estimates are alike:
    test_conditioning.py.
    """
    values: dict[str, Any] = {"update_rate": 10.0, **parameters(measurements)}
    values.update({name.replace("__", "."): value for name, value in changes.items()})
    return Settings.from_values(values)


def messages(measurements: Measurements) -> list[SentSample]:
    """All messages in the order of arrival."""
    return list(measurements.messages())


def integrated(
    structure: Structure, t: FloatArray, u: FloatArray, coefficients: Callable[[float], FloatArray]
) -> FloatArray:
    """Rates from rest, with inputs held and coefficients constant from each time on."""
    x, h = np.zeros((len(t), 3)), (t[1] - t[0]) / 4
    for k in range(len(t) - 1):
        x[k + 1], a = x[k], coefficients(float(t[k]))
        for _ in range(4):  # midpoint rule
            middle = x[k + 1] + 0.5 * h * (a @ structure.regressor(x[k + 1], u[k]))
            x[k + 1] += h * (a @ structure.regressor(middle, u[k]))
    return x


def sent(stream: str, t_ns: Iterable[int], values: FloatArray) -> list[SentSample]:
    """Messages of one stream."""
    return [SentSample(t, stream, t, tuple(v)) for t, v in zip(t_ns, values.tolist(), strict=True)]


def with_injected(measurements: Measurements, after: float = 0.0) -> list[SentSample]:
    """All messages, from `after`, s, on with those of the injected signals."""
    first, stamps = int(measurements.imu_t_ns[0]), measurements.actuator_t_ns.tolist()
    injected = sent(EXCITATION, stamps, measurements.flight.injected)
    added = [message for message in injected if (message.t_ns - first) * 1e-9 >= after]
    return sorted([*messages(measurements), *added], key=lambda message: message.arrival_ns)


def run(identifier: OnlineIdentifier, stream: Iterable[SentSample]) -> list[Estimate]:
    """Feed the messages; return the estimates of all ticks as they become due."""
    return list(fed(identifier, stream))


@cache
def excited() -> Measurements:
    """Measurements of 37 s of the small aircraft with excitation."""
    return measured(37.0)


def fresh(**changes: Any) -> OnlineIdentifier:
    """A new identifier with the settings for `excited`."""
    return OnlineIdentifier(settings(excited(), structure="throttle_coupled", **changes))


def identified(
    measurements: Measurements,
    initial: CoefficientSet | None = None,
    stream: Iterable[SentSample] | None = None,  # Messages, if not those of the measurements
    **changes: Any,
) -> tuple[OnlineIdentifier, list[Estimate]]:
    """Return the identifier after the flight, and its estimates."""
    identifier = OnlineIdentifier(settings(measurements, **changes), initial)
    return identifier, run(identifier, messages(measurements) if stream is None else stream)


def blocks(
    x: FloatArray,
    u: FloatArray,
    h: float,
    force: FloatArray | None = None,
    cells: int = 0,  # Of a block; all by default
) -> Iterator[Block]:
    """Cut rates, forces at the edges (N + 1) and inputs of the cells (N) into blocks."""
    t_ns, cells = np.rint(np.arange(len(x)) * h * 1e9).astype(np.int64), cells or len(u)
    force = np.zeros((len(x), 3)) if force is None else force
    for k in range(0, len(u) - cells + 1, cells):
        edges, own = slice(k, k + cells + 1), slice(k, k + cells)
        yield Block(t_ns[edges], h, x[edges], u[own], force[edges], k == 0)


def begun(name: str, seconds: float, **values: Any) -> tuple[OnlineIdentifier, Estimator]:
    """The identifier after the first seconds of a recorded flight, and its first estimator."""
    if not (RECORDED / name).exists():
        pytest.skip(f"there is no recorded flight {name}")
    given = {key.replace("__", "."): value for key, value in values.items()}
    with Bag(RECORDED / name) as bag, pytest.MonkeyPatch.context() as patch:
        flown = OfflineRun(choose_inputs(bag, given))
        first, every = flown.identifier.estimator, bag.messages
        end_ns = bag.start_ns + round(seconds * 1e9)
        early = (m for m in every(flown.inputs.topics) if m.log_ns < end_ns)
        patch.setattr(bag, "messages", lambda _: early)
        flown.run(bag)
    return flown.identifier, first


def since(estimates: list[Estimate], begin: float, end: float) -> list[Estimate]:
    """Estimates from `begin` to `end` s after the first one."""
    first = estimates[0].t_ns
    return [e for e in estimates if begin <= (e.t_ns - first) * 1e-9 < end]


def worst_error(
    coefficients: FloatArray,
    flight: Flight,
    names: Iterable[str] = DOMINANT,
    structure: str = "throttle_coupled",
) -> float:
    """Largest relative error of the named coefficients."""
    assert flight.coefficients is not None
    found, truth = STRUCTURES[structure], STRUCTURES[flight.structure]
    shares = [
        coefficients[found.index(name)] / flight.coefficients[truth.index(name)] for name in names
    ]
    return float(np.abs(np.array(shares) - 1.0).max())


def linear_names(flight: Flight) -> list[str]:
    """Names of the coefficients of rates and inputs."""
    structure = STRUCTURES[flight.structure]
    return [n for n, (_, j) in structure.places.items() if j >= 5]
