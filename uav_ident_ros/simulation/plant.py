# SPDX-License-Identifier: Apache-2.0
"""Flight of a plant of the paper's structure: ``xdot = A f(x, u) + disturbance``.

Runge-Kutta of fourth order on a grid that every switching of the inputs falls on, so that
the held inputs, the delay and the servo lag are exact; the error per step is below 1e-11
of the rates for modes up to 20 rad/s at the default step.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from uav_ident_ros.identification.model import GRAVITY, integrate, rates_derivative
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    INPUTS,
    RATES,
    STRUCTURES,
    FloatArray,
)
from uav_ident_ros.simulation.disturbance import CALM, ColouredNoise
from uav_ident_ros.simulation.errors import SimulationError
from uav_ident_ros.simulation.faults import Schedule
from uav_ident_ros.simulation.flight import (
    STEP_TOLERANCE,
    CoefficientChange,
    Flight,
    changed_coefficients,
    check_positive,
    sample_count,
    stamps,
)
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.live import Live
from uav_ident_ros.simulation.noise import Sensors
from uav_ident_ros.simulation.vehicles import Vehicle

DEFAULT_TRIM = (0.0, 0.0, 0.0, 0.5)
"""Surfaces centred (rad), half throttle."""

MAX_SUBSTEPS = 200
"""Substeps per sample tried in search of a grid that fits the actuator rate and the delay."""

DIVERGED = 1e3
"""Rate at which the plant counts as diverged, rad/s."""


@dataclass(frozen=True)
class Autopilot:
    """Linear feedback, computed at each actuator sample from the true rates."""

    # ``"de/q"`` and so on: input per rate, rad per rad/s
    rate_gain: Mapping[str, float] = field(default_factory=dict)
    # The same for the integral of the rate, rad per rad
    angle_gain: Mapping[str, float] = field(default_factory=dict)
    limit: float = 0.5  # Largest command of any input, rad or throttle

    def matrices(self) -> tuple[FloatArray, FloatArray]:
        """Gains on the rates and on their integrals, each (4, 3)."""
        return _gain_matrix(self.rate_gain), _gain_matrix(self.angle_gain)


def _gain_matrix(gains: Mapping[str, float]) -> FloatArray:
    matrix = np.zeros((len(INPUTS), len(RATES)))
    for name, value in gains.items():
        target, _, source = name.partition("/")
        if target not in INPUTS or source not in RATES:
            raise SimulationError(
                f"autopilot gain '{name}' is unknown: write input/rate, as in 'de/q'"
            )
        matrix[INPUTS.index(target), RATES.index(source)] = value
    return matrix


@dataclass(frozen=True)
class PlantFlight:
    """Everything that defines a flight of a structure plant."""

    vehicle: Vehicle  # The plant
    segments: Sequence[Segment]  # Excitation; they add up
    duration: float  # Length of the flight, s
    rate: float = 1000.0  # Rate of the noise-free samples, Hz
    actuator_rate: float = 100.0  # Rate of the commands, Hz; each is held until the next
    delay: float = 0.0  # From command to surface, s
    time_constant: float = 0.0  # First-order lag of the servos, s
    gusts: ColouredNoise = CALM  # Angular acceleration, rad/s^2, on each axis independently
    # Variation of the specific force, m/s^2, on each axis; about (0, 0, -g)
    force: ColouredNoise = CALM
    # (3,) Constant angular acceleration, rad/s^2: an aircraft out of trim
    moment: Sequence[float] = (0.0, 0.0, 0.0)
    autopilot: Autopilot | None = None  # Feedback that is added to the excitation
    changes: tuple[CoefficientChange, ...] = ()  # Coefficients that change in flight
    # (4,) Trim of de, dr, da, dth: what the plain raw channels are at zero deviation
    trim: Sequence[float] = DEFAULT_TRIM
    initial_rates: Sequence[float] = (0.0, 0.0, 0.0)  # (3,) p, q, r at the start, rad/s
    seed: int = 0  # Seed of the disturbances
    max_step: float = 1e-3  # Largest integration step, s

    def __post_init__(self) -> None:
        check_positive(self, "duration", "rate", "actuator_rate", "max_step")
        for name in ("delay", "time_constant"):
            if not (0.0 <= getattr(self, name) < math.inf):
                raise SimulationError(f"{name} is {getattr(self, name)} s: it must be 0 or more")


def _substeps(spec: PlantFlight) -> int:
    """Return the least number of steps in a sample so that commands and delay fall on the grid."""
    first = max(1, math.ceil(1.0 / (spec.rate * spec.max_step) - STEP_TOLERANCE))
    for substeps in range(first, first + MAX_SUBSTEPS):
        fine = spec.rate * substeps
        offsets = (fine / spec.actuator_rate, fine * spec.delay)
        if all(abs(v - round(v)) < STEP_TOLERANCE for v in offsets):
            return substeps
    raise SimulationError(
        f"actuator rate {spec.actuator_rate:g} Hz and delay {spec.delay:g} s fall on no common "
        f"grid with the sample rate {spec.rate:g} Hz: use whole fractions of it and whole "
        "milliseconds"
    )


def fly(
    spec: PlantFlight,  # The flight
    name: str = "",  # Name of the result; the vehicle's by default
) -> Flight:
    """Fly a plant of the paper's structure.

    Raises
    ------
    SimulationError
        If the flight is impossible as asked, or the plant diverges.
    """
    substeps, samples = _substeps(spec), sample_count(spec.duration, spec.rate)
    if samples < 2:
        raise SimulationError(
            f"a duration of {spec.duration} s holds no two samples at {spec.rate} Hz"
        )
    _check_structure(spec.vehicle)
    gust_rng, force_rng = (np.random.default_rng([spec.seed, k]) for k in range(2))
    gust = np.asarray(spec.moment) + spec.gusts.sample(samples, 3, spec.rate, gust_rng)
    force = spec.force.sample(samples, 3, spec.rate, force_rng) - [0.0, 0.0, GRAVITY]
    live = _LivePlant(spec, substeps, gust)
    flown = live.record(spec.segments, (samples - 1) / spec.rate, live.told)
    rates, acceleration = flown.rows[::substeps].transpose(1, 0, 2)
    return Flight(
        name=name or spec.vehicle.name,
        rates=rates,
        angular_acceleration=acceleration,
        specific_force=force,
        inputs=flown.commands,
        trim=np.asarray(spec.trim, dtype=np.float64),
        delay=spec.delay,
        time_constant=spec.time_constant,
        structure=spec.vehicle.structure,
        coefficients=np.asarray(spec.vehicle.coefficients, dtype=np.float64),
        changes=spec.changes,
        extra={"gust": gust},
        **flown.common | {"t_ns": stamps(np.arange(samples) / spec.rate)},
    )


def _check_structure(vehicle: Vehicle) -> None:
    structure = STRUCTURES[vehicle.structure]
    if vehicle.coefficients.shape != structure.mask.shape:
        raise SimulationError(
            f"coefficients of plant '{vehicle.name}' have shape {vehicle.coefficients.shape}: "
            f"structure '{structure.name}' needs {structure.mask.shape}"
        )
    if np.any(vehicle.coefficients[~structure.mask]):
        i, j = np.argwhere((vehicle.coefficients != 0.0) & ~structure.mask)[0]
        raise SimulationError(
            f"plant '{vehicle.name}' has a coefficient in row {'pqr'[i]} of "
            f"'{structure.regressors[j]}', which structure '{structure.name}' does not have"
        )


class _LivePlant(Live):
    """It in flight; a row has the rates and their derivatives."""

    def __init__(self, spec: PlantFlight, substeps: int, gust: FloatArray) -> None:
        rate = spec.rate * substeps
        super().__init__(Sensors(rate=spec.actuator_rate), spec.delay, spec.seed, rate)
        self.faults, self._spec = Schedule((), lambda _: None), spec
        self._rates = [float(rate) for rate in spec.initial_rates]
        self._angles = np.zeros(len(RATES))
        self._gains = (spec.autopilot or Autopilot()).matrices()
        self._acting = self._surfaces = np.zeros(len(INPUTS))
        lag = spec.time_constant
        self._half = math.exp(-0.5 / (rate * lag)) if lag else 0.0
        # at the beginning, in the middle and at the end of each step
        stages = np.arange(2 * substeps * (len(gust) - 1) + 3) / (2.0 * substeps)
        known = np.arange(len(gust))
        self._gusts = np.column_stack([np.interp(stages, known, column) for column in gust.T])
        self._ahead = sorted(change.time for change in spec.changes)
        self._change()

    def _change(self) -> None:
        """Take the coefficients that hold over the next step."""
        now = self.time + 0.5 / self.rate
        self._ahead = [time for time in self._ahead if time > now]
        vehicle = self._spec.vehicle
        a = changed_coefficients(vehicle.structure, vehicle.coefficients, self._spec.changes, now)
        self._by_input, self._derivative = a[:, INPUT_COLUMNS], rates_derivative(a)

    def told(self, _: float, excitation: FloatArray) -> FloatArray:
        """Excitation and feedback, within the autopilot's limit."""
        if self._spec.autopilot is None:
            return excitation
        x, limit = np.array(self._rates), self._spec.autopilot.limit
        feedback = self._gains[0] @ x + self._gains[1] @ self._angles
        self._angles = self._angles + x / self._spec.actuator_rate
        return np.asarray(np.clip(excitation + feedback, -limit, limit))

    def _fly(self, acting: FloatArray, moved: bool) -> None:
        if self._ahead and self._ahead[0] <= self.time + 0.5 / self.rate:
            self._change()
        away = self._surfaces - acting if self._half else np.zeros(len(INPUTS))
        surfaces = acting + np.outer((1.0, self._half, self._half**2), away)
        self._surfaces = surfaces[2]
        k = 2 * self._step
        drives = (surfaces @ self._by_input.T + self._gusts[k : k + 3]).tolist()
        assert self.rows is not None
        self.rows.append((self._rates, self._derivative(self._rates, drives[0])))
        step = (*drives, 1.0 / self.rate)
        (self._rates,) = integrate(self._derivative, self._rates, [step])
        if not all(abs(rate) < DIVERGED for rate in self._rates):  # NaN fails too
            raise SimulationError(
                f"plant '{self._spec.vehicle.name}' diverges at {self.time:.2f} s: use smaller "
                "amplitudes or gains"
            )

    def _tilt(self) -> Sequence[float]:
        return 0.0, 0.0  # no attitude is lost
