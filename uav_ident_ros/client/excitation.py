# SPDX-License-Identifier: Apache-2.0
"""Excitation for a controller to add to its inputs, with a timeout."""

import numpy as np

from uav_ident_ros.client.source import History
from uav_ident_ros.identification.samples import NS_PER_S
from uav_ident_ros.identification.settings import EXCITATION_TIMEOUT
from uav_ident_ros.identification.structure import INPUTS, FloatArray


class Excitation:
    """The excitation requested on ``~/excitation``.

    A value holds from its stamp until the next one's. Without messages for `EXCITATION_TIMEOUT`
    the excitation is zero, in case the identifier has ended.

    Parameters
    ----------
    limit : (4,) array-like
        Largest magnitude of de, dr, da, dth that is ever added, in their units.

    Examples
    --------
    >>> excitation = Excitation(limit=[0.05, 0.05, 0.05, 0.0])
    >>> excitation.add(1_000_000_000, ["de", "da"], [0.02, 0.08])
    >>> excitation.at(1_010_000_000).tolist()
    [0.02, 0.0, 0.05, 0.0]
    >>> excitation.at(1_400_000_000).tolist()
    [0.0, 0.0, 0.0, 0.0]
    """

    def __init__(self, limit: FloatArray | list[float]) -> None:
        self._limit = np.asarray(limit, dtype=np.float64)
        self._requests: History[tuple[int, FloatArray]] = History()

    def add(self, t_ns: int, names: list[str], values: list[float]) -> None:
        """Add a message: its stamp, ns, and values by the name of the input.

        It cancels requests with later stamps. An invalid message (an unknown name, a value that is
        not finite) sets the excitation to zero from its stamp on.
        """
        requested = np.zeros(len(INPUTS))
        good = len(names) == len(values) and set(names) <= set(INPUTS)
        if good and np.isfinite(values).all():
            requested[[INPUTS.index(name) for name in names]] = values
        self._requests.add(t_ns, (t_ns, np.clip(requested, -self._limit, self._limit)))

    def at(self, t_ns: int) -> FloatArray:
        """Return the excitation of de, dr, da, dth at `t_ns`, in their units."""
        newest = self._requests.at(t_ns)
        if newest is None or t_ns - newest[0] > EXCITATION_TIMEOUT * NS_PER_S:
            return np.zeros(len(INPUTS))
        return newest[1].copy()
