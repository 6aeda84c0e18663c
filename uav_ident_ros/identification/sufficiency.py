# SPDX-License-Identifier: Apache-2.0
"""How much excitation is enough: which coefficients are known, and when the others will be.

Under steady excitation information grows with time: 1 / sigma^2 = I_0 + k t, with what was known
before the run in I_0. So the run itself says when a wanted sigma will be reached.
"""

from __future__ import annotations

import math

import numpy as np

from uav_ident_ros.identification.scales import RESPONSE_TIME, SURE
from uav_ident_ros.identification.structure import (
    FLOW_ANGLES,
    INPUTS,
    RATES,
    ROWS,
    BoolArray,
    FloatArray,
    Structure,
)


class Sufficiency:
    """Follows what a run of excitation teaches.

    A coefficient is known when it, or else the largest of its kind in its row, is the wanted
    number of sigmas: what is next to nothing need not be told from nothing. Of a kind are the
    control derivatives of the excited inputs, the rate derivatives, and those of the flow angles.

    Parameters
    ----------
    structure : Structure
        Names the coefficients.
    excited : tuple of str
        The inputs that are excited.
    wanted : float
        The wanted value over sigma.
    """

    def __init__(self, structure: Structure, excited: tuple[str, ...], wanted: float) -> None:
        self._names = structure.names
        self._free = structure.free
        self._wanted = wanted
        kinds = (excited, RATES, FLOW_ANGLES)
        self._kinds = [
            [
                k
                for k, (i, j) in enumerate(self._free)
                if i == row and structure.regressors[j] in kind
            ]
            for row in range(len(ROWS))
            for kind in kinds
        ]
        self._controls = [
            k for k, (i, j) in enumerate(self._free)
            if i < len(ROWS) and structure.regressors[j] in INPUTS
        ]  # fmt: skip
        self._start: tuple[int, FloatArray] | None = None
        self.unknown: tuple[str, ...] = ()
        """Names of the coefficients that are not known yet."""
        self.time_left = math.inf
        """Time of excitation that the slowest of them still takes, s; inf if it cannot be told."""
        self.effects: dict[str, tuple[str, float, float]] = {}
        """Of every input seen to act: its surest control derivative, value and sigma."""

    def update(self, t_ns: int, coefficients: FloatArray, sigma: FloatArray) -> None:
        """Look at the estimate of a tick.

        Parameters
        ----------
        t_ns : int
            Message time, ns.
        coefficients, sigma : (rows, n) arrays
            The coefficients and their standard deviations.
        """
        rows, columns = np.array(self._free).T
        values, sigmas = np.abs(coefficients[rows, columns]), sigma[rows, columns]
        limits = self._limits(values, sigmas)
        unknown = sigmas > limits
        self.unknown = tuple(name for name, u in zip(self._names, unknown, strict=True) if u)
        self.time_left = self._time_left(t_ns, sigmas, limits, unknown)
        self._see_effects(coefficients, sigma)

    def _limits(self, values: FloatArray, sigmas: FloatArray) -> FloatArray:
        """Sigma from which each coefficient is known; inf for those that nobody asks for."""
        limits = np.full(len(values), math.inf)
        for kind in self._kinds:
            # only what is itself known says how large the others of its kind may be
            sure = [k for k in kind if values[k] >= self._wanted * sigmas[k]]
            scale = max((values[k] for k in sure), default=0.0)
            for k in kind:
                limits[k] = max(values[k], scale) / self._wanted
        return limits

    def _time_left(
        self, t_ns: int, sigmas: FloatArray, limits: FloatArray, unknown: BoolArray
    ) -> float:
        """Seconds until the slowest of the unknown coefficients is known."""
        with np.errstate(divide="ignore"):
            information = 1.0 / np.square(sigmas)
            needed = 1.0 / np.square(limits)
        if self._start is None:
            self._start = t_ns, information
        if not unknown.any():
            return 0.0
        start_ns, before = self._start
        span = (t_ns - start_ns) * 1e-9
        gained = information[unknown] - before[unknown]
        if span < RESPONSE_TIME or (gained <= 0.0).any():
            return math.inf
        return float(((needed - information)[unknown] / gained).max() * span)

    def _see_effects(self, coefficients: FloatArray, sigma: FloatArray) -> None:
        """Note what each input is seen to do."""
        surest: dict[str, float] = {}
        for k in self._controls:
            i, j = self._free[k]
            value, deviation = float(coefficients[i, j]), float(sigma[i, j])
            name = self._names[k].partition("/")[2]
            ratio = abs(value) / deviation if deviation > 0.0 else 0.0
            if ratio > max(surest.get(name, 0.0), SURE):
                surest[name] = ratio
                self.effects[name] = self._names[k], value, deviation
