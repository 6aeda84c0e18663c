# SPDX-License-Identifier: Apache-2.0
"""Flight of a plant of the paper's structure: ``xdot = A f(x, u) + disturbance``.

Runge-Kutta of fourth order on a grid that every switching of the inputs falls on, so that
the held inputs, the delay and the servo lag are exact; the error per step is below 1e-11
of the rates for modes up to 20 rad/s at the default step.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from uav_ident_ros.identification.structure import (
    EXOGENOUS_COLUMNS,
    INPUT_COLUMNS,
    INPUTS,
    PAPER_REGRESSORS,
    RATES,
    STRUCTURES,
    FloatArray,
)
from uav_ident_ros.simulation.disturbance import CALM, ColouredNoise
from uav_ident_ros.simulation.errors import SimulationError
from uav_ident_ros.simulation.flight import (
    GRAVITY,
    STEP_TOLERANCE,
    CoefficientChange,
    Flight,
    changed_coefficients,
    check_positive,
    sample_count,
    stamps,
)
from uav_ident_ros.simulation.inputs import Segment, excited_intervals, sample_inputs
from uav_ident_ros.simulation.vehicles import Vehicle

DEFAULT_TRIM = (0.0, 0.0, 0.0, 0.5)
"""Surfaces centred (rad), half throttle."""

MAX_SUBSTEPS = 200
"""Substeps per sample tried in search of a grid that fits the actuator rate and the delay."""

BLOCK_SECONDS = 10.0
"""Flight time whose disturbance and inputs are laid out in memory at once."""

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


@dataclass(frozen=True)
class _Grid:
    """Integration steps and what falls on them."""

    step: float
    substeps: int
    samples: int
    command_steps: NDArray[np.int64]
    """Steps at which commands are given; each acts `delay_steps` later."""
    delay_steps: int

    @property
    def steps(self) -> int:
        return (self.samples - 1) * self.substeps


def _make_grid(spec: PlantFlight) -> _Grid:
    samples = sample_count(spec.duration, spec.rate)
    if samples < 2:
        raise SimulationError(
            f"a duration of {spec.duration} s holds no two samples at {spec.rate} Hz"
        )
    first = max(1, math.ceil(1.0 / (spec.rate * spec.max_step) - STEP_TOLERANCE))
    for substeps in range(first, first + MAX_SUBSTEPS):
        fine = spec.rate * substeps
        offsets = (fine / spec.actuator_rate, fine * spec.delay)
        if all(abs(v - round(v)) < STEP_TOLERANCE for v in offsets):
            every, delay = (round(v) for v in offsets)
            commands = np.arange(0, (samples - 1) * substeps + 1, every)
            return _Grid(1.0 / fine, substeps, samples, commands, delay)
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
    grid = _make_grid(spec)
    a_start = np.asarray(spec.vehicle.coefficients, dtype=np.float64)
    _check_structure(spec.vehicle)
    gust_rng, force_rng = (np.random.default_rng([spec.seed, k]) for k in range(2))
    gust = np.asarray(spec.moment) + spec.gusts.sample(grid.samples, 3, spec.rate, gust_rng)
    force = spec.force.sample(grid.samples, 3, spec.rate, force_rng) - [0.0, 0.0, GRAVITY]
    excitation = sample_inputs(spec.segments, grid.command_steps * grid.step)

    run = _Run(spec, grid, gust, force, excitation)
    run.fly()
    return Flight(
        name=name or spec.vehicle.name,
        t_ns=stamps(np.arange(grid.samples) / spec.rate),
        rates=run.rates,
        angular_acceleration=run.acceleration,
        specific_force=force,
        actuator_t_ns=stamps(grid.command_steps * grid.step),
        inputs=run.commands,
        trim=np.asarray(spec.trim, dtype=np.float64),
        delay=spec.delay,
        time_constant=spec.time_constant,
        structure=spec.vehicle.structure,
        coefficients=a_start,
        changes=spec.changes,
        excitation=excited_intervals(spec.segments, spec.duration),
        extra={"gust": gust},
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


class _Run:
    """State of one flight while it is integrated, block by block."""

    def __init__(
        self,
        spec: PlantFlight,
        grid: _Grid,
        gust: FloatArray,
        force: FloatArray,
        excitation: FloatArray,
    ) -> None:
        self.spec, self.grid, self.gust, self.force = spec, grid, gust, force
        self.commands = excitation.copy()
        self.state = tuple(float(v) for v in spec.initial_rates)
        self.surfaces = np.zeros(len(INPUTS))
        self.angles = np.zeros(len(RATES))
        self.gains = (spec.autopilot or Autopilot()).matrices()
        self.rates = np.empty((grid.samples, 3))
        self.acceleration = np.empty((grid.samples, 3))
        self.rates[0] = self.state

    def fly(self) -> None:
        """Integrate from the first sample to the last."""
        edges = self._edges()
        for first, last in itertools.pairwise(edges):
            if self.spec.autopilot is not None:
                self._feed_back(first)
            self._integrate(first, last)
        self._accelerate_last()

    def _edges(self) -> list[int]:
        """List where blocks begin: at each command in closed loop, else every few seconds."""
        grid = self.grid
        if self.spec.autopilot is not None:
            starts = set(grid.command_steps.tolist())
        else:
            starts = set(range(0, grid.steps, max(1, round(BLOCK_SECONDS / grid.step))))
        starts |= {round(c.time / grid.step) for c in self.spec.changes}
        return sorted({s for s in starts if 0 <= s < grid.steps} | {0, grid.steps})

    def _feed_back(self, step: int) -> None:
        index = int(np.searchsorted(self.grid.command_steps, step))
        if index == len(self.commands) or self.grid.command_steps[index] != step:
            return
        autopilot = self.spec.autopilot
        limit = autopilot.limit if autopilot else math.inf
        x = np.asarray(self.state)
        feedback = self.gains[0] @ x + self.gains[1] @ self.angles
        self.angles += x / self.spec.actuator_rate
        self.commands[index] = np.clip(self.commands[index] + feedback, -limit, limit)

    def _integrate(self, first: int, last: int) -> None:
        grid = self.grid
        a = changed_coefficients(
            self.spec.vehicle.structure,
            self.spec.vehicle.coefficients,
            self.spec.changes,
            first * grid.step + 0.5 * grid.step,
        )
        surfaces = self._surfaces(first, last)
        forcing = self._disturbance(a, first, last) + surfaces @ a[:, INPUT_COLUMNS].T
        path = _runge_kutta(a, self.state, forcing, grid.step)
        states = np.array([self.state, *path])
        self.state = path[-1]
        if not all(abs(v) < DIVERGED for v in self.state):  # NaN fails too
            raise SimulationError(
                f"plant '{self.spec.vehicle.name}' diverges at {last * grid.step:.2f} s: use "
                "smaller amplitudes or gains"
            )
        wanted = np.arange(first, last)
        wanted = wanted[wanted % grid.substeps == 0]
        samples = wanted // grid.substeps
        self.rates[samples] = states[wanted - first]
        self.acceleration[samples] = (
            _free_response(a, states[wanted - first]) + forcing[wanted - first, 0]
        )
        if last % grid.substeps == 0:
            self.rates[last // grid.substeps] = states[-1]
        self.last_forcing, self.last_a = forcing[-1, 2], a

    def _accelerate_last(self) -> None:
        self.acceleration[-1] = _free_response(self.last_a, self.rates[-1:])[0] + self.last_forcing

    def _surfaces(self, first: int, last: int) -> FloatArray:
        """Surface deviations at start, middle and end of each step, shape (n, 3, 4)."""
        acting = self.grid.command_steps + self.grid.delay_steps
        index = np.searchsorted(acting, np.arange(first, last), side="right") - 1
        held = np.where(index[:, None] >= 0, self.commands[index], 0.0)
        tau = self.spec.time_constant
        if tau == 0.0:
            return np.repeat(held[:, None, :], 3, axis=1)
        half = math.exp(-0.5 * self.grid.step / tau)
        decay = np.array([1.0, half, half * half])[:, None]
        out = np.empty((last - first, 3, len(INPUTS)))
        s = self.surfaces
        for k, target in enumerate(held):
            out[k] = target + (s - target) * decay
            s = out[k, 2]
        self.surfaces = s
        return out

    def _disturbance(self, a: FloatArray, first: int, last: int) -> FloatArray:
        """Angular acceleration that no input makes, at three stages a step, shape (n, 3, 3)."""
        grid = self.grid
        stage = (np.arange(first, last)[:, None] + np.array([0.0, 0.5, 1.0])) / grid.substeps
        exogenous = self.gust
        if a.shape[1] > len(PAPER_REGRESSORS):
            constant_and_force = np.column_stack(
                [np.ones(grid.samples), self.force[:, 1], self.force[:, 2]]
            )
            beyond = a[:, EXOGENOUS_COLUMNS][:, len(INPUTS) :]
            exogenous = exogenous + constant_and_force @ beyond.T
        low = np.minimum(stage.astype(np.int64), grid.samples - 2)
        weight = (stage - low)[..., None]
        return np.asarray(exogenous[low] * (1.0 - weight) + exogenous[low + 1] * weight)


def _free_response(a: FloatArray, x: FloatArray) -> FloatArray:
    """Return A f(x, 0), shape (n, 3)."""
    f = STRUCTURES["baseline"].regressor(x, np.zeros((len(x), len(INPUTS))))
    return np.asarray(f @ a[:, : f.shape[1]].T)


def _runge_kutta(
    a: FloatArray, state: tuple[float, ...], forcing: FloatArray, h: float
) -> list[tuple[float, float, float]]:
    """Integrate over len(forcing) steps; scalar arithmetic, which is quickest for three states."""
    (a_pq, a_qr, _, _, _, a_p, _, a_r), (_, _, b_pr, b_pp, b_rr, _, b_q, _) = a[:2, :8].tolist()
    c_pq, c_qr, _, _, _, c_p, _, c_r = a[2, :8].tolist()

    def slope(p: float, q: float, r: float, g: list[float]) -> tuple[float, float, float]:
        pq, qr = p * q, q * r
        return (
            a_pq * pq + a_qr * qr + a_p * p + a_r * r + g[0],
            b_pr * p * r + b_pp * p * p + b_rr * r * r + b_q * q + g[1],
            c_pq * pq + c_qr * qr + c_p * p + c_r * r + g[2],
        )

    p, q, r = state
    half, sixth = 0.5 * h, h / 6.0
    path = []
    for start, middle, end in forcing.tolist():
        k1p, k1q, k1r = slope(p, q, r, start)
        k2p, k2q, k2r = slope(p + half * k1p, q + half * k1q, r + half * k1r, middle)
        k3p, k3q, k3r = slope(p + half * k2p, q + half * k2q, r + half * k2r, middle)
        k4p, k4q, k4r = slope(p + h * k3p, q + h * k3q, r + h * k3r, end)
        p += sixth * (k1p + 2.0 * (k2p + k3p) + k4p)
        q += sixth * (k1q + 2.0 * (k2q + k3q) + k4q)
        r += sixth * (k1r + 2.0 * (k2r + k3r) + k4r)
        path.append((p, q, r))
    return path
