# SPDX-License-Identifier: Apache-2.0
"""What a plant in the loop saw, on disk: one NumPy archive for the benchmarks."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from uav_ident_ros.client.coefficients import Coefficients
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.live import Sample


@dataclass
class FlightRecord:
    """Rows of a flight, as they come.

    In the archive are, one row for each Imu sample, ``time`` (s), ``rates`` (true), ``measured``
    (gyro), ``reference`` (all p, q, r in rad/s, FRD; NaN before the first reference),
    ``attitude`` (roll, pitch, yaw, rad), ``outputs`` and ``surfaces`` (elevator, rudder, aileron
    in rad, throttle), ``excitation`` (de, dr, da, dth that were asked for); one row for each
    estimate that arrived, ``tick`` (s), ``values`` and ``sigma`` (by ``names``), ``fit`` and
    ``usable``.
    """

    samples: list[tuple[Sample, FloatArray, FloatArray, FloatArray]] = field(default_factory=list)
    estimates: list[tuple[float, Coefficients]] = field(default_factory=list)
    lost: float = math.nan

    def add(
        self,
        sample: Sample,
        outputs: FloatArray,
        reference: FloatArray | None,
        excitation: FloatArray,
    ) -> None:
        """Keep a sample, the actuators' answer to it, and what was asked for at that time."""
        wanted = np.full(3, np.nan) if reference is None else reference
        self.samples.append((sample, outputs, wanted, excitation))

    def add_estimate(self, time: float, coefficients: Coefficients) -> None:
        """Keep an estimate of `time` (s)."""
        self.estimates.append((time, coefficients))

    def save(self, path: Path) -> None:
        """Write the archive.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        columns = {
            "time": [s.time for s, *_ in self.samples],
            "rates": [s.rates for s, *_ in self.samples],
            "measured": [s.measured_rates for s, *_ in self.samples],
            "attitude": [s.attitude for s, *_ in self.samples],
            "surfaces": [s.surfaces for s, *_ in self.samples],
            "outputs": [outputs for _, outputs, _, _ in self.samples],
            "reference": [reference for _, _, reference, _ in self.samples],
            "excitation": [excitation for *_, excitation in self.samples],
            "lost": [self.lost],
            "tick": [time for time, _ in self.estimates],
            "usable": [c.usable for _, c in self.estimates],
            "fit": [c.fit for _, c in self.estimates],
            "names": list(self.estimates[0][1].names) if self.estimates else [],
            "values": [c.values[c.structure.mask] for _, c in self.estimates],
            "sigma": [c.sigma[c.structure.mask] for _, c in self.estimates],
        }
        np.savez_compressed(path, **{name: np.array(rows) for name, rows in columns.items()})
