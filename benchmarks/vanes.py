# SPDX-License-Identifier: Apache-2.0
"""Published angle of attack and sideslip beside vanes: ``python benchmarks/vanes.py``.

`thor75_flight` has vanes, which the identifier does not use. Printed is the correlation in the air
from 30 s on, between 0.05 and 3 rad/s, without the vanes' offset and flutter. The airspeed is that
of the bag, then a constant one. Below each is the limit for any coefficients: of the force alone,
and of the force with the surface's part fitted to the vane.
"""

import cases
import numpy as np
from scipy.signal import butter, sosfiltfilt

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.identification.sampling import InputMap
from uav_ident_ros.identification.structure import INPUTS, FloatArray

FLIGHT = "thor75_flight"
BAND = (0.05, 3.0)
"""Pass band, rad/s."""

FLYING = 10.0
"""Smallest airspeed in the air, m/s."""

SETTLED = 30.0
"""Start of the comparison, s."""


def recorded_vanes() -> FloatArray:
    """Return log time, s, angle of attack and sideslip, rad, a row for each message."""
    with Bag(cases.RECORDED / FLIGHT) as bag:
        decode = bag.decoder("/vanes")
        messages = ((log_ns, decode(data).vector) for _, log_ns, data in bag.messages(("/vanes",)))
        return np.array([(log_ns * 1e-9, at.x, at.y) for log_ns, at in messages])


def compare(case: cases.Case, airspeed: str) -> None:
    """Print the correlations with an airspeed of that type or without."""
    track = cases.identify(case, {"structure": "flight_dynamics", "airspeed.type": airspeed})
    assert track.flow is not None
    t = np.asarray(track.t_ns) * 1e-9
    vanes, m = recorded_vanes(), case.samples
    speed = np.interp(t, m.airspeed_t_ns * 1e-9, m.airspeed)
    air = (speed > FLYING) & (track.time > SETTLED)
    band = butter(2, BAND, "bandpass", fs=2.0 * np.pi * (len(t) - 1) / (t[-1] - t[0]), output="sos")

    def dynamic(signal: FloatArray) -> FloatArray:
        return np.asarray(sosfiltfilt(band, signal)[air])

    def at_ticks(t_ns: cases.TimeArray, signals: FloatArray, delay: float = 0.0) -> FloatArray:
        return np.array([np.interp(t - delay, t_ns * 1e-9, signal) for signal in signals.T])

    actuators = track.settings.actuators
    forces = at_ticks(m.imu_t_ns, case.measured(track.settings)[1])
    inputs = InputMap(actuators).apply(m.actuators)
    surfaces = at_ticks(m.actuator_t_ns, inputs, actuators.delay)
    if airspeed:
        forces *= (cases.RECORDED_SPEED / np.maximum(speed, FLYING)) ** 2
    for k, (name, label) in enumerate((("beta", "dr"), ("alpha", "de"))):
        vane = dynamic(np.interp(t, vanes[:, 0], vanes[:, 2 - k]))

        def agreement(signal: FloatArray, vane: FloatArray = vane) -> float:
            return abs(float(np.corrcoef(signal, vane)[0, 1]))

        both = np.stack((dynamic(forces[k]), dynamic(surfaces[INPUTS.index(label)])), 1)
        best = both @ np.linalg.lstsq(both, vane, rcond=None)[0]
        print(
            f"{name}: correlation with the vane {agreement(dynamic(track.flow[:, k])):.2f}; "
            f"of the force alone {agreement(both[:, 0]):.2f}; "
            f"less what {label} would best make of it {agreement(best):.2f}"
        )


def main() -> None:
    """Print the correlations."""
    case = cases.load(FLIGHT)
    for what, airspeed in (("recorded", cases.AIRSPEED_TYPE), ("usual", "")):
        print(f"with the {what} airspeed:")
        compare(case, airspeed)


if __name__ == "__main__":
    main()
