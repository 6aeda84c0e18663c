# SPDX-License-Identifier: Apache-2.0
"""Plausibility checks: contradictions between the signals and the settings.

Gravity and rigid-body rotation hold in any manoeuvre. The specific force, averaged over seconds,
is one g upwards. Rotated by the gyro into one attitude it keeps this mean in turns, rolls and
loops, less the change of velocity, a few m/s^2 at most. Channels are checked for impossible
deflections, their effects for swapped or reversed surfaces. A finding gives problem, evidence and
cure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from uav_ident_ros.identification.delay import DelayEstimate
from uav_ident_ros.identification.exchange import ExchangedInputs
from uav_ident_ros.identification.frames import (
    BodyFrame,
    attitudes,
    euler_angles,
    rotation,
    rotations,
)
from uav_ident_ros.identification.gates import TickMeans
from uav_ident_ros.identification.gyro import GyroFilters, WrongAxes
from uav_ident_ros.identification.linearisation import damping
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.sampling import InputMap
from uav_ident_ros.identification.scales import (
    DOUBTLESS,
    GRAVITY_BAND,
    INDEPENDENT_TIME,
    LONG_MEMORY,
    MEMORY,
    RESPONSE_TIME,
    SAMPLE_TIME,
    SURE,
)
from uav_ident_ros.identification.settings import ImuSettings, Settings
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
"""Time before the first finding, s: a launch is over by then, and mistakes are named within 10 s.
Channels are checked over the same time."""

FORCE_WINDOW = 2.0 * ENOUGH
"""Time over which the rotated specific force is averaged, s: a change of velocity of 20 m/s is a
quarter of a g."""

LARGEST_TILT = math.cos(math.radians(60.0))
"""Cosine of the largest mean tilt of a flight: beyond it the mounting is wrong."""

GRAVITY_LEFT = 1.0 - GRAVITY_BAND
"""Length of a mean of unit directions, or of forces in g, from which these agree. It is shorter in
rolls and loops, and with a wrong gyro. With a correct one it is 0.9 or more on every known flight,
turbulence and turns included."""

SMALLEST_MEAN_RATE = 1.0 / RESPONSE_TIME
"""Mean angular rate from which a wrong unit is detectable, rad/s: at a lower rate the aircraft
turns by less than a radian in `RESPONSE_TIME`. No recorded flight with such a rate has as steady a
specific force."""

PULLING_SPEED = GRAVITY * ENOUGH
"""Airspeed V, m/s: a turn at the rate w has the specific force V w. If the specific force varies by
more than V times the rate read as deg/s, the unit is rad/s. (Quadrotors in aerobatics: 77 m/s and
more; aircraft whose gyro is in deg/s: at most 30.)"""

SMALLEST_FORCE, LARGEST_FORCE = 0.4 * GRAVITY, 6.0 * GRAVITY
"""Limits of the mean magnitude of the specific force, m/s^2: no flight is outside on average."""

LARGEST_TRIM = 0.6
"""Mean deviation from trim that no surface has for seconds, rad: 34 degrees."""

LARGEST_DEFLECTION = math.pi
"""Deflection that no surface reaches, rad."""

COUNTS = math.degrees(LARGEST_DEFLECTION)
"""Deviation from trim that is too large for degrees as well: the channel is in microseconds."""

INPUT_STEP = 0.02
"""Smallest step of an input that is not noise, rad or throttle."""

RETURNING_SHARE = 0.1
"""Share of samples reversed by the next one from which there are two publishers. All but as large a
share of the samples that differ from both neighbours are then reversed: 95 % and more with two
publishers, 35 to 83 % in the oscillations of real multirotors."""


@dataclass(frozen=True)
class Finding:
    """A contradiction between the signals and the settings."""

    name: str  # One word
    text: str  # Problem, evidence and cure
    # Whether learning is impossible until it is corrected; else it is a warning
    fault: bool = True


def clock_step(seconds: float) -> Finding:
    """Return the warning for stamps of the actuators that stepped by some seconds."""
    return Finding(
        "clock step",
        f"the stamps of the actuators stepped by {seconds:+.2f} s against the Imu's: it was taken "
        "back, so that what was learned still holds. Synchronise the clocks before the flight, not "
        "in it",
        fault=False,
    )


class Doubt(NamedTuple):
    """Hypothesis that channels are swapped or reversed, or axes of the Imu.

    No row is usable. It is dropped when it becomes the less likely. It is confirmed if it is
    significant again after `ENOUGH` s, beyond `DOUBTLESS` if it is about the axes.
    """

    since: float  # s
    finding: Finding  # With the evidence when it was last significant
    confirmed: bool = False


class Plausibility:
    """Checks of the signals for wrong units, axes, trim and channels."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._frame = BodyFrame(settings.imu)
        self._map = InputMap(settings.actuators)
        self._multirotor = settings.actuators.multirotor
        self.exchanged = ExchangedInputs()  # From the samples that are learned from
        # Integrals over time of direction (3), vector (3) and magnitude (1) of the specific force
        self._sums: FloatArray = np.zeros(7)
        self._time = 0.0
        self._found: dict[str, tuple[float, Finding]] = {}
        # All findings since the start, by name, in their latest form
        self.noted: dict[str, Finding] = {}
        self.restart()

    def restart(self) -> None:
        """Begin a new stretch of signals: drop the present findings, keep `noted`."""
        self._motion = TickMeans(FORCE_WINDOW)
        self._inputs: list[tuple[float, FloatArray]] = []
        self._began: float | None = None
        self._looked = -math.inf
        self._found.clear()
        # Text of the first fault of the signals, which prevents learning; empty if none
        self.signal_fault = ""
        # Whether the coefficients suggest swapped or reversed channels, confirmed or not
        self.doubt: Doubt | None = None
        # Reason against every row while other axes are more likely, significantly or not
        self.likely_axes = ""

    @property
    def findings(self) -> list[Finding]:
        """Present findings, faults first."""
        found = [f for _, f in self._found.values()]
        if self.doubt is not None and self.doubt.confirmed:
            found.append(self.doubt.finding)
        return sorted(found, key=lambda f: not f.fault)

    @property
    def fault(self) -> str:
        """Text of the first fault; empty if there is none."""
        doubt = self.doubt.finding.text if self.doubt and self.doubt.confirmed else ""
        return self.signal_fault or doubt

    def note(self, t: float, finding: Finding) -> None:
        """Add a finding of another module at `t` s."""
        self._found[finding.name] = t, finding
        self.noted[finding.name] = finding

    def judge(
        self,
        t: float,  # Time of the tick, s
        coefficients: FloatArray,
        sigma: FloatArray,
        gyro: GyroFilters | None = None,  # None without flow angles: rotors fly backwards as well
    ) -> None:
        """Check for reversed inputs, by the coefficients, swapped ones, and wrong axes."""
        settings, motors = self._settings, self._multirotor
        expected = settings.supervision.expected_signs
        known = STRUCTURES[settings.structure], coefficients, sigma, expected

        def find(share: float = 1.0) -> Finding | None:  # Of the significance that is needed
            return (
                sign_finding(*known, share * SURE, multirotor=motors)
                or exchange_finding(self.exchanged, share * SURE, multirotor=motors)
                or (_axes_finding(gyro.wrong_axes(share * SURE)) if gyro else None)
            )

        axes = _axes_finding(gyro.by_lift(0.0)) if gyro else None
        self.likely_axes = f"the axes of the gyro are unconfirmed: {axes.text}" if axes else ""
        if turned := turn_finding(self.exchanged, settings.imu):
            self.note(t, turned)
        found, before = find(), self.doubt
        if found is None:
            likely = before and find(share=0.0)
            if likely is None or before is None or likely.name != before.finding.name:
                self.doubt = None
        elif before is None or found.name != before.finding.name:
            self.doubt = Doubt(t, found)
        elif found.fault or not before.confirmed:
            confirmed = before.confirmed or t - before.since >= ENOUGH
            self.doubt = Doubt(before.since, found, confirmed and found.fault)

    def look(
        self,
        t: float,  # Time of the tick, s
        samples: FloatArray,  # (k, 6) Rates, rad/s, and specific forces, m/s^2, Imu axes
        raw: FloatArray,  # (j, N) Raw channels
    ) -> None:
        """Check the signals of a tick."""
        if self._began is None:
            self._began = self._looked = t
        self._motion.add(t, samples)
        if len(raw):
            self._inputs.append((t, raw))
        if t - self._looked < INDEPENDENT_TIME:
            return
        span, self._looked = t - self._looked, t
        self._inputs = [(time, values) for time, values in self._inputs if t - time <= ENOUGH]
        # Evidence depends on motion: a finding stays for `MEMORY` s after it was last seen.
        self._found = {n: f for n, f in self._found.items() if t - f[0] < MEMORY}
        found = [*self._check_motion(t, span), *self._check_inputs()]
        self._found.update({f.name: (t, f) for f in found if t - self._began >= ENOUGH})
        self.signal_fault = next((f.text for _, f in self._found.values() if f.fault), "")
        self.noted.update({f.name: f for f in self.findings})

    # -- gravity ---------------------------------------------------------------------------

    def _check_motion(self, t: float, span: float) -> list[Finding]:
        motion = self._motion.until(t)
        times, rates, force = motion[:, 0], motion[:, 1:4], motion[:, 4:]
        if len(times) < 2 or (np.abs(force - force[0]) <= 1e-9 * np.abs(force[0])).all():
            return []  # a constant value is not from an accelerometer
        recent = force[times > t - span]
        if len(recent):
            # The mean over the flight: settings are wrong from the start.
            own = self._frame.to_body(recent)
            size = np.linalg.norm(own, axis=1, keepdims=True)
            direction = own / np.maximum(size, 0.5 * GRAVITY)
            self._sums += span * np.concatenate([direction, own, size], axis=1).mean(axis=0)
            self._time += span
            if self._time > LONG_MEMORY:
                self._sums *= LONG_MEMORY / self._time
                self._time = LONG_MEMORY
        found = self._size() or self._mounting() or self._gyro_units(times, rates, force)
        return [found] if found else []

    def _size(self) -> Finding | None:
        """Return a finding if the specific force is in another unit or without gravity."""
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
        """Return a finding if mounting or axis convention of the Imu is wrong."""
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
        """Return the convention or mounting that makes the mean specific force point upwards."""
        own, imu, quarter = self._frame.to_imu(direction), self._settings.imu, 0.5 * math.pi

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
        """Return a finding if gravity is constant only for rates read as deg/s; any axes."""
        speed = float(np.mean(np.linalg.norm(rates, axis=1)))
        if times[-1] - times[0] < FORCE_WINDOW - INDEPENDENT_TIME or speed < SMALLEST_MEAN_RATE:
            return None
        if np.std(np.linalg.norm(force, axis=1)) > PULLING_SPEED * math.radians(speed):
            return None
        left = _gravity_left(times, rates, force)
        if left > GRAVITY_LEFT or _gravity_left(times, np.deg2rad(rates), force) < GRAVITY_LEFT:
            return None
        return Finding(
            "gyro units",
            f"the gyro looks like deg/s: it turns at {speed:.1f} rad/s on average, and turned back "
            f"by it the specific force of the last {FORCE_WINDOW:g} s is {left:.1f} g in place of "
            "1 g; convert the angular velocity to rad/s (REP-103)",
        )

    # -- channels --------------------------------------------------------------------------

    def _check_inputs(self) -> list[Finding]:
        if not self._inputs or self._inputs[-1][0] - self._inputs[0][0] < ENOUGH - INDEPENDENT_TIME:
            return []
        raw = np.concatenate([values for _, values in self._inputs])
        # Slower samples may show the oscillation of an attitude loop, near 5 Hz on a quadrotor.
        quick = len(raw) * SAMPLE_TIME >= self._inputs[-1][0] - self._inputs[0][0]
        u, without_trim = self._map.apply(raw), raw @ self._map.matrix.T
        learns_trim = self._settings.actuators.learn_trim_time > 0.0
        found: list[Finding] = []
        used = (u != u[0]).any(axis=0)  # constant inputs are not in use, or not armed yet
        for i in np.flatnonzero(used).tolist():
            name, own = INPUTS[i], u[:, i]
            if quick and (publishers := _interleaved(name, own)) is not None:
                found.append(publishers)
            if name != "dth":  # throttles come in all units, motor speeds among them
                found += _off_range(name, own, without_trim[:, i], learns_trim)
        return found


def _gravity_left(times: FloatArray, rates: FloatArray, force: FloatArray) -> float:
    """Return the magnitude, in g, of the mean specific force, rotated to the initial attitude."""
    back = np.einsum("kij,kj->i", attitudes(_durations(times), rates), force) / len(force)
    return float(np.linalg.norm(back)) / GRAVITY


def _durations(times: FloatArray) -> FloatArray:
    """Return the times since the previous ticks, s; a gap counts as one tick."""
    steps = np.diff(times, prepend=times[0])
    usual = float(np.median(steps[1:]))
    return np.where(steps > 4.0 * usual, usual, steps)


def _off_range(
    name: str, u: FloatArray, without_trim: FloatArray, learns_trim: bool
) -> Iterator[Finding]:
    """Yield findings on a surface's range: pulse widths, or trim or deflections in degrees.

    Where the trim is to be learned, deflections are taken about their median.
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
    """Return a finding if samples of two streams alternate: each step is reversed by the next."""
    step = np.abs(u[1:] - u[:-1])
    away = np.minimum(step[:-1], step[1:])
    if np.count_nonzero(away > INPUT_STEP) < RETURNING_SHARE * len(away):  # nearly always
        return None
    over_two = np.abs(u[2:] - u[:-2])
    differ = away > max(SURE * float(np.median(over_two)), INPUT_STEP)
    returns = differ & (away > SURE * over_two)
    share = float(np.mean(returns))
    # An oscillation reverses only some of its steps.
    if share < RETURNING_SHARE or returns.sum() < (1.0 - RETURNING_SHARE) * differ.sum():
        return None
    return Finding(
        "publishers",
        f"two publishers are on the actuator topic: {share:.0%} of the samples of {name} are taken "
        "back by the next one. See 'ros2 topic info --verbose', remap one of them",
    )


def sign_finding(
    structure: Structure,
    coefficients: FloatArray,
    sigma: FloatArray,
    expected: tuple[str, ...],  # Signs of control derivatives, as in ``+pdot/da``
    sure: float = SURE,  # Significance level, in standard deviations
    *,
    multirotor: bool = False,  # Whether the text names motors in place of surfaces
) -> Finding | None:
    """Return a finding if control derivatives have another sign than expected."""
    wrong = []
    for entry in expected:
        sign, index = entry[0], structure.index(entry[1:])
        value, spread = float(coefficients[index]), float(sigma[index])
        if spread > 0.0 and value * (1.0 if sign == "+" else -1.0) < -sure * spread:
            wrong.append(f"{entry[1:]} is {value:.3g} +- {spread:.2g}, expected is {sign}")
    if not wrong:
        return None
    actuator = "motor" if multirotor else "surface"
    cure = (
        f"a {actuator} is connected the wrong way round; turn it, or its sign in "
        "actuators.mixing. If that is right, an axis of the Imu is reversed: see imu.rpy"
    )
    if len(wrong) > 1:
        cure = "the Imu may point backwards; correct imu.rpy, or the signs in actuators.mixing"
    return Finding("signs", f"{', '.join(wrong)}: {cure}")


_ACTS = {"da": ("aileron", "rolls"), "de": ("elevator", "pitches"), "dr": ("rudder", "yaws")}
"""Of each main input the surface, and how it turns the aircraft."""


def exchange_finding(
    exchanged: ExchangedInputs,
    sure: float = SURE,  # Significance level, in standard deviations
    *,
    multirotor: bool = False,  # Whether the text names motors in place of surfaces
) -> Finding | None:
    """Return a finding if inputs act in the place of others: the structures do not show it."""
    if not (found := exchanged.found(sure)):
        return None
    what = " and ".join(_ACTS[instead][0] for _, instead in found) + " are swapped"
    if multirotor:
        what = "the motors are in another order"
    evidence = ", ".join(
        f"{acts} {_ACTS[instead][1]} the aircraft more than {instead} does"
        for acts, instead in found
    )
    return Finding(
        "swapped",
        f"{what}: {evidence}; exchange them in actuators.channels or actuators.mixing",
    )


def turn_finding(exchanged: ExchangedInputs, imu: ImuSettings) -> Finding | None:
    """Return a warning if inputs act on each other's axes as with an Imu that is turned."""
    if (turn := exchanged.turned()) is None:
        return None
    roll, yaw = turn.tolist()
    angles = [
        f"{math.degrees(angle):+.0f} deg in {axis}"
        for angle, axis in ((roll, "roll"), (yaw, "yaw"))
        if angle
    ]
    right = euler_angles(rotations(np.array([roll, 0.0, yaw])) @ rotation(*imu.rpy))
    rpy = ", ".join(f"{round(angle, 2) + 0.0:.2f}" for angle in right)  # Without -0.00
    return Finding(
        "turned",
        f"the Imu seems turned against the aircraft, by {' and '.join(angles)}: the elevator rolls "
        "or yaws it, or aileron and rudder pitch it. Mount it straight, or set imu.rpy to "
        f"[{rpy}]",
        fault=False,
    )


def _axes_finding(found: WrongAxes | None) -> Finding | None:
    """Return the finding for other axes of the Imu; None without them."""
    if not found:
        return None
    axes, sigma, evidence = found
    return Finding(
        "axes",
        f"{axes.problem}: {evidence}, by {sigma:.1f} standard deviations. {axes.cure}",
        fault=sigma > DOUBTLESS,
    )


# --- bias of the derivatives by wrong settings ----------------------------------------------------


class SetupError(NamedTuple):
    """Bias of the moment rows by one wrong setting."""

    errors: FloatArray  # (3, n) Magnitude of the bias of each coefficient, SI
    reason: str  # Problem, evidence and the correct setting


class SetupErrors:
    """Biases of the coefficients by a wrong delay, servo lag or accelerometer position.

    Sigma is increased by them; where they are large, the verdict names the setting. Structures
    without flow angles are not checked, since any gust resembles a late input.
    """

    def __init__(
        self,
        structure: Structure,
        airspeed: float,  # Reference airspeed of the coefficients, m/s
    ) -> None:
        self._structure, self._airspeed = structure, airspeed
        self._found: list[SetupError] = []

    def look(
        self,
        values: FloatArray,  # (R, n) Coefficients
        estimate: DelayEstimate,  # Estimated delay
        delay: float,  # Delay in use, s
        lag: float,  # Servo lag in use, s
        # Share of each input, (4,), that a lag hidden in the delay attenuates, for its length, s
        lost: Callable[[float], FloatArray],
        height: float,  # Of the accelerometer above its configured position, m; 0 for none
        *,
        lag_is_configured: bool,  # If not, the delay found may stand for another lag
        # Mean age of a held input, s
        held: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """Update the biases with the present estimates."""
        self._found = []
        if not (self._structure.has_flow or estimate.from_injected):
            return
        late = estimate.off(delay)
        if error := late or estimate.beyond(delay):
            reason = estimate.contradiction(delay, held())
            self._found.append(SetupError(self._delay_error(values, error), reason))
        hidden, missed = estimate.hidden, estimate.total - delay - lag
        if lag_is_configured:
            hidden, missed = estimate.lag_beyond(lag), estimate.total_beyond(delay + lag)
        if not estimate.from_injected:
            missed = 0.0
        applies = estimate.from_injected if lag_is_configured else not late
        if applies and estimate.sure and (hidden or missed):
            errors = self._lag_error(values, estimate, hidden, missed, lost(hidden))
            reason = estimate.lag_contradiction(lag, configured=lag_is_configured)
            self._found.append(SetupError(errors, reason))
        if height:
            self._found.append(self._height_error(values, height))

    def widened(self, sigma: FloatArray) -> FloatArray:
        """Return standard deviations (R, n) that include the biases; 0 if fixed."""
        sigma = sigma.copy()
        moments = sigma[: len(ROWS)]
        for found in self._found:
            np.hypot(moments, found.errors, where=moments > 0.0, out=moments)
        return sigma

    def denied(self, values: FloatArray, t_ratio: float) -> list[str]:
        """Return for each moment row the reason of a bias above 1 / `t_ratio`; empty if none."""
        reasons = [""] * len(ROWS)
        for found in self._found:
            far = t_ratio * found.errors[MAIN_DERIVATIVES] > np.abs(values[MAIN_DERIVATIVES])
            for row in np.flatnonzero(far).tolist():
                reasons[row] = reasons[row] or found.reason
        return reasons

    def _lag_error(
        self,
        values: FloatArray,
        estimate: DelayEstimate,
        hidden: float,  # Lag in the place of delay, s
        missed: float,  # Error of the sum of delay and lag in use, s
        lost: FloatArray,  # (4,) Share of each input that the hidden lag attenuates
    ) -> FloatArray:
        """Return the bias of the moment rows, (3, n), by a servo lag T that is modelled as delay.

        A delay has the phase of the lag, but not its attenuation: ``1 / (1 + a T)`` where
        damping compensates for it, else the share `lost` of the input. If an injected signal has
        determined the sum of delay and lag, lag and delay differ by ``(a T)^2 / 2`` only. The error
        of the sum in use then adds a term of first order.
        """
        damped = damping(self._structure, values, self._airspeed)
        share = np.abs(hidden * damped)
        if estimate.from_injected:
            share = 0.5 * share**2
        errors = share[:, None] * np.abs(values[: len(ROWS)])
        inputs = errors[:, INPUT_COLUMNS]
        np.maximum(inputs, lost * np.abs(values[: len(ROWS), INPUT_COLUMNS]), out=inputs)
        return np.asarray(errors + self._delay_error(values, missed))

    def _delay_error(self, values: FloatArray, time: float) -> FloatArray:
        """Return the bias of the moment rows, (3, n), by an input that is late by a time, s.

        On an axis with the damping a, an input that is late by T has the apparent effect
        1 / (1 + a T): to first order the relative bias is ``a T``.
        """
        share = np.abs(time * damping(self._structure, values, self._airspeed))
        return np.asarray(share[:, None] * np.abs(values[: len(ROWS)]))

    def _height_error(self, values: FloatArray, height: float) -> SetupError:
        """Return the bias by an accelerometer at a height h, m, above `imu.lever_arm`.

        It measures ``ay + h pdot``. A row that derives sideslip from ay, with
        ``L = L_beta / Y_beta``, has the bias ``L h`` times the row of pdot.
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
