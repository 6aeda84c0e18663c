# SPDX-License-Identifier: Apache-2.0
"""Plants of the paper's structure, by name, and their flights: ``xdot = A f(x, u) + disturbance``.

Integration is Runge-Kutta of order 4. Every switching of an input falls on its grid: held inputs,
delay and servo lag are exact. At the default step the error per step is below 1e-11 of the rates,
for modes up to 20 rad/s.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.model import GRAVITY, integrate, rates_derivative
from uav_ident_ros.identification.rigid_body import Inertia, coefficients_from_physics, full_moments
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    INPUTS,
    RATES,
    STRUCTURES,
    FloatArray,
)
from uav_ident_ros.simulation.flight import (
    STEP_TOLERANCE,
    CoefficientChange,
    Flight,
    SimulationError,
    changed_coefficients,
    check_positive,
)
from uav_ident_ros.simulation.inputs import CALM, ColouredNoise
from uav_ident_ros.simulation.live import Live, Plan
from uav_ident_ros.simulation.noise import Sensors

DEFAULT_TRIM = (0.0, 0.0, 0.0, 0.5)
"""Trim of de, dr, da, dth: surfaces centred (rad), half throttle."""

MAX_SUBSTEPS = 200
"""Largest number of substeps in a sample, tried for a grid that fits actuator rate and delay."""

DIVERGED = 1e3
"""Rate at which the plant counts as diverged, rad/s."""


RATE_GAIN = np.array([[0.0, 0.05, 0.0], [0.0, 0.0, 0.08], [-0.03, 0.0, 0.0], [0.0, 0.0, 0.0]])
ANGLE_GAIN = np.array([[0.0, 0.15, 0.0], [0.0, 0.0, 0.0], [-0.12, 0.0, 0.0], [0.0, 0.0, 0.0]])
"""Gains of the attitude hold of `small_uav`: de, dr, da, dth by p, q, r, rad per rad/s, and by
their integrals, rad per rad."""

LARGEST_COMMAND = 0.5
"""Largest command of any input under the autopilot, rad or throttle."""


@dataclass(frozen=True, eq=False)
class Vehicle:
    """A plant ``xdot = A f(x, u)``."""

    name: str  # Its name
    structure: str  # Structure of A
    coefficients: FloatArray  # (3, n) A, SI units
    inertia: Inertia | None = None  # Inertias behind A, kg m^2, if known


_STRUCTURE = STRUCTURES["throttle_coupled"]
_INERTIA = Inertia(ix=0.8244, iy=1.135, iz=1.759, ixz=0.1204)
_MOMENTS = full_moments(
    _STRUCTURE,
    l_p=-8.2, l_r=1.5, l_dr=2.7, l_da=49.6, l_dth=0.7,
    m_q=-6.8, m_de=-45.0, m_dth=-1.0,
    n_p=0.3, n_r=-3.7, n_dr=-21.3, n_da=-9.9, n_dth=-1.0,
)  # fmt: skip
SMALL_UAV = Vehicle(
    "small_uav", _STRUCTURE.name, coefficients_from_physics(_INERTIA, _MOMENTS), _INERTIA
)
"""Propeller aircraft of 13 kg: roll, pitch, yaw damping of about 10, 6 and 2 1/s."""

# A of Section 4, as printed; columns pq qr pr p^2 r^2 p q r de dr da dth.
_PRINTED = (
    (0.0010, 0.0107, 0.0, 0.0, 0.0, -0.1361, 0.0, 0.0111, 0.0, 0.0181, 0.0030, 0.0014),
    (0.0, 0.0, 0.0107, -0.0103, 0.0103, 0.0, -0.1090, 0.0, 0.0105, 0.0, 0.0, 0.0004),
    (0.0102, 0.0093, 0.0, 0.0, 0.0, 0.0104, 0.0, -0.1032, 0.0, -0.0011, 0.0054, 0.0001),
)


_TO_SI = np.array([180.0 / np.pi] * 5 + [1.0] * 7)

PAPER_PRINTED = Vehicle("paper_printed", _STRUCTURE.name, np.array(_PRINTED) * _TO_SI)
"""The paper's printed coefficients, in SI instead of degrees. No rigid body has them: A32 is not
-A11."""

VEHICLES = {one.name: one for one in (SMALL_UAV, PAPER_PRINTED)}
"""The plants by name."""


@dataclass(frozen=True, kw_only=True)
class PlantFlight(Plan):
    """Flight of a structure plant."""

    vehicle: Vehicle = SMALL_UAV  # The plant
    gusts: ColouredNoise = CALM  # Angular acceleration, rad/s^2, on each axis independently
    # Variation of the specific force, m/s^2, on each axis; about (0, 0, -g)
    force: ColouredNoise = CALM
    # (3,) Constant angular acceleration, rad/s^2, as from an error of the trim
    moment: Sequence[float] = (0.0, 0.0, 0.0)
    autopilot: bool = False  # Whether feedback of the true rates is added to the excitation
    changes: tuple[CoefficientChange, ...] = ()  # Coefficients that change in flight
    initial_rates: Sequence[float] = (0.0, 0.0, 0.0)  # (3,) p, q, r at the start, rad/s
    max_step: float = 1e-3  # Largest integration step, s

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self, "max_step")

    @property
    def substeps(self) -> int:
        """Smallest number of steps in a sample that puts commands and delay on the grid."""
        first = max(1, math.ceil(1.0 / (self.rate * self.max_step) - STEP_TOLERANCE))
        for substeps in range(first, first + MAX_SUBSTEPS):
            fine = self.rate * substeps
            offsets = (fine / self.actuator_rate, fine * self.delay)
            if all(abs(v - round(v)) < STEP_TOLERANCE for v in offsets):
                return substeps
        raise SimulationError(
            f"actuator rate {self.actuator_rate:g} Hz and delay {self.delay:g} s fall on no common "
            f"grid with the sample rate {self.rate:g} Hz: use whole fractions of it and whole "
            "milliseconds"
        )

    def fly(self, name: str = "") -> Flight:
        """Simulate the flight; see `Plan.fly`. An unstable plant raises SimulationError."""
        gust_rng, force_rng = (np.random.default_rng([self.seed, k]) for k in range(2))
        gust = np.asarray(self.moment) + self.gusts.sample(self.samples, 3, self.rate, gust_rng)
        force = self.force.sample(self.samples, 3, self.rate, force_rng) - [0.0, 0.0, GRAVITY]
        live = _LivePlant(self, self.substeps, gust)
        _, commands, common = live.record(self, live.commanded)
        return Flight(
            name=name or self.vehicle.name,
            specific_force=force,
            inputs=commands,
            trim=np.array(DEFAULT_TRIM),
            structure=self.vehicle.structure,
            coefficients=np.asarray(self.vehicle.coefficients, dtype=np.float64),
            changes=self.changes,
            extra={"gust": gust},
            **common,
        )


class _LivePlant(Live):
    """The plant in flight."""

    def __init__(self, plan: PlantFlight, substeps: int, gust: FloatArray) -> None:
        rate = plan.rate * substeps
        super().__init__(Sensors(rate=plan.actuator_rate), plan.delay, plan.seed, rate)
        self._plan = plan
        self._rates = [float(rate) for rate in plan.initial_rates]
        self._angles = np.zeros(len(RATES))
        self._acting = self._surfaces = np.zeros(len(INPUTS))
        lag = plan.time_constant
        self._half = math.exp(-0.5 / (rate * lag)) if lag else 0.0
        # at the beginning, in the middle and at the end of each step
        stages = np.arange(2 * substeps * (len(gust) - 1) + 3) / (2.0 * substeps)
        known = np.arange(len(gust))
        self._gusts = np.column_stack([np.interp(stages, known, column) for column in gust.T])
        self._changes = sorted(change.time for change in plan.changes)
        self._change()

    def _change(self) -> None:
        """Update the coefficients to those of the next step."""
        now = self.time + 0.5 / self.rate
        self._changes = [time for time in self._changes if time > now]
        vehicle = self._plan.vehicle
        a = changed_coefficients(vehicle.structure, vehicle.coefficients, self._plan.changes, now)
        self._by_input, self._derivative = a[:, INPUT_COLUMNS], rates_derivative(a)

    def commanded(self, _: float, excitation: FloatArray) -> FloatArray:
        """Return excitation plus feedback at an actuator sample."""
        if not self._plan.autopilot:
            return excitation
        x = np.array(self._rates)
        feedback = RATE_GAIN @ x + ANGLE_GAIN @ self._angles
        self._angles = self._angles + x / self._plan.actuator_rate
        return np.asarray(np.clip(excitation + feedback, -LARGEST_COMMAND, LARGEST_COMMAND))

    def _fly(self, acting: FloatArray, moved: bool) -> list[float]:
        if self._changes and self._changes[0] <= self.time + 0.5 / self.rate:
            self._change()
        away = self._surfaces - acting if self._half else np.zeros(len(INPUTS))
        surfaces = acting + np.outer((1.0, self._half, self._half**2), away)
        self._surfaces = surfaces[2]
        k = 2 * self._step
        drives = (surfaces @ self._by_input.T + self._gusts[k : k + 3]).tolist()
        row = [*self._rates, *self._derivative(self._rates, drives[0])]
        step = (*drives, 1.0 / self.rate)
        (self._rates,) = integrate(self._derivative, self._rates, [step])
        if not all(abs(rate) < DIVERGED for rate in self._rates):  # NaN fails too
            raise SimulationError(
                f"plant '{self._plan.vehicle.name}' diverges at {self.time:.2f} s: use smaller "
                "amplitudes or gains"
            )
        return row
