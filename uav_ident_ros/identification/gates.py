# SPDX-License-Identifier: Apache-2.0
"""When not to learn: on the ground, and while the signals cannot be what they say.

The gates are a table: name, setting, predicate. Each looks at the signals of a tick and gives the
reason to pause, or none, and what it cost is counted under its name. Thresholds are relative to
this aircraft's own noise where there is a choice. Whether the inputs excite the aircraft at all is
another question: `estimators.excitation`.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from uav_ident_ros.identification.scales import LONG_MEMORY, LOOK_TIME, OUTLYING
from uav_ident_ros.identification.settings import (
    ActuatorSettings,
    Settings,
    SupervisionSettings,
)
from uav_ident_ros.identification.structure import BoolArray, FloatArray

HOLD_TIME = 0.5
"""Time for which bad signals echo in the filters, s: more than five of the default filter's
time constants. It pauses for so long after the last bad sample."""

REST_TIME = 2.0
"""Time over which motion is looked for, s: a turning aircraft has moved by then."""

REST_NOISE = 8.0
"""Swing of the rates, relative to the gyro's noise, up to which nothing moves: noise alone swings
by 3 to 6, aircraft in the smoothest flight by 11 and more."""

REST_SWAY = 0.01
"""Swing of the rates of an aircraft that stands, rad/s: wind and an idling engine rock it."""

GLITCH = 0.25
"""Jump of a rate from one sample to the next, relative to the gyro's range, that no aircraft
makes: 9 rad/s within milliseconds."""

LONGEST_GLITCH = 3
"""Samples in a row that are a glitch; the next ones are a gyro at its range."""

SIGNALS = ("p", "q", "r", "ax", "ay", "az")
"""What an Imu measures, in its own axes."""

KNOWN_RESIDUAL = 10.0
"""Time after which there is a usual size, s."""

RECENT_TIME = 2.0
"""Memory of the present size of the residuals, s."""

LARGEST_GROWTH = 4.0
"""Squared residual, relative to what is usual, as which larger ones are counted in the usual."""


class Look(NamedTuple):
    """What the gates see of a tick."""

    t: float  # Time of the tick, s
    # (k, 6) Rates, rad/s, and specific forces, m/s^2, that came with it, Imu axes
    samples: FloatArray
    raw: FloatArray  # (j, N) Values of the channels that are still at work in the filters
    airspeed: float | None  # True airspeed, m/s; None if there is none
    armed: bool | None  # Whether the motors are armed; None if nothing was heard of it
    adapt: bool  # Whether learning is switched on
    implausible: str  # What cannot be as the settings say; empty if nothing
    settings: Settings  # All settings


class Gate(NamedTuple):
    """A reason not to learn."""

    name: str  # One or two words
    setting: str  # Name of the setting that opens it, or moves its threshold
    check: Callable[[Look], str]  # From a `Look` to the reason to pause; empty if there is none
    # Whether the signals then tell nothing of the coefficients either: no score is kept
    unreadable: bool = False


class Cost(NamedTuple):
    """What a gate has cost."""

    share: float  # Share of the ticks at which it kept from learning, 0 ... 1.
    setting: str  # Setting that goes with it
    reason: str  # The last reason that it gave


TOO_QUIET, TOO_FAR = "too little excitation", "residual far outside its usual size"

ROW_GATES: Mapping[str, tuple[str, str]] = {
    "excitation": ("supervision.min_excitation", TOO_QUIET),
    "residual": ("supervision.max_residual", TOO_FAR),
}
"""Gates of single rows, kept by the estimator and the supervisor: setting and reason."""


class Gates:
    """The table of gates, and what each of them has cost.

    Parameters
    ----------
    settings : Settings
        Channels and their limits.
    more : sequence of Gate
        Gates of one's own, beside those of the table.

    Attributes
    ----------
    closed : str
        Why nothing is learned at this tick; empty if every gate is open.
    unreadable : bool
        Whether the signals of this tick must not be scored either.
    """

    def __init__(self, settings: Settings, more: Sequence[Gate] = ()) -> None:
        self._limits, self._more = LimitGate(settings.actuators), more
        self._ticks = 0
        self._closed: Counter[str] = Counter()
        self._reasons = {name: reason for name, (_, reason) in ROW_GATES.items()}
        self.restart()

    def restart(self) -> None:
        """Begin a new stretch of signals; what was counted stays."""
        sensors, rest = SensorGate(), RestGate()
        self.closed, self.unreadable = "", False
        self.table: tuple[Gate, ...] = (
            Gate("implausible", "supervision.plausibility", lambda look: look.implausible, True),
            Gate("adaptation", "adapt_on_start", _switched_off),
            Gate("ground", "supervision.min_airspeed", _grounded),
            Gate(
                "Imu",
                "supervision.max_rate, stuck_time",
                lambda look: sensors.check(look.t, look.samples, look.settings.supervision),
                unreadable=True,
            ),
            Gate(
                "channel limit",
                "actuators.lower_limit, upper_limit",
                lambda look: self._limits.check(look.raw),
            ),
            Gate(
                "rest",
                "supervision.min_motion, min_force_motion",
                lambda look: rest.check(look.t, look.samples, look.settings.supervision),
            ),
            *self._more,
        )

    def look(self, look: Look) -> str:
        """Return why to pause; empty if there is no reason. The first closed gate is charged."""
        # Every gate sees every tick, whichever of them is closed.
        reasons = [(gate, gate.check(look)) for gate in self.table]
        closed = [(gate, reason) for gate, reason in reasons if reason]
        self._ticks += 1
        self.closed = closed[0][1] if closed else ""
        self.unreadable = any(gate.unreadable for gate, _ in closed)
        if closed:
            name = closed[0][0].name
            self._closed[name] += 1
            self._reasons[name] = self.closed
        return self.closed

    def charge(self, name: str, ticks: float) -> None:
        """Count a gate of `ROW_GATES` that kept some rows from ticks, in ticks of all rows."""
        self._closed[name] += ticks  # type: ignore[assignment]

    def costs(self) -> dict[str, Cost]:
        """Return what each gate has cost so far, by name, the dearest first; those that did."""
        settings = {gate.name: gate.setting for gate in self.table}
        settings.update({name: setting for name, (setting, _) in ROW_GATES.items()})
        return {
            name: Cost(count / self._ticks, settings[name], self._reasons[name])
            for name, count in self._closed.most_common()
            if count > 0
        }


def _switched_off(look: Look) -> str:
    return "" if look.adapt else "adaptation is switched off"


def _grounded(look: Look) -> str:
    has_topic = look.settings.armed.type != ""
    return grounded(look.armed, has_topic, look.airspeed, look.settings.supervision.min_airspeed)


def largest(values: FloatArray) -> float:
    """Return the largest magnitude."""
    return float(np.maximum.reduce(np.abs(values), axis=None))


class GlitchFilter:
    """Leaves out samples of the gyro that are at its range for an instant, which no aircraft is."""

    def __init__(self) -> None:
        self._run = 0

    def find(self, rates: FloatArray, before: FloatArray | None, max_rate: float) -> BoolArray:
        """Return which samples are glitches, shape (k,); of a longer saturation the first alone.

        Parameters
        ----------
        rates : (k, 3) array
            New rates, rad/s, Imu axes.
        before : (3,) array or None
            The rates before them; None if there are none.
        max_rate : float
            Range of the gyro, rad/s; 0 if it is not known, and nothing is a glitch.
        """
        out = np.zeros(len(rates), dtype=bool)
        if max_rate <= 0.0 or not len(rates) or largest(rates) < max_rate:
            self._run = 0
            return out
        for k, sample in enumerate(rates):
            if largest(sample) < max_rate:
                before, self._run = sample, 0
                continue
            self._run += 1
            if before is not None and self._run <= LONGEST_GLITCH:
                out[k] = largest(sample - before) > GLITCH * max_rate
        return out


class SensorGate:
    """Closed while a signal of the Imu is saturated or stuck, and shortly after.

    A gyro that works is never still: a signal that has moved and then repeats one value is
    not measured any more.
    """

    def __init__(self) -> None:
        self._last: FloatArray | None = None
        self._constant_since: FloatArray = np.zeros(6)
        self._moved: BoolArray = np.zeros(6, dtype=bool)
        self._bad_until = -np.inf
        self._reason = ""

    def check(self, t: float, samples: FloatArray, settings: SupervisionSettings) -> str:
        """Return why to pause; empty if there is no reason.

        Parameters
        ----------
        t : float
            Time of the tick, s.
        samples : (k, 6) array
            Rates, rad/s, and specific forces, m/s^2, that came with this tick, Imu axes.
        settings : SupervisionSettings
            Range of the gyro, and how long a signal may repeat itself.
        """
        if len(samples):
            problem = self._stuck(t, samples, settings.stuck_time)
            problem = self._saturated(samples, settings.max_rate) or problem
            if problem:
                self._reason, self._bad_until = problem, t + HOLD_TIME
        return self._reason if t < self._bad_until else ""

    def _saturated(self, samples: FloatArray, max_rate: float) -> str:
        if max_rate <= 0.0:
            return ""
        if largest(samples[:, :3]) < max_rate:
            return ""
        signal = SIGNALS[int(np.abs(samples[:, :3]).max(axis=0).argmax())]
        return f"the gyro is saturated: {signal} reaches {max_rate:g} rad/s"

    def _stuck(self, t: float, samples: FloatArray, stuck_time: float) -> str:
        before = samples[:1] if self._last is None else self._last
        changed = np.logical_or.reduce(samples != before)
        self._last = samples[-1:]
        if np.logical_and.reduce(changed):  # nearly always
            self._constant_since.fill(t)
            self._moved.fill(True)
            return ""
        self._moved |= changed
        self._constant_since[changed] = t
        stuck = self._moved & (t - self._constant_since > stuck_time)
        if stuck_time <= 0.0 or not stuck.any():
            return ""
        signal = int(stuck.argmax())
        return f"the Imu is stuck: {SIGNALS[signal]} has not changed for {stuck_time:g} s or more"


class RestGate:
    """Closed while nothing moves: on the ground, inputs have no effect to learn.

    What counts as motion stands out from the gyro's noise. A large aircraft in smooth flight turns
    slowly, but does; an aircraft that stands does not.
    """

    def __init__(self) -> None:
        self._ticks: deque[tuple[float, FloatArray]] = deque()
        self._looked = -np.inf
        self._reason = ""
        self._begun = False

    def check(self, t: float, samples: FloatArray, settings: SupervisionSettings) -> str:
        """Return why to pause; empty if there is no reason; parameters as in `SensorGate`."""
        if len(samples):
            if self._begun:  # the first tick may have one sample alone, which is noisier
                self._ticks.append((t, np.add.reduce(samples) / len(samples)))
            self._begun = True
        while self._ticks and t - self._ticks[0][0] > REST_TIME:
            self._ticks.popleft()
        # It opens at once, and closes when it next looks.
        if self._ticks and (self._reason or t - self._looked >= LOOK_TIME):
            self._looked = t
            self._reason = self._at_rest(settings.min_motion, settings.min_force_motion)
        return self._reason

    def _at_rest(self, min_motion: float, min_force_motion: float) -> str:
        means = np.concatenate([mean for _, mean in self._ticks]).reshape(-1, 6)
        swing = np.maximum.reduce(means) - np.minimum.reduce(means)
        rate = float(swing[:3].max())
        if rate < min_motion and rate < max(REST_SWAY, REST_NOISE * _noise(means[:, :3])):
            return "at rest: no rate moves beyond the gyro's noise"
        if swing[3:].max() < min_force_motion:
            return f"at rest: no specific force has moved by {min_force_motion:g} m/s^2"
        return ""


def _noise(rates: FloatArray) -> float:
    """Noise of rates (k, 3) in the unit of theirs, from second differences; of the worst axis."""
    if len(rates) < 3:
        return math.inf
    second = rates[2:] - 2.0 * rates[1:-1] + rates[:-2]
    return float(np.sqrt(np.mean(second * second, axis=0).max() / 6.0))


class LimitGate:
    """Closed while a channel is at its limit: there the surface need not follow the command.

    Parameters
    ----------
    settings : ActuatorSettings
        The channels and their limits.
    """

    def __init__(self, settings: ActuatorSettings) -> None:
        self._names: Sequence[int | str] = settings.channels
        n = len(settings.channels)
        self._low = np.array(settings.lower_limit or (-np.inf,) * n)
        self._high = np.array(settings.upper_limit or (np.inf,) * n)
        self._limited = bool(settings.lower_limit or settings.upper_limit)

    def check(self, raw: FloatArray) -> str:
        """Return why to pause; empty if there is no reason.

        Parameters
        ----------
        raw : (k, N) array
            Values of the channels that are still at work in the filters.
        """
        if not self._limited or not len(raw):
            return ""
        at_limit = np.logical_or.reduce((raw <= self._low) | (raw >= self._high))
        if not at_limit.any():
            return ""
        return f"channel {self._names[int(at_limit.argmax())]} is at its limit"


class ResidualGate:
    """Keeps what is far from usual away from coefficients that were good.

    Samples count less the further their residuals are above the usual size, and not at all far
    beyond it, or where the inputs no longer stand out: then it is a storm, and they answer it.
    The usual size grows slowly, and never in a storm, however long that lasts.
    """

    def __init__(self) -> None:
        self._rows = (_RowResidual(), _RowResidual(), _RowResidual())

    def release(self, row: int) -> None:
        """Learn anew what is usual in a row."""
        self._rows[row].time = 0.0

    def weigh(
        self, residual: FloatArray, dt: float, max_residual: float, clear: BoolArray
    ) -> FloatArray:
        """Return how much the samples of a tick count in each row, shape (3,), 0 ... 1.

        Parameters
        ----------
        residual : (m, 3) array
            Their residuals, rad/s^2.
        dt : float
            Time that they stand for, s.
        max_residual : float
            Residual, relative to its usual size, that is too much; 0 for none.
        clear : (3,) bool array
            Rows in which the inputs stand out from all else that moves the aircraft.
        """
        squares = (np.add.reduce(residual * residual) / len(residual)).tolist()
        weights = [
            row.weigh(square, dt, max_residual, clear=stands_out)
            for row, square, stands_out in zip(self._rows, squares, clear.tolist(), strict=True)
        ]
        return np.array(weights)


@dataclass
class _RowResidual:
    """Mean squares of the residuals of one row, rad^2/s^4; plain floats, since there are few."""

    # usual, recent: Over a long and over a short time
    usual: float = 0.0
    recent: float = 0.0
    time: float = 0.0  # Time over which the usual one was taken, s

    def weigh(self, square: float, dt: float, max_residual: float, *, clear: bool) -> float:
        """Return how much samples with the mean square `square` count, 0 ... 1."""
        usual = self.usual if self.time >= KNOWN_RESIDUAL else math.inf
        self.time = min(self.time + dt, LONG_MEMORY)
        clipped = min(square, (LARGEST_GROWTH if clear else 1.0) * usual)
        self.usual += dt / self.time * (clipped - self.usual)
        if max_residual <= 0.0:
            return 1.0
        limit = max_residual * max_residual * usual
        # No knock is so hard that it is remembered for more than a few seconds.
        recent = min(square, LARGEST_GROWTH * limit)
        self.recent += min(dt / RECENT_TIME, 1.0) * (recent - self.recent)
        largest = max(square, self.recent)
        if largest <= OUTLYING * usual:
            return 1.0
        return OUTLYING * usual / largest if clear and largest <= limit else 0.0


def grounded(
    armed: bool | None, has_armed_topic: bool, airspeed: float | None, min_airspeed: float
) -> str:
    """Return why it does not fly; empty if there is no reason to think so.

    Parameters
    ----------
    armed : bool or None
        Whether the motors are armed; None if nothing was heard of it.
    has_armed_topic : bool
        Whether there is a topic that tells.
    airspeed : float or None
        True airspeed, m/s; None if there is none.
    min_airspeed : float
        Airspeed below which it does not fly, m/s.
    """
    if has_armed_topic and not armed:
        return "not armed" if armed is not None else "nothing was heard of being armed"
    if airspeed is not None and airspeed < min_airspeed:
        return f"not flying: the airspeed is below {min_airspeed:g} m/s"
    return ""
