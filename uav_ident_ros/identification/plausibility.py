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
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from uav_ident_ros.identification.delay import DelayEstimate
from uav_ident_ros.identification.flow import GRAVITY_BAND
from uav_ident_ros.identification.frames import BodyFrame
from uav_ident_ros.identification.gates import TickMeans
from uav_ident_ros.identification.linearisation import damping
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.sampling import InputMap
from uav_ident_ros.identification.scales import (
    INDEPENDENT_TIME,
    LONG_MEMORY,
    MEMORY,
    RESPONSE_TIME,
    SAMPLE_TIME,
    SURE,
)
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    INPUTS,
    MAIN_DERIVATIVES,
    ROWS,
    STRUCTURES,
    FloatArray,
    Structure,
)

ENOUGH = 2.0 * RESPONSE_TIME
"""Time before anything is found, s: a launch is over by then, and the mistake named within ten.
Channels are looked at over as long."""

WINDOW = 2.0 * ENOUGH
"""Time over which the specific force is turned back, s: a change of velocity of 20 m/s counts for
a quarter of a g."""

LARGEST_TILT = math.cos(math.radians(60.0))
"""Cosine of the mean tilt from which the Imu is mounted otherwise: none flies so on average."""

GRAVITY_LEFT = 1.0 - GRAVITY_BAND
"""Length of a mean of directions, or of forces in g, from which they are one: less is left in rolls
and loops, and where the gyro turns gravity wrongly. Turned back by a right one 0.9 or more is left
on every flight known, turbulence and turns included."""

SMALLEST_MEAN_RATE = 1.0 / RESPONSE_TIME
"""Mean size of the angular rate, rad/s, from which a wrong unit would show: slower, less than a
radian is turned in `RESPONSE_TIME`. Of the recorded flights known that turn as fast none pulls as
steadily."""

PULLING_SPEED = GRAVITY * ENOUGH
"""Airspeed V, m/s, at which an aircraft that turns at w pulls V w. One whose specific force varies
by more than that did not turn so slowly as it would have, were its gyro in deg/s. (Quadrotors in
aerobatics: 77 m/s and more; aircraft whose gyro is told in deg/s: at most 30.)"""

SMALLEST_FORCE, LARGEST_FORCE = 0.4 * GRAVITY, 6.0 * GRAVITY
"""Mean size of the specific force, m/s^2: none is weightless, or pulls six g, on average."""

LARGEST_TRIM = 0.6
"""Mean deviation from trim, rad, that no surface is flown with for seconds: 34 degrees."""

LARGEST_DEFLECTION = math.pi
"""Deflection that no surface reaches, rad."""

COUNTS = math.degrees(LARGEST_DEFLECTION)
"""Deviation from trim from which a channel is not in degrees either, but in microseconds."""

STEP = 0.02
"""Step of an input that is no noise, rad or throttle."""

RETURNING_SHARE = 0.1
"""Share of samples that are undone by the next from which two publishers are at work."""


@dataclass(frozen=True)
class Finding:
    """Something that cannot be as the settings say."""

    name: str  # One word
    text: str  # Problem, evidence and cure
    # Whether nothing can be learned before it is put right; else it is a warning
    fault: bool = True


def clock_step(seconds: float) -> Finding:
    """Return what is said of stamps of the actuators that stepped, s."""
    return Finding(
        "clock step",
        f"the stamps of the actuators stepped by {seconds:+.2f} s against the Imu's: it was taken "
        "back, so that what was learned still holds. Synchronise the clocks before the flight, not "
        "in it",
        fault=False,
    )


class Doubt(NamedTuple):
    """Channels that were found, by what they do, to be swapped or reversed.

    It stays until it is the less likely, and is a finding once it was sure again some time later.
    """

    since: float  # s
    finding: Finding  # With the evidence when it was last sure
    confirmed: bool = False


class Plausibility:
    """Looks at the signals for mistakes in how they are read."""

    def __init__(self, settings: Settings) -> None:
        self._imu = settings.imu
        self._frame = BodyFrame(settings.imu)
        self._map = InputMap(settings.actuators)
        self._learns_trim = settings.actuators.learn_trim_time > 0.0
        self._structure = STRUCTURES[settings.structure]
        self._expected = settings.supervision.expected_signs
        self._multirotor = settings.actuators.multirotor
        # Of the direction of the specific force, of itself, and of its size, times s
        self._sums: FloatArray = np.zeros(7)
        self._time = 0.0
        self._found: dict[str, tuple[float, Finding]] = {}
        # Everything that was found since the start, by name, as it was last seen
        self.noted: dict[str, Finding] = {}
        self.restart()

    def restart(self) -> None:
        """Begin a new stretch of signals; what was found stays for its time."""
        self._motion = TickMeans(WINDOW)
        self._inputs: list[tuple[float, FloatArray]] = []
        self._began: float | None = None
        self._now = -math.inf
        self._looked = -math.inf
        self._found.clear()
        self._doubt: Doubt | None = None

    @property
    def findings(self) -> list[Finding]:
        """What is wrong now, faults first."""
        if not self._found and self._doubt is None:  # nearly always
            return []
        found = [f for _, f in self._found.values()]
        if self._doubt is not None and self._doubt.confirmed:
            found.append(self._doubt.finding)
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
        return self._doubt is not None

    def note(self, t: float, finding: Finding) -> None:
        """Take note of what was found elsewhere at `t` s."""
        self._found[finding.name] = t, finding
        self.noted[finding.name] = finding

    def judge(self, coefficients: FloatArray, sigma: FloatArray) -> None:
        """Look at what was learned for channels that are swapped or reversed."""
        known = (self._structure, coefficients, sigma, self._expected)
        find = partial(coefficient_finding, *known, multirotor=self._multirotor)
        found, before = find(), self._doubt
        if found is None:
            likely = before and find(sure=0.0)
            if likely is None or before is None or likely.name != before.finding.name:
                self._doubt = None
        elif before is None or found.name != before.finding.name:
            self._doubt = Doubt(self._now, found)
        else:
            confirmed = before.confirmed or self._now - before.since >= ENOUGH
            self._doubt = Doubt(before.since, found, confirmed)

    def look(
        self,
        t: float,  # Time of the tick, s
        samples: FloatArray,  # (k, 6) Rates, rad/s, and specific forces, m/s^2, Imu axes
        raw: FloatArray,  # (j, N) Raw channels
    ) -> None:
        """Look at what came with a tick."""
        self._now = t
        if self._began is None:
            self._began = self._looked = t
        self._motion.add(t, samples)
        if len(raw):
            self._inputs.append((t, raw))
        if t - self._looked < INDEPENDENT_TIME:
            return
        span, self._looked = t - self._looked, t
        self._inputs = [(time, values) for time, values in self._inputs if t - time <= ENOUGH]
        # Evidence comes and goes with motion.
        self._found = {n: f for n, f in self._found.items() if t - f[0] < MEMORY}
        found = [*self._look_at_motion(t, span), *self._look_at_inputs()]
        self._found.update({f.name: (t, f) for f in found if t - self._began >= ENOUGH})
        self.noted.update({f.name: f for f in self.findings})

    # -- gravity ---------------------------------------------------------------------------

    def _look_at_motion(self, t: float, span: float) -> list[Finding]:
        motion = self._motion.until(t)
        times, rates, force = motion[:, 0], motion[:, 1:4], motion[:, 4:]
        if len(times) < 2 or (np.abs(force - force[0]) <= 1e-9 * np.abs(force[0])).all():
            return []  # an accelerometer that repeats itself is none
        recent = force[times > t - span]
        if len(recent):
            self._follow(self._frame.to_body(recent), span)
        found = self._size() or self._mounting() or self._gyro_units(times, rates, force)
        return [found] if found else []

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
        size = float(self._sums[6]) / self._time
        mean = float(np.linalg.norm(self._sums[3:6])) / self._time
        if SMALLEST_FORCE <= size <= LARGEST_FORCE:
            return None
        evidence = f"the specific force is {size:.2g} m/s^2 on average, gravity alone is 9.8: "
        if size > LARGEST_FORCE:
            cure = "it looks like milli-g or cm/s^2. Convert it to m/s^2 (REP-103)"
        elif mean * GRAVITY > SMALLEST_FORCE:
            cure = "it looks like g. Multiply it by 9.80665 (REP-103: m/s^2)"
        else:
            cure = (
                "gravity has been taken out of it. Publish what the accelerometer measures, "
                "for MAVROS ~/imu/data_raw or ~/imu/data"
            )
        return Finding("force size", evidence + cure)

    def _mounting(self) -> Finding | None:
        """Find an Imu that is mounted, or whose axes are named, otherwise."""
        mean = self._sums[:3] / self._time
        length = float(np.linalg.norm(mean))
        if length < GRAVITY_LEFT or -mean[2] > LARGEST_TILT * length:
            return None
        direction = mean / length
        evidence = ", ".join(f"{GRAVITY * v:+.1f}" for v in direction)
        return Finding(
            "mounting",
            f"the axes of the Imu look wrong: its mean specific force is [{evidence}] m/s^2 "
            "(forward, right, down), and [0, 0, -9.8] in flight and at rest: "
            + self._better_mounting(direction),
        )

    def _better_mounting(self, direction: FloatArray) -> str:
        """Say which convention or attitude of the Imu puts gravity where it belongs."""
        own, imu, quarter = self._frame.to_imu(direction), self._imu, 0.5 * math.pi

        def up(**other: Any) -> float:
            return -float(BodyFrame(replace(imu, **other)).to_body(own)[2])

        other, cures = "frd" if imu.convention == "flu" else "flu", []
        if up(convention=other) > LARGEST_TILT:
            cures.append(f"imu.convention '{other}' would fit, not '{imu.convention}'")
        turns = [(r, 0) for r in (0, 2, 1, -1)] + [(0, 1), (0, -1)]
        roll, pitch = max(turns, key=lambda t: up(rpy=(quarter * t[0], quarter * t[1], 0.0)))
        cures.append(
            f"{'or ' if cures else ''}the board is mounted with imu.rpy about "
            f"[{quarter * roll:.2f}, {quarter * pitch:.2f}, yaw]"
        )
        return ", ".join(cures)

    def _gyro_units(
        self, times: FloatArray, rates: FloatArray, force: FloatArray
    ) -> Finding | None:
        """Find a gyro that turns gravity as no aircraft does, and would not in deg/s; any axes."""
        speed = float(np.mean(np.linalg.norm(rates, axis=1)))
        if times[-1] - times[0] < WINDOW - INDEPENDENT_TIME or speed < SMALLEST_MEAN_RATE:
            return None
        if np.std(np.linalg.norm(force, axis=1)) > PULLING_SPEED * math.radians(speed):
            return None
        left = _gravity_left(times, rates, force)
        if left > GRAVITY_LEFT or _gravity_left(times, np.deg2rad(rates), force) < GRAVITY_LEFT:
            return None
        return Finding(
            "gyro units",
            f"the gyro looks like deg/s: it turns at {speed:.1f} rad/s on average, and turned back "
            f"by it the specific force of the last {WINDOW:g} s is {left:.1f} g in place of 1 g; "
            "convert the angular velocity to rad/s (REP-103)",
        )

    # -- channels --------------------------------------------------------------------------

    def _look_at_inputs(self) -> list[Finding]:
        if not self._inputs or self._inputs[-1][0] - self._inputs[0][0] < ENOUGH - INDEPENDENT_TIME:
            return []
        raw = np.concatenate([values for _, values in self._inputs])
        # Slower, they may be the wobble of an attitude loop, near 5 Hz on a quadrotor.
        quick = len(raw) * SAMPLE_TIME >= self._inputs[-1][0] - self._inputs[0][0]
        u = self._map.apply(raw)
        without_trim = raw @ self._map.matrix.T
        found: list[Finding] = []
        used = (u != u[0]).any(axis=0)  # the others are not in use, or not armed yet
        for i in np.flatnonzero(used).tolist():
            name, own = INPUTS[i], u[:, i]
            if quick and (publishers := _interleaved(name, own)) is not None:
                found.append(publishers)
            if name != "dth":  # throttles come in all units, motor speeds among them
                found += _off_range(name, own, without_trim[:, i], self._learns_trim)
        return found


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


def _off_range(
    name: str, u: FloatArray, without_trim: FloatArray, learns_trim: bool
) -> Iterator[Finding]:
    """Yield what makes a surface's deflections none: counts, a trim or an angle in degrees.

    Where the trim is to be learned, deflections are looked at about their own middle.
    """
    size = np.abs(u)
    largest = float(size.max())
    if largest < LARGEST_TRIM:  # nearly always
        return
    middle = float(np.median(u))
    if largest >= COUNTS and abs(middle) >= COUNTS:
        yield Finding(
            "channel range",
            f"the channels of {name} look like PWM in microseconds: {middle:.0f} on average. Set "
            "actuators.trim to about 1500 and actuators.scale to 0.001 or to radians per "
            "microsecond",
        )
    if size.min() >= LARGEST_TRIM and np.abs(without_trim).max() <= LARGEST_TRIM:
        yield Finding(
            "trim",
            f"actuators.trim looks as if in degrees: {name} is {middle:+.2f} rad from its trim, "
            f"never within {LARGEST_TRIM:g}, and {np.median(without_trim):+.2f} without the trim; "
            "write the trim in the unit of the channels",
        )
    reach = float(np.abs(u - middle).max()) if learns_trim else largest
    if LARGEST_DEFLECTION < reach < COUNTS and abs(middle) <= LARGEST_DEFLECTION:
        yield Finding(
            "channel range",
            f"{name} looks as if in degrees: it reaches {reach:.1f} rad. Set actuators.scale to "
            "0.01745",
            fault=False,
        )


def _interleaved(name: str, u: FloatArray) -> Finding | None:
    """Find samples that the next one takes back: two streams in turn."""
    step = np.abs(u[1:] - u[:-1])
    away = np.minimum(step[:-1], step[1:])
    if np.count_nonzero(away > STEP) < RETURNING_SHARE * len(away):  # nearly always
        return None
    over_two = np.abs(u[2:] - u[:-2])
    returns = away > np.maximum(SURE * np.maximum(over_two, np.median(over_two)), STEP)
    share = float(np.mean(returns))
    if share < RETURNING_SHARE:
        return None
    return Finding(
        "publishers",
        f"two publishers are on the actuator topic: {share:.0%} of the samples of {name} are taken "
        "back by the next one. See 'ros2 topic info --verbose', remap one of them",
    )


def coefficient_finding(
    structure: Structure,
    coefficients: FloatArray,
    sigma: FloatArray,
    expected: tuple[str, ...],  # Signs of control derivatives, as in ``+pdot/da``
    sure: float = SURE,  # Standard deviations from which it counts
    *,
    multirotor: bool = False,  # Whether it has motors in place of surfaces, in words
) -> Finding | None:
    """Find channels that are swapped or reversed, by what they were found to do."""
    words = ("yaw and roll inputs", "motor") if multirotor else ("rudder and aileron", "surface")
    both, actuator = words
    for entry in expected:
        sign, index = entry[0], structure.index(entry[1:])
        value, spread = float(coefficients[index]), float(sigma[index])
        if spread > 0.0 and value * (1.0 if sign == "+" else -1.0) < -sure * spread:
            return Finding(
                "signs",
                f"{entry[1:]} is {value:.3g} +- {spread:.2g}, expected is {sign}: a {actuator} "
                "is connected the wrong way round; turn it, or its sign in actuators.mixing",
            )
    if not _swapped(structure, coefficients, sigma, sure):
        return None
    return Finding(
        "swapped",
        f"{both} are swapped: dr rolls the aircraft more than da does; exchange them in "
        "actuators.channels or actuators.mixing",
    )


def _swapped(
    structure: Structure, coefficients: FloatArray, sigma: FloatArray, sure: float
) -> bool:
    """Whether a rudder rolls more than the aileron does, and does not clearly yaw more.

    The true rudder's side force has no column under the aileron's name, so that the yaw of both
    is told apart late, if at all.
    """

    def exceeds(larger: str, smaller: str, sure: float) -> bool:
        i, j = structure.index(larger), structure.index(smaller)
        by = abs(coefficients.item(i)) - abs(coefficients.item(j))
        return by > sure * math.hypot(sigma.item(i), sigma.item(j))

    return exceeds("pdot/dr", "pdot/da", sure) and not exceeds("rdot/dr", "rdot/da", SURE)


# --- what settings that are off do to the derivatives ---------------------------------------------


class SetupError(NamedTuple):
    """What one setting that is off does to the moment rows."""

    errors: FloatArray  # (3, n) By how much it falsifies each coefficient, SI
    reason: str  # What is off, and the setting that would be right


class SetupErrors:
    """Follows which settings are off, a delay or a mounting, and what that does.

    Sigma is to cover it, and where it is much, the verdict names the setting. Without flow angles
    nothing is found, since every gust looks like a late input.
    """

    def __init__(
        self,
        structure: Structure,
        airspeed: float,  # At which the coefficients hold, m/s
    ) -> None:
        self._structure, self._airspeed = structure, airspeed
        self._found: list[SetupError] = []

    def look(
        self,
        values: FloatArray,  # (R, n) Coefficients
        estimate: DelayEstimate,  # What the flight says about the delay
        delay: float,  # In use, s
        lag: float,  # Of the servos, in use, s
        # Share of each input, (4,), that the lag takes away for which the delay may stand
        lost: Callable[[], FloatArray],
        height: float,  # Of the accelerometer above where it is said to be, m; 0 for none
        *,
        lag_is_told: bool,  # Whether it is known, or a found delay may stand for another
        # How much too long inputs are held that come seldom, s
        held: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """Look at what the flight shows by now."""
        self._found = []
        if not self._structure.has_flow:
            return
        late = max(abs(estimate.off(delay)), estimate.excess(lag))
        if late:
            reason = estimate.contradiction(delay, held())
            self._found.append(SetupError(self._late(values, late), reason))
        elif estimate.sure and (estimate.from_injected or not lag_is_told):
            self._found.append(self._lag_error(values, estimate, delay + lag, lost()))
        if height:
            self._found.append(self._height_error(values, height))

    def widened(self, sigma: FloatArray) -> FloatArray:
        """Return standard deviations (R, n) that cover it; 0 where a coefficient is fixed."""
        sigma = sigma.copy()
        moments = sigma[: len(ROWS)]
        for found in self._found:
            np.hypot(moments, found.errors, where=moments > 0.0, out=moments)
        return sigma

    def denied(self, values: FloatArray, t_ratio: float) -> list[str]:
        """Return for each moment row what falsifies it by more than 1 in `t_ratio`, if any."""
        reasons = [""] * len(ROWS)
        for found in self._found:
            far = t_ratio * found.errors[MAIN_DERIVATIVES] > np.abs(values[MAIN_DERIVATIVES])
            for row in np.flatnonzero(far).tolist():
                reasons[row] = reasons[row] or found.reason
        return reasons

    def _lag_error(
        self, values: FloatArray, estimate: DelayEstimate, in_use: float, lost: FloatArray
    ) -> SetupError:
        """Return what a servo lag does that the delay stands for, with their sum `in_use`, s.

        The delay makes the input as late. What the lag T takes from it stays: ``1 / (1 + a T)``
        where damping makes up for it, else what is `lost` of the input. Where what is injected has
        told the sum of delay and lag, only what that in use misses of it counts to first order:
        a lag and as much of delay differ by ``(a T)^2 / 2``.
        """
        hidden, settles = estimate.hidden, self._settles(values)
        share, missed, cure = np.abs(hidden * settles), 0.0, "or excite the aircraft (~/excite)"
        if estimate.from_injected:
            share, cure = 0.5 * share**2, "or go on with the excitation"
            missed = estimate.total - in_use
        errors = share[:, None] * np.abs(values[: len(ROWS)])
        inputs = errors[:, INPUT_COLUMNS]
        np.maximum(inputs, lost * np.abs(values[: len(ROWS), INPUT_COLUMNS]), out=inputs)
        errors += self._late(values, missed)
        return SetupError(
            errors,
            f"delay and servo lag are not separated: {1e3 * hidden:.0f} ms of the delay found may "
            f"be lag; set 'actuators.time_constant', {cure}",
        )

    def _late(self, values: FloatArray, time: float) -> FloatArray:
        """By how much an input that comes so late, s, falsifies the moment rows, (3, n).

        Before an axis that settles with a, an input that comes T later than told looks like one of
        an effect of 1 / (1 + a T): to first order the row is off by ``a T``.
        """
        share = np.abs(time * self._settles(values))
        return np.asarray(share[:, None] * np.abs(values[: len(ROWS)]))

    def _settles(self, values: FloatArray) -> FloatArray:
        """How fast each axis settles, 1/s, (3,)."""
        return damping(self._structure, values, self._airspeed)

    def _height_error(self, values: FloatArray, height: float) -> SetupError:
        """Return what an accelerometer does that is higher, m, than `imu.lever_arm` says.

        It measures ``ay + h pdot``. A row that takes sideslip from ay, with
        ``L = L_beta / Y_beta``, is off by ``L h`` times the row of pdot.
        """
        flow = self._structure.flow[0]
        slope = values[: len(ROWS), flow.angle] / values[flow.force, flow.angle]
        errors = np.abs(height * slope[:, None] * values[0])
        word = "above" if height > 0.0 else "below"
        return SetupError(
            errors,
            f"the position of the Imu is wrong: in rolls it measures as {abs(height):.2f} m {word} "
            "where 'imu.lever_arm' puts it; set that to its position from the centre of gravity",
        )
