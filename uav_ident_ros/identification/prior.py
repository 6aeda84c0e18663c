# SPDX-License-Identifier: Apache-2.0
"""What is known before the flight: initial values, their uncertainty, and what is fixed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.model import GRAVITY
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
"""Prior standard deviation of what is unknown: of damping, 1/s, and of the constant, rad/s^2.
Several times what aircraft have: a second of excitation outweighs it, and until then it keeps noise
from looking like coefficients of millions."""

INPUT_SIGMA = RATE_SIGMA**2
"""That of control derivatives, 1/s^2 per unit: so fast a motion is so stiff, and a surface does no
more than all the rest."""

STATIC_SIGMA = 300.0
"""That of the moments of sideslip and angle of attack, rad/s^2 per rad. Three times as much lets
feedback into them: errors within a sigma fall from 68 to 62 % (false_usable.py, feedback)."""

SIDE_FORCE_SLOPE, LIFT_SLOPE = -15.0, -100.0
"""Where `ay/beta` and `az/alpha` start, m/s^2 per rad, with a standard deviation of the same size.
In level flight lift is weight, so that ``az/alpha = -g C_La / C_L`` whatever the aircraft's size:
C_La is 4 to 6 per rad and C_L 0.2 to 0.8; the side force of fuselage and fin is a sixth of it."""

LARGEST_LIFT_ANGLE = 0.4
"""Angle of attack from that without lift, rad, at which every wing has stalled. Level flight needs
less: ``az/alpha`` is beyond ``-g / 0.4``. Where the elevator rests in calm air nothing else holds
it, and angles of a radian turned sideslip into roll (``p alpha``)."""

FORCE_SIGMA = INPUT_SIGMA / abs(LIFT_SLOPE)
"""Prior standard deviation of the moments that go with specific forces, rad/s^2 per m/s^2."""

SURFACE_SHARE = {"ay": 0.6, "az": 0.15}
"""Prior standard deviations of the forces of rudder and elevator per rad, relative to the slopes of
sideslip and angle of attack: a rudder turns two thirds of the fin that makes most of the side
force, an elevator half of a tail that makes a fifth of the lift. Inputs in other units than rad do
less per unit."""

KINEMATIC_SIGMA = 0.2
"""Prior standard deviation of what the kinematics of the flow angles miss. Of the constants, rad/s:
a bias of the accelerometer of a tenth of gravity at 5 m/s. Of ``betadot/p``, rad: the angle between
the roll axis and the flow without lift."""

TAIL_TIME = 0.1
"""Prior standard deviation of ``ay/p`` and ``ay/r`` relative to ``ay/beta``, s: a rate of turn
changes the sideslip of the fin by its arm over the airspeed."""

RESUMED_CHANGE = 0.2
"""Change of a coefficient between two flights that is nothing unusual, relative to its value:
other load, air density, battery, a repair. The prior is never forgotten, so it must not claim
more than this."""


@dataclass(frozen=True)
class Start:
    """Where an estimator starts.

    Parameters
    ----------
    values : (R, n) array
        Initial coefficients, SI.
    sigma : (R, n) array
        Their standard deviations; 0 where not free.
    free : (R, n) bool array
        Coefficients that move.
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
        """Coefficients of which something was known before the flight, shape (R, n).

        Of the force rows something is known of any aircraft: lift is weight, and how much of it
        surfaces and fins make. Of the others, only what somebody has told or a flight before.
        """
        known = self.informative(structure)
        forces = [flow.force for flow in structure.flow]
        known[forces] = self.free[forces]
        return known

    def informative(self, structure: Structure) -> BoolArray:
        """Coefficients that somebody has told, or a flight before, shape (R, n)."""
        return np.asarray(self.free & (self.sigma < weak_sigma(structure)))

    def weakened(self, structure: Structure, which: BoolArray | None = None) -> Start:
        """Return the start without what was told of some coefficients (R, n), of all if left out.

        Their values are a place to start from, no more.
        """
        weak = self.informative(structure) if which is None else self.informative(structure) & which
        return replace(self, sigma=np.where(weak, weak_sigma(structure), self.sigma))

    def inputs_known(self, t_ratio: float) -> bool:
        """Whether each moment row starts with a control derivative of so many sigmas."""
        moments = np.s_[: len(ROWS), INPUT_COLUMNS]
        size = np.abs(self.values[moments])
        return bool(((size > 0.0) & (size >= t_ratio * self.sigma[moments])).any(axis=1).all())


def first_values(structure: Structure) -> FloatArray:
    """Values of unknown coefficients, shape (R, n), SI: zero but for the slopes of the forces."""
    values = np.zeros(structure.mask.shape)
    for flow, slope in zip(structure.flow, (SIDE_FORCE_SLOPE, LIFT_SLOPE), strict=False):
        values[flow.force, flow.angle] = slope
    return values


def slope_bounds(structure: Structure) -> FloatArray:
    """Largest values of the coefficients, shape (R, n): a force opposes its flow angle.

    What is divided by must not vanish: a tenth of where the side force starts is less than any
    aircraft has, and lift holds it in level flight.
    """
    bounds = np.full(structure.mask.shape, np.inf)
    largest = 0.1 * SIDE_FORCE_SLOPE, -GRAVITY / LARGEST_LIFT_ANGLE
    for flow, slope in zip(structure.flow, largest, strict=False):
        bounds[flow.force, flow.angle] = slope
    return bounds


def physical_bounds(structure: Structure, free: BoolArray) -> FloatArray:
    """Largest values that an aircraft has, shape (R, n): its forces and rates damp themselves.

    With positive damping, as late inputs or an autopilot's answers feign it, a model grows by e in
    a fraction of a second. Beside a measured force, if `free` (R, n) has one, nothing is known of
    it: the force has a share of the damping.
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
    """Return the start of an aircraft without an accelerometer: its flow is not observed.

    No moment depends on the flow angles then, and what makes the forces stays unknown.
    """
    moments = np.s_[: len(ROWS), LAST_COLUMNS]
    values, sigma, free = start.values.copy(), start.sigma.copy(), start.free.copy()
    values[moments] = sigma[moments] = 0.0
    free[moments] = free[len(ROWS) :] = False
    values[len(ROWS) :] = first_values(structure)[len(ROWS) :]
    return Start(values, sigma, free)


def resumed(saved: CoefficientSet) -> CoefficientSet:
    """Coefficients of an earlier flight as the start of the next: the values, trusted less.

    The sigma of the file holds for the flight that it was learned in: another one is sure to lie
    within `SURE` of it. To that comes a change by `RESUMED_CHANGE` between the flights. So a
    t-ratio is never above five at the start, and a second of excitation outweighs what was saved.
    """
    change = RESUMED_CHANGE * np.abs(saved.values)
    sigma = np.where(saved.sigma > 0.0, np.hypot(SURE * saved.sigma, change), 0.0)
    return replace(saved, sigma=sigma)


def start_from(settings: Settings, initial: CoefficientSet | None = None) -> Start:
    """Gather the prior knowledge.

    Parameters
    ----------
    settings : Settings
        Initial values, fixed coefficients, known inertias.
    initial : CoefficientSet, optional
        Coefficients from a file; they win over the values in the settings.

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
        # Trim, balance and the biases of the sensors differ from flight to flight: the constants
        # of another flight are a place to start from, no more.
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
