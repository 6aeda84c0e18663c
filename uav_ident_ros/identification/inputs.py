# SPDX-License-Identifier: Apache-2.0
"""From raw actuator channels to the inputs de, dr, da, dth over the cells of the grid."""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.filters import BlockFilter, DiscreteSystem
from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.settings import ActuatorSettings
from uav_ident_ros.identification.structure import FloatArray


class InputMap:
    """The map u = M (c(raw) - c(trim)), where c is what a channel does.

    A surface does as it is told, ``c = raw``. A motor's thrust grows with the square of its speed:
    with its share f of the square, and s = scale raw from 0 to 1, ``scale c = f s^2 + (1 - f) s``.
    What it moves is then the same at any thrust.

    Parameters
    ----------
    settings : ActuatorSettings
        Mixing rows, scale, thrust curve and trim of the N channels.
    """

    def __init__(self, settings: ActuatorSettings) -> None:
        n = len(settings.channels)
        mixing = settings.mixing
        scale = np.array(settings.scale or (1.0,) * n)
        self._square: FloatArray = np.array(settings.thrust_curve or (0.0,) * n)
        self._bent = bool(self._square.any())
        self._scale = scale
        self.matrix: FloatArray = np.array([mixing.de, mixing.dr, mixing.da, mixing.dth]) * scale
        self.trim: FloatArray = np.array(settings.trim or (0.0,) * n)

    def apply(self, raw: FloatArray) -> FloatArray:
        """Return inputs of shape (..., 4) from raw channels of shape (..., N)."""
        return self.mix(self.curved(raw))

    def curved(self, raw: FloatArray) -> FloatArray:
        """Return what channels of shape (..., N) do, in their own units."""
        if not self._bent:
            return raw
        return np.asarray(raw * (1.0 + self._square * (self._scale * raw - 1.0)))

    def mix(self, curved: FloatArray) -> FloatArray:
        """Return inputs of shape (..., 4) from what channels do, or their means over a time."""
        return np.asarray((curved - self.curved(self.trim)) @ self.matrix.T)


class ServoLag:
    """First-order lag between the commanded and the actual deflection.

    Parameters
    ----------
    time_constant : float
        Lag, s; 0 for none.
    h : float
        Cell width, s.
    """

    def __init__(self, time_constant: float, h: float) -> None:
        self._ratio = time_constant / h
        self._filter: BlockFilter | None = None
        if time_constant > 0.0:
            a = np.array([[-1.0 / time_constant]])
            b = np.array([1.0 / time_constant])
            self._filter = BlockFilter(DiscreteSystem.from_continuous(a, b, h), 4)

    def apply(self, u: FloatArray, *, restarted: bool) -> FloatArray:
        """Cell means of the deflection from cell means of the command, shape (m, 4).

        Restarted, it begins in equilibrium at the first of them.
        """
        if self._filter is None:
            return u
        if restarted:
            self._filter.state = u[:1].copy()
        before = self._filter.state
        after = self._filter.apply(np.zeros((len(u) + 1, u.shape[1])), u)[0]
        start = np.concatenate([before, after[:-1]])
        # The lag's own equation integrated over the cell: mean = u - T (s1 - s0) / h.
        return np.asarray(u - self._ratio * (after - start))


def cell_means(
    t_ns: TimeArray, u: FloatArray, edges_ns: TimeArray, interpolation: str
) -> FloatArray:
    """Exact means of a sampled input over cells.

    With the input held, its mean over a cell is what a plant driven by the held input sees;
    sampling it at the cell's end instead is half a sample off.

    Parameters
    ----------
    t_ns : (k,) int array
        Stamps of the input's samples, ns; the first is at or before the first edge.
    u : (k, N) array
        Values; each applies from its stamp on.
    edges_ns : (m + 1,) int array
        Edges of the cells, ns, already shifted by the delay.
    interpolation : str
        ``hold`` or ``linear``; after the last sample the input is held.

    Returns
    -------
    (m, N) array
        Mean over each cell.
    """
    last = t_ns.searchsorted(edges_ns, side="right") - 1
    since = (edges_ns - t_ns.take(last))[:, None]
    width = (t_ns[1:] - t_ns[:-1])[:, None]
    integral = np.zeros(u.shape)
    if interpolation == "linear":
        slope = np.zeros_like(u)
        slope[:-1] = (u[1:] - u[:-1]) / width
        np.add.accumulate((u[:-1] + 0.5 * slope[:-1] * width) * width, out=integral[1:])
        at_edges = integral[last] + (u[last] + 0.5 * slope[last] * since) * since
    else:
        np.add.accumulate(u[:-1] * width, out=integral[1:])
        at_edges = integral.take(last, axis=0) + u.take(last, axis=0) * since
    return np.asarray((at_edges[1:] - at_edges[:-1]) / (edges_ns[1:] - edges_ns[:-1])[:, None])
