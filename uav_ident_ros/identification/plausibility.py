# SPDX-License-Identifier: Apache-2.0
"""Whether the signals can be what the settings say: mistakes named before they are learned.

Gravity and rigid rotation hold whatever the aircraft does. Averaged over seconds the specific
force is one g upwards, and turned back by the gyro into one attitude it stays so in turns, rolls
and loops: what is left of it is the change of velocity, a few m/s^2 at most. Channels are looked
at for numbers that no surface can follow, coefficients for what no surface does. Each finding says
what is wrong, what shows it and what to do.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from uav_ident_ros.identification.frames import BodyFrame, rotation
from uav_ident_ros.identification.inputs import InputMap
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.scales import LONG_MEMORY, SURE
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import INPUTS, STRUCTURES, FloatArray, Structure

LOOK_TIME = 1.0
"""Time between two looks at all that was gathered, s."""

WINDOW = 8.0
"""Time over which the specific force is turned back, s: a change of velocity of 20 m/s counts for
a quarter of a g."""

INPUT_WINDOW = 4.0
"""Time of channels that are looked at, s."""

ENOUGH = 4.0
"""Time before anything is found, s: a launch is over by then, and the mistake named within ten."""

HELD = 20.0
"""Time for which a finding stays after it was last seen, s: evidence comes and goes with motion."""

LARGEST_TILT = math.cos(math.radians(60.0))
"""Cosine of the mean tilt from which the Imu is mounted otherwise: none flies so on average."""

STEADY = 0.6
"""Length of the mean direction of the specific force from which it is one direction: in rolls and
loops there is none."""

GRAVITY_LEFT = 0.7
"""Mean specific force, in g, turned back by the gyro, below which the gyro contradicts gravity;
0.9 or more on every flight known, turbulence and turns included."""

LARGEST_MEAN_RATE = 2.0
"""Mean size of the angular rate, rad/s, of no aircraft over seconds but in aerobatics."""

SMALLEST_FORCE, LARGEST_FORCE = 4.0, 60.0
"""Mean size of the specific force, m/s^2: none is weightless, or pulls six g, on average."""

GRAVITY_IN_G = (0.6, 2.5)
"""Mean specific force of a flight told in g."""

LARGEST_TRIM = 0.6
"""Mean deviation from trim, rad, that no surface is flown with for seconds: 34 degrees."""

COUNTS = 100.0
"""Deviation from trim from which a channel is in microseconds, not in radians."""

LARGEST_DEFLECTION = math.pi
"""Deflection that no surface reaches, rad."""

STEP = 0.02
"""Step of an input that is no noise, rad or throttle."""

RETURN = 5.0
"""Steps that are undone by the next sample, relative to the usual change over two samples."""

RETURNING_SHARE = 0.1
"""Share of samples that are undone by the next from which two publishers are at work."""

FEWEST_SAMPLES = 40
"""Samples of the channels that tell anything."""


@dataclass(frozen=True)
class Finding:
    """Something that cannot be as the settings say."""

    name: str  # One word
    text: str  # Problem, evidence and cure
    # Whether nothing can be learned before it is put right; else it is a warning
    fault: bool = True


class Plausibility:
    """Looks at the signals for mistakes in how they are read.

    Parameters
    ----------
    settings : Settings
        How they are read.

    Attributes
    ----------
    accelerometer : bool or None
        Whether there is one; None before that is known. One that repeats a value is none.
    noted : dict
        Everything that was found since the start, by name, as it was last seen.
    """

    def __init__(self, settings: Settings) -> None:
        self._imu = settings.imu
        self._frame = BodyFrame(settings.imu)
        self._map = InputMap(settings.actuators)
        self._structure = STRUCTURES[settings.structure]
        self._expected = settings.supervision.expected_signs
        self._sums: FloatArray = np.zeros(7)
        """Of the direction of the specific force, of itself, and of its size, times s."""
        self._time = 0.0
        self.accelerometer: bool | None = None
        self._found: dict[str, tuple[float, Finding]] = {}
        self.noted: dict[str, Finding] = {}
        self.restart()

    def restart(self) -> None:
        """Begin a new stretch of signals; what was found stays for its time."""
        self._motion: deque[tuple[float, FloatArray]] = deque()
        self._inputs: deque[tuple[float, FloatArray]] = deque()
        self._began: float | None = None
        self._now = -math.inf
        self._looked = -math.inf
        self._found.clear()
        self._doubted: tuple[float, Finding] | None = None

    @property
    def findings(self) -> list[Finding]:
        """What is wrong now, faults first."""
        found = [f for _, f in self._found.values()]
        if self._doubted is not None and self._now - self._doubted[0] >= ENOUGH:
            found.append(self._doubted[1])
        return sorted(found, key=lambda f: not f.fault)

    @property
    def fault(self) -> str:
        """The first fault, in words; empty if there is none."""
        return next((f.text for f in self.findings if f.fault), "")

    @property
    def signal_fault(self) -> str:
        """The first fault of the signals, from which nothing can be learned; else empty."""
        return next((f.text for _, f in self._found.values() if f.fault), "")

    @property
    def doubted(self) -> bool:
        """Whether the coefficients say that channels are swapped or reversed, sure or not yet."""
        return self._doubted is not None

    def judge(self, coefficients: FloatArray, sigma: FloatArray) -> None:
        """Look at what was learned for channels that are swapped or reversed.

        Parameters
        ----------
        coefficients, sigma : (rows, n) arrays
            Estimate and standard deviations.
        """
        found = coefficient_finding(self._structure, coefficients, sigma, self._expected)
        if found is None:
            self._doubted = None
        elif self._doubted is None or self._doubted[1].name != found.name:
            self._doubted = (self._now, found)
        else:
            self._doubted = (self._doubted[0], found)

    def look(self, t: float, samples: FloatArray, raw: FloatArray) -> None:
        """Look at what came with a tick.

        Parameters
        ----------
        t : float
            Time of the tick, s.
        samples : (k, 6) array
            Rates, rad/s, and specific forces, m/s^2, that came with it, Imu axes.
        raw : (j, N) array
            Raw channels that came with it.
        """
        self._now = t
        if self._began is None:
            self._began = self._looked = t
        if len(samples):
            self._motion.append((t, np.add.reduce(samples) / len(samples)))
            self._find_accelerometer(samples)
        if len(raw):
            self._inputs.append((t, raw))
        if t - self._looked < LOOK_TIME:
            return
        span, self._looked = t - self._looked, t
        for stream, window in ((self._motion, WINDOW), (self._inputs, INPUT_WINDOW)):
            while stream and t - stream[0][0] > window:
                stream.popleft()
        self._found = {n: f for n, f in self._found.items() if t - f[0] < HELD}
        found = [*self._look_at_motion(t, span), *self._look_at_inputs()]
        self._found.update({f.name: (t, f) for f in found if t - self._began >= ENOUGH})
        self.noted.update({f.name: f for f in self.findings})

    def _find_accelerometer(self, samples: FloatArray) -> None:
        """Note whether the accelerometer has moved; no finding, a statement."""
        if self.accelerometer:
            return
        first = self._motion[0][1][3:]
        if np.any(samples[:, 3:] != samples[0, 3:]) or not np.allclose(
            samples[0, 3:], first, rtol=1e-9, atol=0.0
        ):
            self.accelerometer = True
        elif self._began is not None and self._motion[-1][0] - self._began > ENOUGH:
            self.accelerometer = False

    # -- gravity ---------------------------------------------------------------------------

    def _look_at_motion(self, t: float, span: float) -> list[Finding]:
        if not self.accelerometer or len(self._motion) < 2:
            return []
        times = np.array([time for time, _ in self._motion])
        signals = np.concatenate([signal for _, signal in self._motion]).reshape(-1, 6)
        rates = self._frame.to_body(signals[:, :3])
        force = self._frame.to_body(signals[:, 3:])
        if times[-1] - times[0] < ENOUGH - LOOK_TIME:
            return []
        recent = force[times > t - span]
        if len(recent):
            self._follow(recent, span)
        found = (self._size(), self._mounting(), self._gyro_units(times, rates, force))
        return [finding for finding in found if finding is not None][:1]

    def _follow(self, force: FloatArray, span: float) -> None:
        """Follow the mean specific force: what is wrong with it is wrong from the start."""
        size = np.linalg.norm(force, axis=1, keepdims=True)
        direction = force / np.maximum(size, 0.5 * GRAVITY)
        self._sums += span * np.concatenate([direction, force, size], axis=1).mean(axis=0)
        self._time += span
        if self._time > LONG_MEMORY:
            self._sums *= LONG_MEMORY / self._time
            self._time = LONG_MEMORY

    def _size(self) -> Finding | None:
        """Find a specific force in another unit, or without gravity."""
        if self._time < ENOUGH - LOOK_TIME:
            return None
        size = float(self._sums[6]) / self._time
        mean = float(np.linalg.norm(self._sums[3:6])) / self._time
        if SMALLEST_FORCE <= size <= LARGEST_FORCE:
            return None
        evidence = f"the specific force is {size:.2g} m/s^2 on average, gravity alone is 9.8: "
        if size > LARGEST_FORCE:
            cure = "it looks like milli-g or cm/s^2. Convert it to m/s^2 (REP-103)"
        elif GRAVITY_IN_G[0] <= mean <= GRAVITY_IN_G[1]:
            cure = "it looks like g. Multiply it by 9.80665 (REP-103: m/s^2)"
        else:
            cure = (
                "gravity has been taken out of it. Publish what the accelerometer measures, "
                "for MAVROS ~/imu/data_raw or ~/imu/data"
            )
        return Finding("force size", evidence + cure)

    def _mounting(self) -> Finding | None:
        """Find an Imu that is mounted, or whose axes are named, otherwise."""
        if self._time < ENOUGH - LOOK_TIME:
            return None
        mean = self._sums[:3] / self._time
        length = float(np.linalg.norm(mean))
        if length < STEADY or -mean[2] > LARGEST_TILT * length:
            return None
        direction = mean / length
        evidence = ", ".join(f"{GRAVITY * v:+.1f}" for v in direction)
        return Finding(
            "mounting",
            f"the specific force points along [{evidence}] m/s^2 (forward, right, down) on "
            "average, an aircraft that flies or stands is carried along [0, 0, -9.8]: "
            + self._better_mounting(direction),
        )

    def _better_mounting(self, direction: FloatArray) -> str:
        """Say which convention or attitude of the Imu puts gravity where it belongs."""
        own = self._frame.to_imu(direction)
        other = "frd" if self._imu.convention == "flu" else "flu"
        flipped = rotation(*self._imu.rpy) @ np.diag([1.0, -1.0, -1.0]) @ rotation(*self._imu.rpy).T
        cures = []
        if -(flipped @ direction)[2] > LARGEST_TILT:
            cures.append(f"imu.convention '{other}' would fit, not '{self._imu.convention}'")
        convention = np.diag([1.0, -1.0, -1.0]) if self._imu.convention == "flu" else np.eye(3)
        quarter = 0.5 * math.pi
        turns = [(r, 0) for r in (0, 2, 1, -1)] + [(0, 1), (0, -1)]
        fits = [-(rotation(quarter * r, quarter * p, 0.0) @ convention @ own)[2] for r, p in turns]
        roll, pitch = turns[int(np.argmax(fits))]
        cures.append(
            f"{'or ' if cures else ''}the board is mounted with imu.rpy about "
            f"[{quarter * roll:.2f}, {quarter * pitch:.2f}, yaw]"
        )
        return ", ".join(cures)

    def _gyro_units(
        self, times: FloatArray, rates: FloatArray, force: FloatArray
    ) -> Finding | None:
        """Find a gyro that turns gravity as no aircraft does, and would not in deg/s."""
        speed = float(np.mean(np.linalg.norm(rates, axis=1)))
        if times[-1] - times[0] < WINDOW - LOOK_TIME or speed < LARGEST_MEAN_RATE:
            return None
        left = _gravity_left(times, rates, force)
        if left > GRAVITY_LEFT or _gravity_left(times, np.deg2rad(rates), force) < GRAVITY_LEFT:
            return None
        return Finding(
            "gyro units",
            f"the gyro turns at {speed:.1f} rad/s on average, and turned back by it the specific "
            f"force of the last {WINDOW:g} s is {left:.1f} g on average, in deg/s it would be one: "
            "convert the angular velocity to rad/s (REP-103)",
        )

    # -- channels --------------------------------------------------------------------------

    def _look_at_inputs(self) -> list[Finding]:
        if not self._inputs:
            return []
        raw = np.concatenate([values for _, values in self._inputs])
        if len(raw) < FEWEST_SAMPLES:
            return []
        u = self._map.apply(raw)
        without_trim = raw @ self._map.matrix.T
        found = []
        for i, name in enumerate(INPUTS):
            own, untrimmed = u[:, i], without_trim[:, i]
            if np.ptp(own) == 0.0:  # not used, or not armed yet
                continue
            found += [
                _interleaved(name, own),
                # Throttles come in all units, motor speeds among them.
                *(
                    (_counts(name, own), _trim(name, own, untrimmed), _degrees(name, own))
                    if name != "dth"
                    else ()
                ),
            ]
        return [finding for finding in found if finding is not None]


def _gravity_left(times: FloatArray, rates: FloatArray, force: FloatArray) -> float:
    """Mean specific force, in g, turned back by the gyro to the attitude at the start.

    Each tick holds for the time since the one before; a gap counts as one tick, in which the
    aircraft did not turn.
    """
    steps = np.diff(times, prepend=times[0])
    usual = float(np.median(steps[1:]))
    steps = np.where(steps > 4.0 * usual, usual, steps)
    turns = _rotations(rates * steps[:, None])
    reach = 1
    while reach < len(turns):  # products of all before, by doubling
        turns[reach:] = turns[:-reach] @ turns[reach:]
        reach *= 2
    back = np.einsum("kij,kj->i", turns, force) / len(force)
    return float(np.linalg.norm(back)) / GRAVITY


def _rotations(vectors: FloatArray) -> FloatArray:
    """Rotation matrices, shape (k, 3, 3), of rotation vectors, rad (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=1)
    x, y, z = (vectors / np.maximum(angle, 1e-12)[:, None]).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    sine, versine = np.sin(angle)[:, None, None], (1.0 - np.cos(angle))[:, None, None]
    return np.asarray(np.eye(3) + sine * cross + versine * (cross @ cross))


def _counts(name: str, u: FloatArray) -> Finding | None:
    if np.abs(u).max() < COUNTS or abs(middle := float(np.median(u))) < COUNTS:
        return None
    return Finding(
        "channel range",
        f"{name} is {middle:.0f} on average: its channels look like PWM in microseconds. Set "
        "actuators.trim to about 1500 and actuators.scale to 0.001 or to radians per microsecond",
    )


def _trim(name: str, u: FloatArray, without_trim: FloatArray) -> Finding | None:
    if np.abs(u).min() < LARGEST_TRIM or np.abs(without_trim).max() > LARGEST_TRIM:
        return None
    return Finding(
        "trim",
        f"{name} is {np.median(u):+.2f} rad from its trim and never within {LARGEST_TRIM:g}, "
        f"without actuators.trim it is {np.median(without_trim):+.2f}: the trim is in the unit of "
        "the channels, is it in degrees?",
    )


def _degrees(name: str, u: FloatArray) -> Finding | None:
    largest = float(np.abs(u).max())
    if not LARGEST_DEFLECTION < largest < COUNTS or np.abs(np.median(u)) > LARGEST_DEFLECTION:
        return None
    return Finding(
        "channel range",
        f"{name} reaches {largest:.1f} rad, which no surface does: in degrees? Set "
        "actuators.scale to 0.01745",
        fault=False,
    )


def _interleaved(name: str, u: FloatArray) -> Finding | None:
    """Find samples that the next one takes back: two streams in turn."""
    step, over_two = np.abs(u[1:] - u[:-1]), np.abs(u[2:] - u[:-2])
    away = np.minimum(step[:-1], step[1:])
    if away.max() <= STEP:
        return None
    returns = away > np.maximum(RETURN * np.maximum(over_two, np.median(over_two)), STEP)
    share = float(np.mean(returns))
    if share < RETURNING_SHARE:
        return None
    return Finding(
        "publishers",
        f"{share:.0%} of the samples of {name} are taken back by the next one: two publishers "
        "are on the actuator topic. See 'ros2 topic info --verbose', remap one of them",
    )


def coefficient_finding(
    structure: Structure, coefficients: FloatArray, sigma: FloatArray, expected: tuple[str, ...]
) -> Finding | None:
    """Find channels that are swapped or reversed, by what they were found to do.

    Parameters
    ----------
    structure : Structure
        Names the coefficients.
    coefficients, sigma : (rows, n) arrays
        Estimate and standard deviations.
    expected : tuple of str
        Signs of control derivatives, as in ``+pdot/da``.
    """
    for entry in expected:
        sign, index = entry[0], structure.index(entry[1:])
        value, spread = float(coefficients[index]), float(sigma[index])
        if value * (1.0 if sign == "+" else -1.0) < -SURE * spread < 0.0:
            return Finding(
                "signs",
                f"{entry[1:]} is {value:.3g} +- {spread:.2g}, expected is {sign}: a surface is "
                "connected the wrong way round, or its sign in actuators.mixing",
            )
    return _swapped(structure, coefficients, sigma)


def _swapped(structure: Structure, coefficients: FloatArray, sigma: FloatArray) -> Finding | None:
    """Find a rudder that rolls more than the aileron does, and does not clearly yaw more.

    The true rudder's side force has no column under the aileron's name, so that the yaw of both
    is told apart late, if at all.
    """

    def exceeds(larger: str, smaller: str) -> bool:
        i, j = structure.index(larger), structure.index(smaller)
        by = abs(float(coefficients[i])) - abs(float(coefficients[j]))
        return by > SURE * math.hypot(float(sigma[i]), float(sigma[j]))

    if not exceeds("pdot/dr", "pdot/da") or exceeds("rdot/dr", "rdot/da"):
        return None
    return Finding(
        "swapped",
        "dr rolls the aircraft more than da does: rudder and aileron are swapped in "
        "actuators.channels or actuators.mixing",
    )
