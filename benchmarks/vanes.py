# SPDX-License-Identifier: Apache-2.0
"""Angle of attack and sideslip as published beside vanes: ``python benchmarks/vanes.py``.

`thor75_flight` has vanes; the identifier never sees them. Correlation over the flight from 30 s on,
in the air, between 0.05 and 3 rad/s: the zero of a vane and its flutter tell nothing.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy loads

import cases
import numpy as np
from free_prediction import RECORDED_SPEED
from scipy.signal import butter, sosfiltfilt

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.identification.structure import FloatArray

FLIGHT = "thor75_flight"
BAND = (0.05, 3.0)
"""Pass band, rad/s."""

FLYING = 10.0
"""Airspeed from which the aircraft is in the air, m/s."""

SETTLED = 30.0
"""Time from which angles count, s."""


def recorded(topic: str, *fields: str) -> FloatArray:
    """Log times, s, and values of a topic, one row a message."""
    with Bag(cases.RECORDED / FLIGHT) as bag:
        decode = bag.decoder(topic)
        rows = []
        for _, log_ns, data in bag.messages((topic,)):
            value = decode(data)
            at = getattr(value, "vector", value)
            rows.append((log_ns * 1e-9, *(getattr(at, field) for field in fields)))
    return np.array(rows)


def main() -> int:
    """Print both correlations."""
    case = cases.load(FLIGHT)
    values = {"structure": "flight_dynamics", "airspeed.reference": RECORDED_SPEED}
    track = cases.identify(case, values)
    assert track.flow is not None
    t = np.asarray(track.t_ns) * 1e-9
    vanes, airspeed = recorded("/vanes", "x", "y"), recorded("/airspeed", "data")
    air = (np.interp(t, *airspeed.T) > FLYING) & (track.time > SETTLED)
    rate = (len(t) - 1) / (t[-1] - t[0])
    band = butter(2, BAND, "bandpass", fs=2.0 * np.pi * rate, output="sos")
    for name, vane, own in (("alpha", 1, 1), ("beta", 2, 0)):
        measured = np.interp(t, vanes[:, 0], vanes[:, vane])
        pair = [sosfiltfilt(band, part)[air] for part in (track.flow.angles[:, own], measured)]
        print(f"{name}: correlation with the vane {np.corrcoef(*pair)[0, 1]:.2f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
