# SPDX-License-Identifier: Apache-2.0
"""Selection of the control derivatives of each axis: identified, last good, nominal or measured.

A row of the newest identified set is not adopted, and the axis keeps its present row, if

- the set is stale, its verdict is not usable, or the main derivative of the row is not known;
- the authority of the axis would be far below or above the nominal one (`FLYABLE`);
- the row contradicts the measured control effectiveness (`Effectiveness`): it reverses the sign of
  the axis, or undoes a measured change of its effect.

After a fault, the identifier needs seconds to learn a row anew. Until then the measured main
derivative is used, if it has differed significantly for longer than the filter keeps a gust.
"""

from dataclasses import dataclass, replace

import numpy as np

from uav_ident_ros.client import AttitudeModel, Coefficients, CoefficientSource
from uav_ident_ros.control.allocation import MAIN_EFFECTS, authority
from uav_ident_ros.control.effectiveness import CORRELATION, Effectiveness
from uav_ident_ros.identification.samples import NS, NS_PER_S
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    INPUTS,
    MAIN_PLACES,
    ROWS,
    BoolArray,
    FloatArray,
)

FLYABLE = (0.02, 10.0)
"""Least and largest authority, over the nominal one, at which a row is adopted. The least lies
below the effect of the other surfaces: the c172p's rudder has a tenth of its roll authority, so
that a lost aileron is adopted."""

MEASURED_RANGE = (0.5, 2.0)
"""Range of the measured factor in use: a loop with a gain margin of two tolerates such an error."""

NOTICEABLE = 0.2
"""Change of the effect from which it is reported, and an identified row must agree with it."""

SIGMAS = 3.0
"""Standard deviations by which the measured effect must differ from the one in use, during all of
`CORRELATION`, before it replaces it."""

FADING = 3.0
"""Time in which the standard deviation of the effect in use doubles, s. A gust that imitates a
change of effect is seldom as significant a second time."""

IDENTIFIED, LAST_GOOD, NOMINAL, MEASURED = "identified", "last good", "nominal", "measured"


@dataclass(frozen=True, eq=False)
class Effect:
    """Control derivatives in use."""

    values: FloatArray  # (3, 4) B, rad/s^2 per unit of de, dr, da, dth
    share: FloatArray  # (3,) Main derivatives of roll, pitch, yaw over the nominal ones
    # (3,) Source of each row: ``identified``, ``last good``, ``nominal`` or ``measured`` (the sign
    # or the size of its main derivative is a measured one)
    sources: tuple[str, ...]
    reasons: tuple[str, ...]  # (3,) Why a row is not the newest identified one; empty if it is


def control_derivatives(coefficients: Coefficients | AttitudeModel) -> tuple[FloatArray, BoolArray]:
    """Return B and the mask of its known entries, shapes (3, 4)."""
    rows = slice(0, len(ROWS))
    return coefficients.values[rows, INPUT_COLUMNS], coefficients.known[rows, INPUT_COLUMNS]


class AxisChoice:
    """Selects the control derivatives in use, axis by axis."""

    def __init__(
        self,
        source: CoefficientSource,  # Source of the identified sets; its fallback is not used
        nominal: Coefficients,  # The author's own set, in use at the start
        limits: FloatArray,  # (2, 4) Limits of the inputs
        adaptive: bool = True,  # Whether to use anything but the nominal set
    ) -> None:
        self._source, self._limits, self._adaptive = source, limits, adaptive
        self.nominal = control_derivatives(nominal)[0]  # (3, 4)
        self._rows = self.nominal.copy()  # rows adopted, and the main derivatives in use
        self._main = self._rows[MAIN_EFFECTS]
        # sigma of a measured main derivative over the nominal one, and its message time, ns
        self._sigma, self._measured_ns = np.zeros(len(ROWS)), np.zeros(len(ROWS), dtype=np.int64)
        # (3,) Nominal authority of each axis, rad/s^2, the scale of `allocate`
        self.scale = authority(self.nominal, limits)
        # Model of the motion without inputs, for `Response`: all estimates of the rows in use, even
        # uncertain ones, since zero would be a larger error
        self.model = AttitudeModel(nominal.structure, nominal.values, nominal.structure.mask)
        self._agreed_ns = np.full(len(ROWS), np.iinfo(np.int64).max)
        self._sources = [NOMINAL] * len(ROWS)
        # Inputs whose sign is reversed, on every axis, until their own axis is learned anew
        self._inverted = np.zeros(len(INPUTS), dtype=bool)
        self._seen: Coefficients | None = None
        self._reasons = [""] * len(ROWS)

    def update(
        self,
        t_ns: int,
        # Relative to the nominal values; restarted for an axis whose sign is reversed
        measured: Effectiveness,
    ) -> Effect:
        """Return the control derivatives to use at message time `t_ns`, ns."""
        if self._adaptive:
            # without roll control the linear model does not hold for pitch and yaw
            certain = (np.arange(len(ROWS)) == 0) | ~measured.dead[0]
            self._adopt(t_ns, measured)
            self._invert_signs(measured, certain)
            self._scale(t_ns, measured, certain)
        values = self._rows.copy()
        values[MAIN_EFFECTS] = self._main
        rescaled = zip(self._rescaled.tolist(), self._sources, strict=True)
        sources = tuple(MEASURED if other else source for other, source in rescaled)
        share = _quotient(self._main, self.nominal[MAIN_EFFECTS])
        return Effect(values, share, sources, (*self._reasons,))

    @property
    def measured_by(self) -> FloatArray:
        """Reference B of the measurement, (3, 4): nominal main derivatives, adopted cross ones."""
        values = self._rows.copy()
        values[MAIN_EFFECTS] = self.nominal[MAIN_EFFECTS]
        return values

    def discard_measured(self) -> None:
        """Return to the adopted main derivatives, after a measurement with a wrong delay."""
        self._main = self._rows[MAIN_EFFECTS]

    def _adopt(self, t_ns: int, measured: Effectiveness) -> None:
        newest = self._source.newest(t_ns)
        fresh = None if newest is self._seen else newest  # each set is judged once
        self._seen = newest
        adopted = []
        for i in range(len(ROWS)):
            reason = self._source.refusal(t_ns, i)
            if not reason:
                if fresh is None:
                    continue
                found, known = control_derivatives(fresh)
                row = np.where(known[i] & ~self._inverted, found[i], self._rows[i])
                row[MAIN_PLACES[i]] = found[i, MAIN_PLACES[i]]
                reason = self._rejection(i, row, bool(known[i, MAIN_PLACES[i]]), measured)
                if not reason:
                    self._rows[i], self._main[i] = row, row[MAIN_PLACES[i]]
                    self._sources[i], self._inverted[MAIN_PLACES[i]] = IDENTIFIED, False
                    adopted.append(i)
            if reason and self._sources[i] == IDENTIFIED:
                self._sources[i] = LAST_GOOD
            self._reasons[i] = reason
        if fresh is not None:
            self._follow(fresh, adopted)

    def _follow(self, newest: Coefficients, adopted: list[int]) -> None:
        """Copy the adopted rows, and the rows of the specific forces, to the model."""
        if newest.structure.name != self.model.structure.name:
            self.model = AttitudeModel(newest.structure, newest.values, newest.known)
        values = self.model.values.copy()
        if adopted:
            rows = [*adopted, *range(len(ROWS), len(values))]
            values[rows] = newest.values[rows]
        self.model = replace(self.model, values=values, flow=newest.flow)

    @property
    def _flown(self) -> FloatArray:
        """Main derivatives in use over the adopted ones, (3,): 1 unless a measured one is used."""
        return _quotient(self._main, self._rows[MAIN_EFFECTS])

    @property
    def _rescaled(self) -> BoolArray:
        return np.asarray(np.abs(self._flown - 1.0) > NOTICEABLE)

    def _rejection(self, i: int, found: FloatArray, known: bool, measured: Effectiveness) -> str:
        """Return the reason not to adopt a row; empty if there is none."""
        row = ROWS[i]
        if not known:
            return f"the main derivative of {row} is not known"
        share = authority(found[None], self._limits)[0] / self.scale[i]
        if not FLYABLE[0] <= share <= FLYABLE[1]:
            return f"{row} would have {share:.2g} times its nominal authority"
        share = float(_quotient(found[MAIN_PLACES[i]], self._main[i]))
        if share < 0.0 and not measured.reversed[i]:
            return f"{row} would turn its sign, which the flight does not show"
        if self._rescaled[i] and abs(share - 1.0) > 2.0 * NOTICEABLE:
            return f"{row} is measured to have {self._flown[i]:.2f} times its effect"
        return ""

    def _invert_signs(self, measured: Effectiveness, certain: BoolArray) -> None:
        """Reverse the sign of an input that acts the wrong way, on all axes."""
        for i in np.flatnonzero(measured.reversed & certain):
            self._invert_axis(i, MEASURED)
            measured.changed(int(i))
        # A jamming surface causes one jerk of the wrong sign, but a surface without effect has no
        # sign. With the former sign the loop is right when it comes free.
        for i in np.flatnonzero(measured.dead & self._inverted[MAIN_PLACES] & certain):
            self._invert_axis(i, LAST_GOOD)

    def _invert_axis(self, i: np.intp, source: str) -> None:
        """Reverse the sign of the input of an axis."""
        self._rows[:, MAIN_PLACES[i]] = -self._rows[:, MAIN_PLACES[i]]
        self._inverted[MAIN_PLACES[i]] = not self._inverted[MAIN_PLACES[i]]
        self._main[i], self._sources[i] = self._rows[i, MAIN_PLACES[i]], source

    def _scale(self, t_ns: int, measured: Effectiveness, certain: BoolArray) -> None:
        """Use the measured main derivative where it has differed significantly for long enough."""
        nominal, rows = self.nominal[MAIN_EFFECTS], self._rows[MAIN_EFFECTS]
        size = np.abs(nominal)
        # faults reduce the effect: an increase needs twice the significance
        twice = 2.0 * SIGMAS
        # too small an effect in use makes the loop oscillate, which the moved inputs reveal
        shown = (measured.moved - twice * measured.moved_sigma) * size
        rings = (self._flown < 1.0) & (np.abs(self._main) < shown)
        found = measured.factor * nominal
        more = np.abs(found) > np.maximum(np.abs(self._main), size)
        least = np.where(more, twice, SIGMAS) * measured.sigma * size
        away = (np.abs(found - self._main) > least) | rings
        self._agreed_ns = np.where(away & certain, self._agreed_ns, t_ns)
        # without flow angles in the model, their effect would be attributed to the inputs
        can = certain & self.model.structure.has_flow
        significant = can & (t_ns - self._agreed_ns > CORRELATION * NS_PER_S)
        # after a significant change, the measurement with the smallest sigma is used
        faded = self._sigma * (1.0 + np.maximum(t_ns - self._measured_ns, 0) * NS / FADING)
        refined = can & ~significant & self._rescaled & (measured.since_sigma <= faded)
        measured.begin(significant)
        found = np.where(rings, rows, np.where(significant, found, measured.since * nominal))
        least, most = np.multiply.outer(MEASURED_RANGE, np.abs(rows))
        least = np.minimum(least, MEASURED_RANGE[0] * size)
        found = np.sign(rows) * np.clip(np.sign(rows) * found, least, most)
        taken = significant | refined
        self._main = np.where(taken, found, self._main)
        sigma = np.where(significant, measured.sigma, measured.since_sigma)
        self._sigma = np.where(taken, sigma, self._sigma)
        self._measured_ns = np.where(taken, t_ns, self._measured_ns)


def _quotient(values: FloatArray, of: FloatArray) -> FloatArray:
    """Return the quotient of two arrays; 1 where the divisor is zero."""
    return np.asarray(np.where(of != 0.0, values / np.where(of != 0.0, of, 1.0), 1.0))
