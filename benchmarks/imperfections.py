# SPDX-License-Identifier: Apache-2.0
"""Errors of real sensors, links and actuators that no setting of the identifier contains.

The sizes are those of small aircraft. MPU: product specification PS-MPU-6000A-00, revision 3.4, of
the InvenSense MPU-6000 and MPU-6050. PX4: its parameters IMU_GYRO_CUTOFF and IMU_ACCEL_CUTOFF, 30
to 40 and 30 Hz. Servo: 0.1 to 0.2 s for 60 deg, a dead band of 2 to 8 us where 500 us are 45 deg,
and plays of gears, arms and hinges.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike
from scipy.signal import butter, sosfilt

from uav_ident_ros.identification.frames import rotation
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.noise import Measurements

DEGREE = np.pi / 180.0

SIGNS = np.array([1.0, -1.0, 1.0])
"""Signs of an error in x, y and z."""

LINKED = 0.1
"""Command at which the errors of a linkage are given, and beyond which they no longer grow, rad."""


def keep(which: Any, stream: str, m: Measurements) -> Measurements:
    """Keep some messages of a stream, ``imu`` or ``actuator``."""
    names = [f"{stream}_t_ns", f"{stream}_log_ns"]
    names += ["true_t_ns", "rates", "specific_force"] if stream == "imu" else ["actuators"]
    return replace(m, **{name: getattr(m, name)[which] for name in names})


def multiply(rates: ArrayLike, force: ArrayLike, m: Measurements) -> Measurements:
    """Multiply rates and specific force by matrices, as in another mounting or other units."""
    return replace(
        m,
        rates=m.rates @ np.transpose(rates),
        specific_force=m.specific_force @ np.transpose(force),
    )


def _linear(rates: ArrayLike, force: ArrayLike, _: Generator, m: Measurements) -> Measurements:
    return multiply(rates, force, m)


def _biased(gyro: float, force: float, drift: bool, _: Generator, m: Measurements) -> Measurements:
    """Add errors, rad/s and m/s^2, constant or growing from nothing."""
    grown = SIGNS * np.linspace(0.0, 1.0, len(m.rates))[:, None] ** float(drift)
    return replace(m, rates=m.rates + gyro * grown, specific_force=m.specific_force + force * grown)


def _filtered(gyro: float, force: float, _: Generator, m: Measurements) -> Measurements:
    """Filter rates and specific force by low-passes of second order with these cut-offs, Hz."""
    rate = 1e9 / float(np.median(np.diff(m.imu_t_ns)))
    rates, forces = (
        x[0] + sosfilt(butter(2, cutoff, fs=rate, output="sos"), x - x[0], axis=0)
        for x, cutoff in ((m.rates, gyro), (m.specific_force, force))
    )
    return replace(m, rates=rates, specific_force=forces)


def _vibrating(
    frequency: float, gyro: float, force: float, _: Generator, m: Measurements
) -> Measurements:
    """Add a vibration, Hz, rad/s and m/s^2, that no filter removes before the samples."""
    angle = 2.0 * np.pi * frequency * 1e-9 * m.imu_t_ns[:, None] + [0.0, 1.0, 2.0]
    return replace(
        m,
        rates=m.rates + gyro * np.sin(angle),
        specific_force=m.specific_force + force * np.cos(angle),
    )


def _rounded(
    gyro: float, force: float, command: float, _: Generator, m: Measurements
) -> Measurements:
    """Round all values to steps, rad/s, m/s^2 and rad."""
    return replace(
        m,
        rates=gyro * np.round(m.rates / gyro),
        specific_force=force * np.round(m.specific_force / force),
        actuators=command * np.round(m.actuators / command),
    )


def _silent(stream: str, rng: Generator, m: Measurements) -> Measurements:
    """Lose a stream for 0.2 to 1 s, every 5 to 15 s."""
    t_ns = getattr(m, f"{stream}_t_ns")
    time, kept, start = (t_ns - t_ns[0]) * 1e-9, np.ones(len(t_ns), dtype=bool), 0.0
    while (start := start + rng.uniform(5.0, 15.0)) < time[-1]:
        kept &= (time < start) | (time > start + rng.uniform(0.2, 1.0))
    return keep(kept, stream, m)


def _lost(share: float, rng: Generator, m: Measurements) -> Measurements:
    """Lose a share of the commands."""
    return keep(rng.random(len(m.actuators)) >= share, "actuator", m)


def _repeated(share: float, rng: Generator, m: Measurements) -> Measurements:
    """Repeat the last values of the Imu, with new stamps, in a share of its messages."""
    index = np.where(rng.random(len(m.rates)) < share, 0, np.arange(len(m.rates)))
    index = np.maximum.accumulate(index)
    return replace(m, rates=m.rates[index], specific_force=m.specific_force[index])


def _stamped(late: float, error: float, rng: Generator, m: Measurements) -> Measurements:
    """Stamp the commands late, s, exponentially distributed, and with a uniform error, s."""
    count = len(m.actuators)
    off = rng.exponential(late, count) + rng.uniform(-error, error, count)
    t_ns = np.maximum.accumulate(m.actuator_t_ns + np.rint(1e9 * off).astype(np.int64))
    return replace(m, actuator_t_ns=t_ns, actuator_log_ns=np.maximum(t_ns, m.actuator_log_ns))


def _surfaces(moved: FloatArray, commanded: FloatArray) -> FloatArray:
    """Return moved surfaces with the commanded throttle."""
    return np.append(moved[:3], commanded[3:])


def behind(play: float, before: FloatArray, commanded: FloatArray) -> FloatArray:
    """Follow behind a play, rad from stop to stop."""
    half = 0.5 * play
    return _surfaces(np.clip(before, commanded - half, commanded + half), commanded)


def _dead(band: float, before: FloatArray, commanded: FloatArray) -> FloatArray:
    """Stay until the command is more than a band away, rad."""
    return _surfaces(np.where(abs(commanded - before) > band, commanded, before), commanded)


def slow(reach: float, before: FloatArray, commanded: FloatArray) -> FloatArray:
    """Move by at most `reach` from one command to the next, rad."""
    return _surfaces(np.clip(commanded, before - reach, before + reach), commanded)


def _linked(even: float, odd: float, _: FloatArray, commanded: FloatArray) -> FloatArray:
    """Move by more on one side, or by more to either side, relative to commands of `LINKED`."""
    size = np.clip(commanded / LINKED, -1.0, 1.0)
    return _surfaces(commanded * (1.0 + even * size + odd * size**2), commanded)


def _asymmetric(_: FloatArray, commanded: FloatArray) -> FloatArray:
    """Move one aileron by 20 % more: they pitch like a tenth of an elevator."""
    de, dr, da, *others = commanded.tolist()
    return np.array([de + 0.1 * da, dr, da * (1.1 if da > 0.0 else 0.9), *others])


def _imu_at(*position: float) -> Mapping[str, Any]:
    """Return the arguments for an Imu off the centre of gravity, m, that is not told."""
    return {"sensors": {"lever_arm": position}, "settings": {"imu.lever_arm": [0.0, 0.0, 0.0]}}


def _on_signals(function: Callable[..., Measurements], *values: Any) -> Mapping[str, Any]:
    return {"spoil": partial(function, *values)}


def _on_actuators(function: Callable[..., FloatArray], *values: Any) -> Mapping[str, Any]:
    return {"actuators": partial(function, *values)}


IMPERFECTIONS: Mapping[str, Mapping[str, Any]] = {
    # MPU: zero-g output, 50 mg in x and y, 80 mg in z
    "accelerometer bias 0.4 m/s^2": _on_signals(_biased, 0.0, 0.4, False),
    # MPU: its change from 0 to 70 degrees Celsius, 35 mg in x and y, 60 mg in z
    "accelerometer drift 0.4 m/s^2": _on_signals(_biased, 0.0, 0.4, True),
    # MPU: 20 deg/s for a change by 125 degrees Celsius
    "gyro drift 0.05 rad/s": _on_signals(_biased, 0.05, 0.0, True),
    # MPU: 3 % for gyro and accelerometer
    "scales 3 %": _on_signals(_linear, np.diag(1 + 0.03 * SIGNS), np.diag(1 - 0.03 * SIGNS)),
    # MPU: 2 % for both
    "cross-axis 2 %": _on_signals(_linear, *2 * [np.eye(3) + 0.02 * np.outer(SIGNS, SIGNS[::-1])]),
    # A board that is fixed by hand
    "mounted 3 deg off": _on_signals(_linear, *2 * [rotation(*(3 * DEGREE * SIGNS))]),
    "mounted -3 deg off": _on_signals(_linear, *2 * [rotation(*(-3 * DEGREE * SIGNS))]),
    # PX4: one of them slower than the other, and both slower
    "gyro low-pass 30 Hz": _on_signals(_filtered, 30.0, 45.0),
    "accelerometer low-pass 15 Hz": _on_signals(_filtered, 45.0, 15.0),
    "low-passes of 20 Hz": _on_signals(_filtered, 20.0, 20.0),
    # Engines of 5000 and 5700 rpm: they appear at 17 and 5 Hz
    "vibration at 83 Hz": _on_signals(_vibrating, 83.0, 0.1, 5.0),
    "vibration at 95 Hz": _on_signals(_vibrating, 95.0, 0.05, 2.0),
    # Half a degree per second, a hundredth of g, half a degree
    "rounded": _on_signals(_rounded, 0.01, 0.1, 0.01),
    # Links to a companion computer
    "Imu silent for up to 1 s": _on_signals(_silent, "imu"),
    "commands silent for up to 1 s": _on_signals(_silent, "actuator"),
    "Imu stamps off by 4 ms": {"sensors": {"stamp_jitter": 0.004}},
    "every third Imu message repeated": _on_signals(_repeated, 0.33),
    "every fifth Imu message lost": {"sensors": {"drop": 0.2}},
    "every fifth command lost": _on_signals(_lost, 0.2),
    "commands stamped 10 ms late": _on_signals(_stamped, 0.01, 0.0),
    "command stamps off by 10 ms": _on_signals(_stamped, 0.0, 0.01),
    # Autopilots in the nose and in a wing
    "Imu 20 cm ahead": _imu_at(0.2, 0.0, 0.0),
    "Imu 20 cm to the right": _imu_at(0.0, 0.2, 0.0),
    # Servo: 0.2 s for 60 deg, and an arm at 0.4 of the surface's; at 50 commands a second
    "servos of 2 rad/s": _on_actuators(slow, 0.04),
    "backlash of 1 deg": _on_actuators(behind, 1.0 * DEGREE),
    "backlash of 2 deg": _on_actuators(behind, 2.0 * DEGREE),
    "dead band of 0.7 deg": _on_actuators(_dead, 0.7 * DEGREE),
    "linkage 20 % further on one side": _on_actuators(_linked, 0.1, 0.0),
    "linkage 20 % less at 0.1 rad": _on_actuators(_linked, 0.0, -0.2),
    "one aileron 20 % further": _on_actuators(_asymmetric),
}
"""Name of each error, and arguments of its trial; `spoil` takes a random generator first."""
