# SPDX-License-Identifier: Apache-2.0
"""Prior knowledge: initial coefficients, their standard deviations, and the fixed coefficients."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.model import GRAVITY, LIFT_SLOPE, SIDE_FORCE_SLOPE
from uav_ident_ros.identification.rigid_body import Inertia, product_coefficients
from uav_ident_ros.identification.scales import SURE
from uav_ident_ros.identification.settings import LARGEST_NUMBER, Settings, SettingsError
from uav_ident_ros.identification.structure import (
    CONSTANT,
    FLOW_ANGLES,
    INPUT_COLUMNS,
    INPUTS,
    LAST_COLUMNS,
    PRODUCT_COLUMNS,
    RATE_COLUMNS,
    RATE_PRODUCTS,
    RATES,
    ROWS,
    SPECIFIC_FORCES,
    STRUCTURES,
    BoolArray,
    FloatArray,
    Structure,
)

PRODUCT_SIGMA = 1.0
"""Prior standard deviation of the rate-product coefficients: the inertia ratios of a rigid
body lie within -1 ... 1."""

RATE_SIGMA = 30.0
"""Prior standard deviation of unknown damping, 1/s, and of the constant, rad/s^2. It is several
times the values of aircraft. A second of excitation outweighs it; until then it keeps noise from
appearing as coefficients of millions."""

INPUT_SIGMA = RATE_SIGMA**2
"""Prior standard deviation of control derivatives, 1/s^2 per unit: the stiffness of a motion as
fast as `RATE_SIGMA`."""

STATIC_SIGMA = 300.0
"""Prior standard deviation of the moments of sideslip and angle of attack, rad/s^2 per rad. Three
times as much lets feedback into them: errors within a sigma fall from 68 to 62 % (false_usable.py,
feedback)."""

LARGEST_LIFT_ANGLE = 0.4
"""Angle of attack, relative to zero lift, at which every wing has stalled, rad. Level flight needs
less, so ``az/alpha`` is beyond ``-g / 0.4``. Where the elevator rests in calm air, no other
information bounds it: angles of a radian turned sideslip into roll (``p alpha``)."""

FORCE_SIGMA = INPUT_SIGMA / abs(LIFT_SLOPE)
"""Prior standard deviation of the moments by specific forces, rad/s^2 per m/s^2."""

SURFACE_SHARE = {"ay": 0.6, "az": 0.15}
"""Prior standard deviations of the forces of rudder and elevator per rad, relative to the slopes of
sideslip and angle of attack. A rudder turns two thirds of the fin, which makes most of the side
force; an elevator half of the tail, which makes a fifth of the lift. Inputs in other units than rad
have less effect per unit."""

KINEMATIC_SIGMA = 0.2
"""Prior standard deviation of the errors of the flow angles' kinematics. Constants, rad/s: an
accelerometer bias of a tenth of gravity at 5 m/s. ``betadot/p``, rad: the angle between the roll
axis and the flow without lift."""

TAIL_TIME = 0.1
"""Prior standard deviation of ``ay/p`` and ``ay/r`` relative to ``ay/beta``, s: a rate changes the
fin's sideslip by the fin's arm over the airspeed."""

RESUMED_CHANGE = 0.2
"""Usual change of a coefficient between two flights, relative to its value: load, air density,
battery, a repair. The prior is never discounted, so it must not be narrower than this."""


@dataclass(frozen=True)
class Start:
    """Initial coefficients and prior of an estimator.

    Parameters
    ----------
    values : (R, n) array
        Initial coefficients, SI.
    sigma : (R, n) array
        Their standard deviations; 0 where not free.
    free : (R, n) bool array
        Coefficients that are estimated.
    """

    values: FloatArray
    sigma: FloatArray
    free: BoolArray

    @property
    def precision(self) -> FloatArray:
        """Prior information ``1 / sigma^2``, shape (R, n); 0 where not free."""
        precision = np.zeros_like(self.sigma)
        precision[self.free] = self.sigma[self.free] ** -2
        return precision

    def known_a_priori(self, structure: Structure) -> BoolArray:
        """Return flags of the coefficients known before the flight, shape (R, n).

        In the force rows these are all: lift equals weight on every aircraft, and surfaces and fins
        make known shares of it. In other rows these are the coefficients with an informative prior.
        """
        known = self.informative(structure)
        forces = [flow.force for flow in structure.flow]
        known[forces] = self.free[forces]
        return known

    def informative(self, structure: Structure) -> BoolArray:
        """Return flags of the coefficients with an informative prior, of a file, shape (R, n)."""
        return np.asarray(self.free & (self.sigma < weak_sigma(structure)))

    def weakened(self, structure: Structure, which: BoolArray | None = None) -> Start:
        """Return the start with the weak prior for some coefficients (R, n), for all by default."""
        weak = self.informative(structure) if which is None else self.informative(structure) & which
        return replace(self, sigma=np.where(weak, weak_sigma(structure), self.sigma))

    def inputs_known(self, t_ratio: float) -> bool:
        """Whether each moment row starts with a control derivative of at least this t-ratio."""
        moments = np.s_[: len(ROWS), INPUT_COLUMNS]
        size = np.abs(self.values[moments])
        return bool(((size > 0.0) & (size >= t_ratio * self.sigma[moments])).any(axis=1).all())


def first_values(structure: Structure) -> FloatArray:
    """Return initial values of unknown coefficients, (R, n), SI: zero except the force slopes."""
    values = np.zeros(structure.mask.shape)
    for flow, slope in zip(structure.flow, (SIDE_FORCE_SLOPE, LIFT_SLOPE), strict=False):
        values[flow.force, flow.angle] = slope
    return values


def slope_bounds(structure: Structure) -> FloatArray:
    """Upper bounds of the coefficients, shape (R, n): a force opposes its flow angle.

    The slopes are denominators and must not vanish. Every aircraft has a tenth of the initial
    side-force slope, and lift equals weight.
    """
    bounds = np.full(structure.mask.shape, np.inf)
    largest = 0.1 * SIDE_FORCE_SLOPE, -GRAVITY / LARGEST_LIFT_ANGLE
    for flow, slope in zip(structure.flow, largest, strict=False):
        bounds[flow.force, flow.angle] = slope
    return bounds


def physical_bounds(structure: Structure, free: BoolArray) -> FloatArray:
    """Upper bounds by physics, shape (R, n): forces and rates damp themselves.

    Late inputs or an autopilot's feedback bias the damping. With positive damping a model grows by
    e in a fraction of a second. A row with a free measured force, by `free` (R, n), has no bound on
    its damping: the force carries a share of it.
    """
    bounds = slope_bounds(structure)
    shared = free[: len(ROWS), LAST_COLUMNS].any(axis=1) & structure.has_forces
    own = np.flatnonzero(~shared)
    bounds[own, RATE_COLUMNS.start + own] = 0.0
    return bounds


def weak_sigma(structure: Structure) -> FloatArray:
    """Prior standard deviations of unknown coefficients, shape (R, n), SI."""
    by_label = {
        **dict.fromkeys(RATE_PRODUCTS, PRODUCT_SIGMA),
        **dict.fromkeys(RATES, RATE_SIGMA),
        **dict.fromkeys(INPUTS, INPUT_SIGMA),
        **dict.fromkeys(SPECIFIC_FORCES, FORCE_SIGMA),
        **dict.fromkeys(FLOW_ANGLES, STATIC_SIGMA),
        CONSTANT: RATE_SIGMA,
        **{own.label: own.sigma for own in structure.own},
    }
    moments = [by_label[label] for label in structure.regressors]
    sigma = np.tile(moments, (len(structure.rows), 1))
    first = first_values(structure)
    for flow in structure.flow:
        sigma[flow.kinematics] = KINEMATIC_SIGMA
        slope = sigma[flow.force, flow.angle] = abs(first[flow.force, flow.angle])
        for j in flow.others:
            share = SURFACE_SHARE[structure.row_labels[flow.force]]
            sigma[flow.force, j] = slope * (TAIL_TIME if j < INPUT_COLUMNS.start else share)
    return sigma


def without_flow(start: Start, structure: Structure) -> Start:
    """Return the start for an aircraft without an accelerometer, whose flow is not observed.

    No moment then depends on the flow angles, and the force rows stay at their initial values.
    """
    moments = np.s_[: len(ROWS), LAST_COLUMNS]
    values, sigma, free = start.values.copy(), start.sigma.copy(), start.free.copy()
    values[moments] = sigma[moments] = 0.0
    free[moments] = free[len(ROWS) :] = False
    values[len(ROWS) :] = first_values(structure)[len(ROWS) :]
    return Start(values, sigma, free)


def resumed(saved: CoefficientSet) -> CoefficientSet:
    """Return the coefficients of an earlier flight as a prior, with larger standard deviations.

    The sigma of the file holds for its own flight: `SURE` times it covers another one.
    `RESUMED_CHANGE` between the flights is added. The t-ratio at the start is thus at most five,
    and a second of excitation outweighs the file.
    """
    change = RESUMED_CHANGE * np.abs(saved.values)
    sigma = np.where(saved.sigma > 0.0, np.hypot(SURE * saved.sigma, change), 0.0)
    return replace(saved, sigma=sigma)


def start_from(settings: Settings, initial: CoefficientSet | None = None) -> Start:
    """Collect the prior information.

    Parameters
    ----------
    settings : Settings
        Initial values, fixed coefficients, known inertias.
    initial : CoefficientSet, optional
        Coefficients from a file; they take precedence over the settings.

    Raises
    ------
    SettingsError
        If `initial` belongs to another structure or is beyond all bounds, or the inertias are
        impossible.
    """
    structure = STRUCTURES[settings.structure]
    values = first_values(structure)
    sigma = weak_sigma(structure)
    free = structure.mask.copy()
    if settings.initial_coefficients:
        given = np.array(settings.initial_coefficients).reshape(-1, structure.size)
        values[: len(given)] = np.where(structure.mask[: len(given)], given, 0.0)
    if initial is not None:
        if initial.structure != structure.name:
            raise SettingsError(
                f"the initial coefficients are of structure '{initial.structure}', "
                f"'structure' is '{structure.name}'",
            )
        if not (np.abs(initial.values) <= LARGEST_NUMBER).all():
            raise SettingsError(
                f"an initial coefficient is beyond {LARGEST_NUMBER:g}: none in SI units is",
            )
        values = np.where(structure.mask, initial.values, 0.0)
        # Trim and biases differ from flight to flight: constants keep the weak prior.
        known = (initial.sigma > 0.0) & ~structure.constants
        sigma = np.where(known, np.minimum(initial.sigma, sigma), sigma)
    if settings.model.inertia:
        try:
            inertia = Inertia(*settings.model.inertia)
        except ValueError as error:
            raise SettingsError(f"'model.inertia': {error}") from None
        values[:3, PRODUCT_COLUMNS] = product_coefficients(inertia)
        free[:3, PRODUCT_COLUMNS] = False
    values = np.minimum(values, slope_bounds(structure))
    for name in settings.fixed_coefficients:
        free[structure.index(name)] = False
    return Start(values, np.where(free, sigma, 0.0), free)
