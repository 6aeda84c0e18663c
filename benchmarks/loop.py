# SPDX-License-Identifier: Apache-2.0
"""The closed loop in one process, without ROS, for campaigns of many flights.

Aircraft, faults, reference, identifier and controllers are those of the nodes, called in sequence.
Coefficients are in use from the sample at which they are due. The loop is much faster than over
DDS, and reproducible.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from uav_ident_ros.client import Coefficients, CoefficientSource, Fallback
from uav_ident_ros.control import IncrementalLaw, RateController
from uav_ident_ros.control.controller import Law
from uav_ident_ros.control.laws import Gains
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray
from uav_ident_ros.simulation.faults import SURFACE_NAMES, parse_fault
from uav_ident_ros.simulation.flight import EPOCH_NS, SimulationError
from uav_ident_ros.simulation.jsbsim_flight import LiveAircraft
from uav_ident_ros.simulation.live import Live, Sample
from uav_ident_ros.simulation.noise import Sensors
from uav_ident_ros.simulation.preparation import SENSORS, Prepared
from uav_ident_ros.simulation.rate_reference import NORMAL, Manoeuvres

DELAY = 0.02
"""Delay from a sample to the action of its command, s."""

Random = np.random.Generator


class Controller(Protocol):
    """Protocol of a controller, which returns a command for each sample."""

    def update(self, t_ns: int, x: FloatArray, reference: FloatArray) -> FloatArray:
        """Return de, dr, da, dth, deviations from trim."""


@dataclass(frozen=True, kw_only=True)
class Mission:
    """One flight, with the errors of the parts around the loop."""

    duration: float = 60.0  # s
    faults: tuple[str, ...] = ()  # As in `uav_ident_ros.simulation.faults`, with times
    seed: int = 0  # Of noise, turbulence and manoeuvres
    sensors: Sensors = SENSORS  # Of the Imu
    delay: float = DELAY  # True delay, s; identifier and controllers are configured for `DELAY`
    dead: tuple[float, float] = (0.0, 0.0)  # Interval without an identifier, s
    cold: bool = False  # Whether the next identifier has no initial coefficients
    clock: Callable[[float], float] = lambda t: 0.0  # Error of all stamps, s
    # Rates in the Imu message; None for a lost message
    imu: Callable[[float, FloatArray, Random], FloatArray | None] = lambda t, x, rng: x
    # Messages that arrive for a set of coefficients
    messages: Callable[[float, Coefficients, Random], list[Coefficients]] = lambda t, c, rng: [c]
    excitation: Callable[[float], FloatArray] = lambda t: np.zeros(4)

    def take_off(self, aircraft: str, speed: float) -> LiveAircraft:
        """Return the aircraft in steady flight at a true airspeed, m/s."""
        faults = [parse_fault(text) for text in self.faults]
        return LiveAircraft(aircraft, self.sensors, self.delay, faults, self.seed, speed=speed)


@dataclass(eq=False)
class Outcome:
    """Result of one flight."""

    # With times, s: verdicts of roll, pitch and yaw at each tick; reasons against the coefficients,
    # or empty; coefficients with a covariance reset; and each change of the sources of the axes'
    # control derivatives
    usable: list[tuple[float, tuple[bool, bool, bool]]] = field(default_factory=list)
    denied: list[tuple[float, str]] = field(default_factory=list)
    changes: list[tuple[float, str]] = field(default_factory=list)
    sources: list[tuple[float, tuple[str, ...]]] = field(default_factory=list)
    lost: float | None = None  # Time of the loss of the aircraft, s
    samples: list[Sample] = field(default_factory=list)
    wanted: list[FloatArray] = field(default_factory=list)  # (3,) Reference at each, rad/s

    @property
    def time(self) -> FloatArray:
        """Times of the samples, s, shape (N,)."""
        return np.array([sample.time for sample in self.samples])

    @property
    def rates(self) -> FloatArray:
        """True p, q, r, rad/s, shape (N, 3)."""
        return np.array([sample.rates for sample in self.samples])

    def error(self, start: float, end: float) -> FloatArray:
        """Return the rms of true rates minus reference, `start` to `end` (s), (3,), deg/s."""
        inside = (self.time >= start) & (self.time < end)
        if not inside.any():
            return np.full(3, np.nan)
        mean = np.mean((self.rates - np.array(self.wanted))[inside] ** 2, axis=0)
        return np.asarray(np.degrees(np.sqrt(mean)))


def nominal_of(prepared: Prepared) -> Coefficients:
    """Return the nominal coefficients of an aircraft for a controller."""
    c = prepared.coefficients
    return Coefficients(STRUCTURES[c.structure], c.values, c.sigma, t_ns=c.t_ns)


def make_identifier(prepared: Prepared, **settings: object) -> OnlineIdentifier:
    """Return the identifier of the loop, FRD; without airspeed if `airspeed.type` is empty."""
    values: dict[str, object] = {
        "structure": prepared.coefficients.structure,
        "imu.convention": "frd",
        "actuators.type": "sensor_msgs/msg/JointState",
        "actuators.channels": list(SURFACE_NAMES),
        "actuators.trim": prepared.trim.tolist(),
        "actuators.delay": DELAY,
        "airspeed.type": "geometry_msgs/msg/TwistStamped",
        "airspeed.reference": prepared.airframe.speed,
        **settings,
    }
    return OnlineIdentifier(Settings.from_values(values), prepared.coefficients)


def message_of(identifier: OnlineIdentifier, estimate: Estimate) -> Coefficients:
    """Return the coefficients of an estimate, as a controller receives them from the node."""
    return Coefficients(
        structure=identifier.structure,
        values=estimate.coefficients,
        sigma=estimate.sigma,
        usable=estimate.usable,
        usable_rows=estimate.usable_rows,
        flow=estimate.flow,
        fit=estimate.fit,
        t_ns=estimate.t_ns,
    )


@dataclass(eq=False)
class Loop:
    """A vehicle with its reference, controller and identifier."""

    live: Live
    trim: FloatArray  # (4,) Trim of the controller's inputs
    guide: Manoeuvres
    controller: Controller
    identifier: OnlineIdentifier | None = None
    # Injection into the controller's inputs at a stamp, ns, and callback on each estimate
    inject: Callable[[int, FloatArray], FloatArray] = lambda _, u: u
    on_estimate: Callable[[Estimate], object] = lambda _: None
    # At a time, s: error of all stamps, s; rates in the Imu message, None for a lost one
    clock: Callable[[float], float] = lambda _: 0.0
    imu: Callable[[float, FloatArray], FloatArray | None] = lambda _, x: x

    def __post_init__(self) -> None:
        self._u = np.zeros(4)

    def answer(self) -> tuple[Sample, FloatArray]:
        """Command the response to the newest sample; return it and the reference, (3,), rad/s."""
        live, sample = self.live, self.live.sample()
        t_ns = EPOCH_NS + round((sample.time + self.clock(sample.time)) * 1e9)
        roll, pitch = map(float, sample.attitude[:2])
        reference = self.guide.rates(sample.time, roll, pitch, 1.0 / live.sensors.rate)
        rates = self.imu(sample.time, sample.measured_rates)
        if rates is not None:
            u = self.controller.update(t_ns, rates, reference)
            self._u = self.inject(t_ns, u)
        live.command((self.trim + self._u)[:3])
        if self.identifier is not None:
            speed = sample.measured_airspeed
            if speed is not None and self.identifier.settings.airspeed.type:
                self.identifier.add_airspeed(t_ns, speed)
            self.identifier.add_actuators(t_ns, live.outputs.tolist())
            if rates is not None:
                self.identifier.add_rates(t_ns, rates.tolist(), sample.measured_force.tolist())
            for estimate in self.identifier.advance():
                self.on_estimate(estimate)
        return sample, reference


def fly_loop(
    prepared: Prepared,  # The aircraft
    mission: Mission,  # The flight
    # Makes the controller, on a source of coefficients
    make: Callable[[CoefficientSource], Controller],
    identifier: OnlineIdentifier | None = None,  # The identifier, if any
    live: LiveAircraft | None = None,  # By default the prepared aircraft at its speed
) -> Outcome:
    """Fly a mission and return its result."""
    live = live or mission.take_off(prepared.aircraft, prepared.airframe.speed)
    speed = live.aircraft.airframe.speed
    guide = Manoeuvres(**NORMAL | {"airspeed": speed, "seed": mission.seed})
    source = CoefficientSource(Fallback.LAST_GOOD, nominal_of(prepared))
    controller = make(source)
    rng = np.random.default_rng(mission.seed)
    outcome = Outcome()

    def on_estimate(estimate: Estimate) -> None:
        assert loop.identifier is not None
        for message in mission.messages(live.time, message_of(loop.identifier, estimate), rng):
            source.add(message)
        t = (estimate.t_ns - EPOCH_NS) * 1e-9
        outcome.usable.append((t, estimate.usable_rows))
        outcome.denied.append((t, "" if estimate.usable else estimate.reason))

    def inject(t_ns: int, u: FloatArray) -> FloatArray:
        if not isinstance(controller, RateController):
            return u
        return controller.inject(t_ns, u, mission.excitation(live.time))

    loop = Loop(
        live, prepared.trim, guide, controller, identifier, inject, on_estimate, mission.clock,
        lambda t, x: mission.imu(t, x, rng),
    )  # fmt: skip
    killed, restarted = mission.dead
    try:
        for _ in range(round(mission.duration * mission.sensors.rate)):
            if identifier is not None and killed < live.time < restarted:
                loop.identifier = None
            elif identifier is not None and loop.identifier is None:
                known = None if mission.cold else prepared.coefficients
                loop.identifier = OnlineIdentifier(identifier.settings, known)
            sample, reference = loop.answer()
            outcome.samples.append(sample)
            outcome.wanted.append(reference)
            _note(outcome, loop)
            live.advance()
    except SimulationError:
        outcome.lost = live.time
    return outcome


def _note(outcome: Outcome, loop: Loop) -> None:
    """Add newly named changes, and the controller's sources if they have changed."""
    time, controller = outcome.samples[-1].time, loop.controller
    if loop.identifier is not None:
        for change in loop.identifier.supervisor.changed[len(outcome.changes) :]:
            outcome.changes.append((time, change.name))
    if isinstance(controller, RateController):
        now = controller.effect.sources
        if not outcome.sources or outcome.sources[-1][1] != now:
            outcome.sources.append((time, now))


def rate_controller(
    prepared: Prepared,
    adaptive: bool = True,
    law: Law = IncrementalLaw,
    gains: Gains | None = None,  # The law's by default
    delay: float = DELAY,  # Configured delay, s
) -> Callable[[CoefficientSource], RateController]:
    """Return a factory of a `RateController` for `fly_loop`."""
    limits = prepared.limits - prepared.trim

    def make(source: CoefficientSource) -> RateController:
        nominal = nominal_of(prepared)
        return RateController(source, nominal, limits, delay, law, adaptive, gains)

    return make
