# SPDX-License-Identifier: Apache-2.0
"""The derivative as in the paper: backward differences of the rates at the ticks.

Kept to reproduce the paper exactly; at 20 Hz it ruins the estimate even without noise.
"""

from __future__ import annotations

from uav_ident_ros.identification.regression import Regression, without_negligible
from uav_ident_ros.identification.structure import FloatArray, Structure


class BackwardDifference:
    """Regression problem of one sample a tick: ``xdot = (x_k - x_(k-1)) / dt``.

    Parameters
    ----------
    structure : Structure
        The regressors.
    """

    def __init__(self, structure: Structure) -> None:
        self._structure = structure
        self._before: tuple[int, FloatArray] | None = None

    def step(
        self, t_ns: int, x: FloatArray, u: FloatArray, force: FloatArray, dt: float
    ) -> Regression | None:
        """Return the sample of this tick, None at the first one.

        Parameters
        ----------
        t_ns : int
            Time of the tick, ns.
        x : (3,) array
            Rates at the tick, rad/s, FRD.
        u : (4,) array
            Inputs at the tick.
        force : (2,) array
            Specific forces ay, az at the tick, m/s^2.
        dt : float
            Time between ticks, s.
        """
        before, self._before = self._before, (t_ns, x)
        if before is None or (t_ns - before[0]) * 1e-9 > 1.5 * dt:
            return None
        f = without_negligible(self._structure.regressor(x, u, force))[None]
        y = without_negligible((x - before[1]) / dt)[None]
        return Regression.of(y, f, f, dt)
