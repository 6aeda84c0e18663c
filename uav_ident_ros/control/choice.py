# SPDX-License-Identifier: Apache-2.0
"""Whose control derivatives to fly on, axis by axis: identified, last good or nominal.

Three things keep a row of the newest set from being adopted, and the axis stays with what it has:

- the identifier's own word: the set is stale, or its verdict is against it, or the main
  derivative of the row is not known;
- it cannot be flown: next to nothing moves the axis, or many times more than the nominal set says;
- it contradicts what the flight shows (`Effectiveness`): it would turn the sign of the axis, or
  undo a change of its effect that was measured.

A row takes seconds to be learned anew after a fault. Until then its main derivative is multiplied
by what is measured: by the factor nearest to the present one that lies within one sigma.
"""

from dataclasses import dataclass

import numpy as np

from uav_ident_ros.client import AttitudeModel, Coefficients, CoefficientSource
from uav_ident_ros.control.allocation import authority
from uav_ident_ros.control.effectiveness import Effectiveness
from uav_ident_ros.identification.structure import INPUT_COLUMNS, ROWS, BoolArray, FloatArray

FLYABLE = (0.02, 10.0)
"""Least and largest authority of an axis over the nominal one that is adopted. The least lies below
what a surface's neighbours do: of the c172p's roll the rudder has a tenth, so that a lost
aileron is adopted as what it is."""

MEASURED_RANGE = (0.5, 2.0)
"""Factors that are flown: a loop with a gain margin of two stands one that is wrong by that."""

TOLD = 0.2
"""Change of the effect from which on it is told, and an identified row has to agree with it."""

MAIN = {"pdot": 2, "qdot": 0, "rdot": 1}
"""Column of the main input of each axis: da, de, dr."""

IDENTIFIED, LAST_GOOD, NOMINAL, MEASURED = "identified", "last good", "nominal", "measured"


@dataclass(frozen=True, eq=False)
class Effect:
    """Control derivatives to fly on."""

    values: FloatArray  # (3, 4) B, rad/s^2 per unit of de, dr, da, dth
    # (3, 4) The same without the factors that are measured
    base: FloatArray
    # (3,) Of each row: ``identified``, ``last good``, ``nominal`` or ``measured`` (its sign turned
    # or its size changed by what the flight shows)
    sources: tuple[str, ...]
    reasons: tuple[str, ...]  # (3,) Why it is not the newest identified one; empty if it is


def control_derivatives(coefficients: Coefficients | AttitudeModel) -> tuple[FloatArray, BoolArray]:
    """Return B and which of its entries are known, shapes (3, 4)."""
    rows = slice(0, len(ROWS))
    return coefficients.values[rows, INPUT_COLUMNS], coefficients.known[rows, INPUT_COLUMNS]


class AxisChoice:
    """Keeps the control derivatives in use.

    Parameters
    ----------
    source : CoefficientSource
        Has the identified sets; its fallback does not matter here.
    nominal : Coefficients
        The author's own set, to start with.
    limits : (2, 4) array
        Of the inputs.
    adaptive : bool
        Whether to leave the nominal set at all.
    """

    def __init__(
        self,
        source: CoefficientSource,
        nominal: Coefficients,
        limits: FloatArray,
        adaptive: bool = True,
    ) -> None:
        self._source, self._limits, self._adaptive = source, limits, adaptive
        self._base = control_derivatives(nominal)[0].copy()
        self._factor = np.ones(len(ROWS))
        self._nominal_authority = authority(self._base, limits)
        self._sources = [NOMINAL] * len(ROWS)
        self._seen: Coefficients | None = None
        self._reasons = [""] * len(ROWS)

    @property
    def scale(self) -> FloatArray:
        """Worth of each axis for `allocate`: its nominal authority, rad/s^2."""
        return self._nominal_authority

    def update(self, t_ns: int, measured: Effectiveness) -> Effect:
        """Return what to fly on at message time `t_ns`.

        Parameters
        ----------
        t_ns : int
            Now, ns.
        measured : Effectiveness
            Measured with the values in use; told of those that change their sign.
        """
        if self._adaptive:
            self._adopt(t_ns, measured)
            self._turn(measured)
            self._scale(measured)
        values, axes = self._base.copy(), range(len(ROWS))
        values[axes, [MAIN[row] for row in ROWS]] *= self._factor
        sources = tuple(
            MEASURED if self._rescaled(i) else source for i, source in enumerate(self._sources)
        )
        return Effect(values, self._base.copy(), sources, tuple(self._reasons))

    def forget_measured(self) -> None:
        """Go back to the effects without factors: they were measured with a wrong delay."""
        self._factor[:] = 1.0

    def _adopt(self, t_ns: int, measured: Effectiveness) -> None:
        newest = self._source.newest(t_ns)
        old = newest is None or newest is self._seen
        self._seen = newest
        found, known = (None, None) if newest is None else control_derivatives(newest)
        for i in range(len(ROWS)):
            reason = self._source.refusal(t_ns, i)
            if not reason:
                if old:
                    continue  # it was weighed when it came
                assert found is not None and known is not None
                row = np.where(known[i], found[i], self._base[i])
                reason = self._against(i, row, bool(known[i, MAIN[ROWS[i]]]), measured)
                if not reason:
                    if abs(self._share(i, row) - 1.0) > TOLD:
                        measured.changed(i)
                        self._factor[i] = 1.0
                    self._base[i], self._sources[i] = row, IDENTIFIED
            if reason and self._sources[i] == IDENTIFIED:
                self._sources[i] = LAST_GOOD
            self._reasons[i] = reason

    def _share(self, i: int, row: FloatArray) -> float:
        """Return the main derivative of a row over the one in use, without its factor."""
        main = MAIN[ROWS[i]]
        return float(row[main] / self._base[i, main]) if self._base[i, main] else 1.0

    def _rescaled(self, i: int) -> bool:
        return bool(abs(self._factor[i] - 1.0) > TOLD)

    def _against(self, i: int, found: FloatArray, known: bool, measured: Effectiveness) -> str:
        """Why a row is not adopted; empty if it is."""
        row = ROWS[i]
        if not known:
            return f"the main derivative of {row} is not known"
        share = authority(found[None], self._limits)[0] / self._nominal_authority[i]
        if not FLYABLE[0] <= share <= FLYABLE[1]:
            return f"{row} would have {share:.2g} times its nominal authority"
        share = self._share(i, found)
        if share < 0.0 and not measured.reversed[i]:
            return f"{row} would turn its sign, which the flight does not show"
        if self._rescaled(i) and abs(share / self._factor[i] - 1.0) > 2.0 * TOLD:
            return f"{row} is measured to have {self._factor[i]:.2f} times its effect"
        return ""

    def _turn(self, measured: Effectiveness) -> None:
        """Turn the sign of an axis that answers the wrong way."""
        for i in np.flatnonzero(measured.reversed):
            self._base[i] = -self._base[i]
            self._factor[i], self._sources[i] = 1.0, MEASURED
            measured.changed(int(i))

    def _scale(self, measured: Effectiveness) -> None:
        """Bring the factors within a sigma of what is measured."""
        within = np.clip(self._factor, measured.least, measured.most)
        self._factor = np.clip(within, *MEASURED_RANGE)
