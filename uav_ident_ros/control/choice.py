# SPDX-License-Identifier: Apache-2.0
"""Whose control derivatives to fly on, axis by axis: identified, last good or nominal.

Three things keep a row of the newest set from being adopted, and the axis stays with what it has:

- the identifier's own word: the set is stale, or its verdict is against it, or the main
  derivative of the row is not known;
- it cannot be flown: next to nothing moves the axis, or many times more than the nominal set says;
- it contradicts what the flight shows (`Effectiveness`): it would turn the sign of the axis, or
  undo a change of its effect that was measured.

A row takes seconds to be learned anew after a fault. Until then its main derivative is what is
measured, once that has been surely another for longer than a gust lasts in the filter.
"""

from dataclasses import dataclass, replace

import numpy as np

from uav_ident_ros.client import AttitudeModel, Coefficients, CoefficientSource
from uav_ident_ros.control.allocation import AXES, MAINS, authority
from uav_ident_ros.control.effectiveness import CORRELATION, Effectiveness
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    INPUTS,
    ROWS,
    BoolArray,
    FloatArray,
)

FLYABLE = (0.02, 10.0)
"""Least and largest authority of an axis over the nominal one that is adopted. The least lies below
what a surface's neighbours do: of the c172p's roll the rudder has a tenth, so that a lost
aileron is adopted as what it is."""

MEASURED_RANGE = (0.5, 2.0)
"""Factors that are flown: a loop with a gain margin of two stands one that is wrong by that."""

NOTICEABLE = 0.2
"""Change of the effect from which on it is told, and an identified row has to agree with it."""

SIGMAS = 3.0
"""Standard deviations by which what is measured differs from what is flown on, all through
`CORRELATION`, before it takes its place."""

FADING = 3.0
"""Time in which the standard deviation of what is flown on grows by itself again, s: gusts that
were taken for another effect are seldom as clear a second time."""

IDENTIFIED, LAST_GOOD, NOMINAL, MEASURED = "identified", "last good", "nominal", "measured"


@dataclass(frozen=True, eq=False)
class Effect:
    """Control derivatives to fly on."""

    values: FloatArray  # (3, 4) B, rad/s^2 per unit of de, dr, da, dth
    share: FloatArray  # (3,) Main derivatives of roll, pitch, yaw over the nominal ones
    # (3,) Of each row: ``identified``, ``last good``, ``nominal`` or ``measured`` (its sign turned
    # or its size changed by what the flight shows)
    sources: tuple[str, ...]
    reasons: tuple[str, ...]  # (3,) Why it is not the newest identified one; empty if it is


def control_derivatives(coefficients: Coefficients | AttitudeModel) -> tuple[FloatArray, BoolArray]:
    """Return B and which of its entries are known, shapes (3, 4)."""
    rows = slice(0, len(ROWS))
    return coefficients.values[rows, INPUT_COLUMNS], coefficients.known[rows, INPUT_COLUMNS]


class AxisChoice:
    """Keeps the control derivatives in use."""

    def __init__(
        self,
        source: CoefficientSource,  # Has the identified sets; its fallback does not matter here
        nominal: Coefficients,  # The author's own set, to start with
        limits: FloatArray,  # (2, 4) Of the inputs
        adaptive: bool = True,  # Whether to leave the nominal set at all
    ) -> None:
        self._source, self._limits, self._adaptive = source, limits, adaptive
        self.nominal = control_derivatives(nominal)[0]  # (3, 4)
        self._rows = self.nominal.copy()  # those adopted; their main derivatives as flown on:
        self._main = self._rows[AXES, MAINS]
        # of those that are measured, over the nominal ones, and when it was found, ns
        self._sigma, self._measured_ns = np.zeros(len(ROWS)), np.zeros(len(ROWS), dtype=np.int64)
        # (3,) Worth of each axis for `allocate`: its nominal authority, rad/s^2
        self.scale = authority(self.nominal, limits)
        # What the aircraft does by itself, for `Response`: every estimate of the rows in use,
        # however uncertain, as a coefficient that is left out is wrong for sure
        self.model = AttitudeModel(nominal.structure, nominal.values, nominal.structure.mask)
        self._agreed_ns = np.full(len(ROWS), np.iinfo(np.int64).max)
        self._sources = [NOMINAL] * len(ROWS)
        # Inputs that were turned, until their own axes are learned anew: turned for the others, too
        self._turned = np.zeros(len(INPUTS), dtype=bool)
        self._seen: Coefficients | None = None
        self._reasons = [""] * len(ROWS)

    def update(
        self,
        t_ns: int,
        # Measured with the nominal values; told of those that change their sign
        measured: Effectiveness,
    ) -> Effect:
        """Return what to fly on at message time `t_ns`, ns."""
        if self._adaptive:
            # an aircraft that rolls on and on moves its other axes as no linear model tells
            certain = (np.arange(len(ROWS)) == 0) | ~measured.dead[0]
            self._adopt(t_ns, measured)
            self._turn(measured, certain)
            self._scale(t_ns, measured, certain)
        values = self._rows.copy()
        values[AXES, MAINS] = self._main
        rescaled = zip(self._rescaled.tolist(), self._sources, strict=True)
        sources = tuple(MEASURED if other else source for other, source in rescaled)
        share = _over(self._main, self.nominal[AXES, MAINS])
        return Effect(values, share, sources, (*self._reasons,))

    @property
    def measured_by(self) -> FloatArray:
        """B to measure with, (3, 4): each axis's own input as nominal, the others as adopted."""
        values = self._rows.copy()
        values[AXES, MAINS] = self.nominal[AXES, MAINS]
        return values

    def forget_measured(self) -> None:
        """Go back to the rows as adopted: what was measured was measured with a wrong delay."""
        self._main = self._rows[AXES, MAINS]

    def _adopt(self, t_ns: int, measured: Effectiveness) -> None:
        newest = self._source.newest(t_ns)
        fresh = None if newest is self._seen else newest  # any other was weighed when it came
        self._seen = newest
        adopted = []
        for i in range(len(ROWS)):
            reason = self._source.refusal(t_ns, i)
            if not reason:
                if fresh is None:
                    continue
                found, known = control_derivatives(fresh)
                row = np.where(known[i] & ~self._turned, found[i], self._rows[i])
                row[MAINS[i]] = found[i, MAINS[i]]
                reason = self._against(i, row, bool(known[i, MAINS[i]]), measured)
                if not reason:
                    self._rows[i], self._main[i] = row, row[MAINS[i]]
                    self._sources[i], self._turned[MAINS[i]] = IDENTIFIED, False
                    adopted.append(i)
            if reason and self._sources[i] == IDENTIFIED:
                self._sources[i] = LAST_GOOD
            self._reasons[i] = reason
        if fresh is not None:
            self._follow(fresh, adopted)

    def _follow(self, newest: Coefficients, adopted: list[int]) -> None:
        """Let the model have the rows that were adopted, with the forces that go with them."""
        if newest.structure.name != self.model.structure.name:
            self.model = AttitudeModel(newest.structure, newest.values, newest.known)
        values = self.model.values.copy()
        if adopted:
            rows = [*adopted, *range(len(ROWS), len(values))]
            values[rows] = newest.values[rows]
        self.model = replace(self.model, values=values, flow=newest.flow)

    @property
    def _flown(self) -> FloatArray:
        """Main derivatives flown on over those adopted, (3,): 1 where nothing else was measured."""
        return _over(self._main, self._rows[AXES, MAINS])

    @property
    def _rescaled(self) -> BoolArray:
        return np.asarray(np.abs(self._flown - 1.0) > NOTICEABLE)

    def _against(self, i: int, found: FloatArray, known: bool, measured: Effectiveness) -> str:
        """Why a row is not adopted; empty if it is."""
        row = ROWS[i]
        if not known:
            return f"the main derivative of {row} is not known"
        share = authority(found[None], self._limits)[0] / self.scale[i]
        if not FLYABLE[0] <= share <= FLYABLE[1]:
            return f"{row} would have {share:.2g} times its nominal authority"
        share = float(_over(found[MAINS[i]], self._main[i]))
        if share < 0.0 and not measured.reversed[i]:
            return f"{row} would turn its sign, which the flight does not show"
        if self._rescaled[i] and abs(share - 1.0) > 2.0 * NOTICEABLE:
            return f"{row} is measured to have {self._flown[i]:.2f} times its effect"
        return ""

    def _turn(self, measured: Effectiveness, certain: BoolArray) -> None:
        """Turn the sign of an input that acts the wrong way, on all that it moves."""
        for i in np.flatnonzero(measured.reversed & certain):
            self._turn_axis(i, MEASURED)
            measured.changed(int(i))
        # What does nothing has no sign: a surface that jams makes one jerk the wrong way. With the
        # sign of before the loop is right when it comes free.
        for i in np.flatnonzero(measured.dead & self._turned[MAINS] & certain):
            self._turn_axis(i, LAST_GOOD)

    def _turn_axis(self, i: np.intp, source: str) -> None:
        """Turn the sign of the input of an axis; twice is as before."""
        self._rows[:, MAINS[i]] = -self._rows[:, MAINS[i]]
        self._turned[MAINS[i]] = not self._turned[MAINS[i]]
        self._main[i], self._sources[i] = self._rows[i, MAINS[i]], source

    def _scale(self, t_ns: int, measured: Effectiveness, certain: BoolArray) -> None:
        """Fly on what is measured where it has surely been another for long enough."""
        nominal, rows = self.nominal[AXES, MAINS], self._rows[AXES, MAINS]
        size = np.abs(nominal)
        # what breaks does less: more than believed needs twice the evidence
        twice = 2.0 * SIGMAS
        # a loop that rings on too little believed effect shows it by its own motion
        shown = (measured.moved - twice * measured.moved_sigma) * size
        rings = (self._flown < 1.0) & (np.abs(self._main) < shown)
        found = measured.factor * nominal
        more = np.abs(found) > np.maximum(np.abs(self._main), size)
        least = np.where(more, twice, SIGMAS) * measured.sigma * size
        away = (np.abs(found - self._main) > least) | rings
        self._agreed_ns = np.where(away & certain, self._agreed_ns, t_ns)
        # without flow angles in the model, what they do would be taken for the inputs'
        can = certain & self.model.structure.has_flow
        surely = can & (t_ns - self._agreed_ns > CORRELATION * 1e9)
        # once it is another, the question is how much it is: the surest measurement says it
        faded = self._sigma * (1.0 + np.maximum(t_ns - self._measured_ns, 0) * 1e-9 / FADING)
        surer = can & ~surely & self._rescaled & (measured.since_sigma <= faded)
        measured.begin(surely)
        found = np.where(rings, rows, np.where(surely, found, measured.since * nominal))
        least, most = np.multiply.outer(MEASURED_RANGE, np.abs(rows))
        least = np.minimum(least, MEASURED_RANGE[0] * size)
        found = np.sign(rows) * np.clip(np.sign(rows) * found, least, most)
        taken = surely | surer
        self._main = np.where(taken, found, self._main)
        sigma = np.where(surely, measured.sigma, measured.since_sigma)
        self._sigma = np.where(taken, sigma, self._sigma)
        self._measured_ns = np.where(taken, t_ns, self._measured_ns)


def _over(values: FloatArray, of: FloatArray) -> FloatArray:
    """Return the quotient; 1 where there is nothing to be a share of."""
    return np.asarray(np.where(of != 0.0, values / np.where(of != 0.0, of, 1.0), 1.0))
