# SPDX-License-Identifier: Apache-2.0
"""Gates: reasons to pause learning, such as an aircraft on the ground or a failed sensor.

The gates are a table: name, setting, predicate. Each evaluates the signals of a tick and returns
the reason to pause, or none. The ticks that it cost are counted under its name. Thresholds are
relative to the aircraft's own noise where possible. Two gates of single rows weigh their samples:
`ExcitationGate`, and by residual `Supervisor.weigh`.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.scales import (
    DOUBTLESS,
    IN_A_ROW,
    INDEPENDENT_TIME,
    LOOK_TIME,
    RESPONSE_TIME,
    REST_SWAY,
    SHORT_MEMORY,
    SURE,
    TINY,
)
from uav_ident_ros.identification.settings import ActuatorSettings, Settings, SupervisionSettings
from uav_ident_ros.identification.speed import slowest
from uav_ident_ros.identification.structure import INPUT_COLUMNS, BoolArray, FloatArray

NOISE_SWING = 2.0 * DOUBTLESS
"""Peak-to-peak swing of noise over two seconds, in standard deviations: `DOUBTLESS` both ways is
not exceeded, 3 to 6 is usual. In the smoothest flight the rates swing by 11 and more standard
deviations of the gyro's noise."""

CHANCE = math.erfc(SURE / math.sqrt(2.0))
"""Expected number below which an event is not due to chance: the tail beyond `SURE` sigma."""

IMU_SIGNALS = ("p", "q", "r", "ax", "ay", "az")
"""Signals of an Imu, in its own axes."""

SENSOR_AXES = 3
"""Signals of each sensor of an Imu."""

EXCITATION_TIME = RESPONSE_TIME + INDEPENDENT_TIME
"""Window of the input's variance, s: residuals of `INDEPENDENT_TIME` contain the response to the
inputs of this time, and a slow multisine still moves in it."""


class Look(NamedTuple):
    """Signals of one tick, as passed to the gates."""

    t: float  # Time of the tick, s
    # (k, 6) Rates, rad/s, and specific forces, m/s^2, of this tick, Imu axes
    samples: FloatArray
    raw: FloatArray  # (j, N) Raw channels that still affect the state of the filters
    airspeed: float | None  # True airspeed, m/s; None if there is none
    silence: str  # Reason why the airspeed is out of date; empty if it is not
    armed: bool | None  # Whether the motors are armed; None if no message has arrived
    adapt: bool  # Whether learning is switched on
    implausible: str  # Contradiction between signals and settings; empty if there is none
    settings: Settings  # All settings


class Gate(NamedTuple):
    """A reason not to learn."""

    name: str  # One or two words
    setting: str  # Name of the setting that opens it, or moves its threshold
    check: Callable[[Look], str]  # From a `Look` to the reason to pause; empty if there is none
    # Whether the signals are also unfit for scoring the coefficients while it is closed
    unreadable: bool = False


class Cost(NamedTuple):
    """Learning time that a gate has cost."""

    share: float  # Share of the ticks at which it prevented learning, 0 ... 1.
    setting: str  # Setting that belongs to it
    reason: str  # Its last reason


TOO_QUIET, TOO_FAR = "too little excitation", "residual far outside its usual size"

ROW_GATES: Mapping[str, tuple[str, str]] = {
    "excitation": ("supervision.min_excitation", TOO_QUIET),
    "residual": ("supervision.max_residual", TOO_FAR),
}
"""Gates of single rows, kept by the estimator and the supervisor: setting and reason."""


class Gates:
    """The table of gates, and the cost of each."""

    def __init__(self, more: Sequence[Gate] = ()) -> None:  # Additional gates
        self._more = more
        self._ticks = 0
        # Ticks that each gate cost; those of `ROW_GATES` as a share of all rows
        self.lost: defaultdict[str, float] = defaultdict(float)
        self._reasons = {name: reason for name, (_, reason) in ROW_GATES.items()}
        self.restart()

    def restart(self) -> None:
        """Begin a new stretch of signals; the counts stay."""
        self.closed = ""  # Reason to pause at this tick; empty if every gate is open
        self.unreadable = False  # Whether the signals of this tick must not be scored either
        self.table: tuple[Gate, ...] = (
            Gate("implausible", "supervision.plausibility", lambda look: look.implausible, True),
            Gate(
                "adaptation",
                "adapt_on_start",
                lambda look: "" if look.adapt else "adaptation is switched off",
            ),
            Gate(
                "ground",
                "supervision.min_airspeed",
                lambda look: grounded(look.settings, look.armed, look.airspeed),
                unreadable=True,
            ),
            Gate("airspeed", "airspeed.type", lambda look: look.silence, unreadable=True),
            Gate("Imu", "supervision.max_rate, stuck_time", SensorGate().check, unreadable=True),
            Gate(
                "channel limit",
                "actuators.lower_limit, upper_limit",
                lambda look: at_limit(look.raw, look.settings.actuators),
            ),
            Gate("rest", "supervision.min_motion, min_force_motion", RestGate().check),
            *self._more,
        )

    def look(self, look: Look) -> str:
        """Return the reason to pause; empty if none. The first closed gate is charged."""
        self._ticks += 1
        self.closed, self.unreadable = "", False
        for gate in self.table:  # all gates are evaluated, to keep their states up to date
            reason = gate.check(look)
            if not reason:
                continue
            self.unreadable = self.unreadable or gate.unreadable
            if not self.closed:
                self.closed = self._reasons[gate.name] = reason
                self.lost[gate.name] += 1.0
        return self.closed

    def costs(self) -> dict[str, Cost]:
        """Return the cost of each gate that was closed, by name, the highest first."""
        settings = {gate.name: gate.setting for gate in self.table}
        settings.update({name: setting for name, (setting, _) in ROW_GATES.items()})
        return {
            name: Cost(count / self._ticks, settings[name], self._reasons[name])
            for name, count in sorted(self.lost.items(), key=itemgetter(1), reverse=True)
            if count > 0
        }


class TickMeans:
    """Means of the Imu's signals over each of the newest ticks."""

    def __init__(self, span: float) -> None:  # Time for which they are kept, s
        self._span = span
        self._new: list[tuple[float, FloatArray]] = []
        self._means: FloatArray = np.empty((0, 1 + len(IMU_SIGNALS)))

    def add(self, t: float, samples: FloatArray) -> None:
        """Store the samples, (k, 6), of the tick at `t` s, if there are any."""
        if len(samples):
            self._new.append((t, samples))

    def until(self, t: float) -> FloatArray:
        """Return the means within the span before `t`: time, s, and the six signals, (n, 7).

        The means of all ticks since the last call are computed together.
        """
        if self._new:
            times, samples = zip(*self._new, strict=True)
            counts = np.array([len(own) for own in samples])
            new = np.empty((len(times), self._means.shape[1]))
            new[:, 0] = times
            np.add.reduceat(np.concatenate(samples), counts.cumsum() - counts, out=new[:, 1:])
            new[:, 1:] /= counts[:, None]
            self._means, self._new = np.concatenate((self._means, new)), []
        self._means = self._means[t - self._means[:, 0] <= self._span]
        return self._means


class Outliers:
    """Filter for samples of the Imu that no motion causes: glitches and spikes.

    A glitch is a gyro sample at the range for an instant. A spike is a single sample far beyond
    both neighbours. A sample between its neighbours stays; thus steps stay, however steep. The
    threshold is `NOISE_SWING` times the recent rms of the signal. A vibration at half the sampling
    rate reaches 2.8 times its rms.
    """

    def __init__(self) -> None:
        self._at_range = 0  # Number of consecutive samples at the range, up to the newest
        self._square: FloatArray = np.zeros(len(IMU_SIGNALS))
        self._time = 0.0
        # Last sample, and last one that was not a spike
        self._last: FloatArray | None = None
        self._kept: FloatArray = np.zeros(len(IMU_SIGNALS))

    def find(
        self,
        samples: FloatArray,  # (k, 6) New samples
        dt: float,  # Time that they cover, s
        max_rate: float,  # Range of the gyro, rad/s; 0 if it is not known: nothing is a glitch
    ) -> tuple[BoolArray | None, BoolArray | None]:
        """Return the masks of the glitches, and of the spikes among the others; None for none.

        The last sample has no successor yet: the last one that was not a spike stands in for it.
        """
        glitches = spikes = None
        rates = samples[:, :SENSOR_AXES]
        if len(samples) and np.maximum.reduce(np.abs(rates), None) >= max_rate > 0.0:
            glitches = np.zeros(len(samples), dtype=bool)
            for k, far in enumerate((np.abs(rates) >= max_rate).any(axis=1).tolist()):
                self._at_range = self._at_range + 1 if far else 0
                glitches[k] = 0 < self._at_range < IN_A_ROW
            samples = samples[~glitches]
        else:
            self._at_range = 0
        if not len(samples):
            return glitches, None
        if self._last is None:
            self._last = self._kept = samples[0]
        rows = np.concatenate((self._last[None], samples))
        if self._time >= INDEPENDENT_TIME:
            limit = NOISE_SWING * np.sqrt(self._square)
            if np.logical_or.reduce(np.abs(rows[1:] - rows[:-1]) > limit, axis=None):
                spikes = self._far(rows, limit)
        if spikes is None:
            self._kept = samples[-1]
        self._last = samples[-1]
        self._time = min(self._time + dt, SHORT_MEMORY)
        mean = np.add.reduce(samples * samples) / len(samples)
        self._square += dt / self._time * (mean - self._square)
        return glitches, spikes

    def _far(self, rows: FloatArray, limit: FloatArray) -> BoolArray | None:
        """Return the mask of the rows after the first that exceed both neighbours by `limit`."""
        which = np.zeros(len(rows) - 1, dtype=bool)
        for k in range(len(which)):
            before, here = rows[k], rows[k + 1]
            after = rows[k + 2] if k + 2 < len(rows) else self._kept
            beyond = (here < np.minimum(before, after) - limit) | (
                here > np.maximum(before, after) + limit
            )
            which[k] = beyond.any()
            if not which[k]:
                self._kept = here
        return which if which.any() else None


class SensorGate:
    """Gate that closes while a signal of the Imu is saturated or stuck, and shortly after.

    A working gyro is never still: a signal that has moved and then repeats one value is stuck.
    """

    def __init__(self) -> None:
        self._repeats = Repeats()
        self._last: list[float] = []
        self._moved = [math.inf] * len(IMU_SIGNALS)  # Time of the last change of each, s
        # Of each rate: the largest magnitude so far, and the range detected from it
        self._largest, self._range = [0.0] * SENSOR_AXES, [math.inf] * SENSOR_AXES
        self._bad_until = -math.inf
        self._reason = ""

    def check(self, look: Look) -> str:
        """Return the reason to pause; empty if there is none."""
        t, samples, settings = look.t, look.samples, look.settings.supervision
        if len(samples):
            self._last = self._last or samples[0].tolist()
            self._repeats.add(samples)
            high = np.maximum.reduce(samples).tolist()
            low = np.minimum.reduce(samples).tolist()
            size = [max(high[i], -low[i]) for i in range(SENSOR_AXES)]
            stuck = self._stuck(t, high, low, settings.stuck_time)
            self._last = samples[-1].tolist()
            problem = _at_range(size, [settings.max_rate or math.inf] * SENSOR_AXES) or stuck
            if not problem:
                # A range below the configured one: a rate repeats its largest value so far.
                for i, largest in enumerate(size):
                    if largest > self._range[i]:
                        self._range[i] = math.inf
                    self._largest[i] = max(self._largest[i], largest)
                    if self._moved[i] < math.inf and abs(self._last[i]) >= self._largest[i]:
                        stays = self._repeats.present[i] >= IN_A_ROW - 1
                        if stays and self._repeats.by_chance()[i] < CHANCE:
                            self._range[i] = self._largest[i]
                problem = _at_range(size, self._range)
            if problem:
                self._reason, self._bad_until = problem, t + INDEPENDENT_TIME
        return self._reason if t < self._bad_until else ""

    def _stuck(self, t: float, high: list[float], low: list[float], stuck_time: float) -> str:
        """Detect a signal that has moved and repeats one value for unusually long."""
        still = []
        for i, last in enumerate(self._last):
            if not low[i] == last == high[i]:
                self._moved[i] = t
            elif t - self._moved[i] > stuck_time > 0.0:
                still.append(i)
        chance = self._repeats.by_chance() if still else ()
        stuck = [i for i in still if chance[i] < CHANCE]
        if not stuck:
            return ""
        self._repeats.strange[stuck] = True
        signal = IMU_SIGNALS[stuck[0]]
        return f"the Imu is stuck: {signal} has not changed for {stuck_time:g} s or more"


def _at_range(size: list[float], limits: list[float]) -> str:
    """Return the reason to pause if a rate is at its range; else empty."""
    for signal, value, limit in zip(IMU_SIGNALS, size, limits, strict=False):
        if value >= limit:
            return f"the gyro is saturated: {signal} reaches {limit:g} rad/s"
    return ""


class Repeats:
    """Statistics of the runs of equal values in each signal of the Imu.

    A signal that is coarsely rounded, or slowly logged, repeats its value while it is quiet.
    """

    def __init__(self) -> None:
        self._waiting: list[FloatArray] = []  # The last counted sample, then those not counted yet
        self._present: FloatArray = np.zeros(len(IMU_SIGNALS))
        # Number of the runs that have ended, and of the repeats in them
        self._runs: FloatArray = np.zeros(len(IMU_SIGNALS))
        self._repeats: FloatArray = np.zeros(len(IMU_SIGNALS))
        self._changes: FloatArray = np.ones(len(IMU_SIGNALS))
        # Signals whose present run is not counted: it was stuck, or has not changed since the start
        self.strange: BoolArray = np.ones(len(IMU_SIGNALS), dtype=bool)

    def add(self, samples: FloatArray) -> None:
        """Add new samples, (k, 6); those of many ticks are counted together."""
        self._waiting = self._waiting or [samples[:1]]
        self._waiting.append(samples)
        if len(self._waiting) > IN_A_ROW**2:  # only memory depends on this number
            self._count()

    @property
    def present(self) -> FloatArray:
        """Number of repeats in the present run of each signal, (6,)."""
        self._count()
        return self._present

    def _count(self) -> None:
        """Count the waiting samples."""
        if len(self._waiting) < 2:
            return
        samples = np.concatenate(self._waiting)
        self._waiting = [samples[-1:]]
        same = samples[1:] == samples[:-1]
        changed: BoolArray = ~np.logical_and.reduce(same)
        repeats = np.add.reduce(same)
        before = np.where(changed, same.argmin(axis=0), len(same))
        after = np.where(changed, same[::-1].argmin(axis=0), len(same))
        ended = self._present + before
        counts = changed & ~self.strange
        starts = np.add.reduce(same[1:] & ~same[:-1]) - (after > 0)
        self._runs += np.where(changed, starts, 0) + (counts & (ended > 0))
        self._repeats += np.where(changed, repeats - before - after, 0) + counts * ended
        self._changes += len(same) - repeats
        self._present = np.where(changed, after, ended)
        self.strange &= ~changed

    def by_chance(self) -> FloatArray:
        """Return the expected number of runs as long as the present one by chance, (6,).

        The probabilities of a repeat after a change, and after a repeat, are the observed
        frequencies. Before a second repeat is observed the former replaces the latter. The axes of
        a sensor have the same rounding, so the largest probability holds for all of them.
        """
        present, runs = self.present, self._runs + 1.0
        first = runs / (self._changes + 1.0)
        another = (self._repeats - self._runs + first) / (self._repeats + 1.0)
        another = np.repeat(another.reshape(-1, SENSOR_AXES).max(axis=1), SENSOR_AXES)
        return np.asarray(runs * another ** (present - 1.0))


class RestGate:
    """Gate that closes while nothing moves: on the ground, inputs have no effect.

    Motion is a swing of the rates above the gyro's noise. A large aircraft in smooth flight turns
    slowly, but more than that; an aircraft at rest does not.
    """

    def __init__(self) -> None:
        self._means = TickMeans(RESPONSE_TIME)
        self._looked = -math.inf
        self._reason = ""
        self._begun = False

    def check(self, look: Look) -> str:
        """Return the reason to pause; empty if there is none."""
        t, samples, settings = look.t, look.samples, look.settings.supervision
        if self._begun:  # the first tick may have one sample alone, which is noisier
            self._means.add(t, samples)
        self._begun = self._begun or len(samples) > 0
        # It opens at once, and closes at the next check only.
        if not self._reason and t - self._looked < LOOK_TIME:
            return ""
        means = self._means.until(t)[:, 1:]
        if len(means):
            self._looked = t
            swing = np.maximum.reduce(means) - np.minimum.reduce(means)
            rate, what = float(swing[:SENSOR_AXES].max()), ""
            if rate < settings.min_motion and rate < max(
                REST_SWAY, NOISE_SWING * _noise(means[:, :SENSOR_AXES])
            ):
                what = "no rate moves beyond the gyro's noise"
            elif swing[SENSOR_AXES:].max() < settings.min_force_motion:
                what = f"no specific force has moved by {settings.min_force_motion:g} m/s^2"
            flies = look.airspeed is not None and look.airspeed > slowest(look.settings.airspeed)
            self._reason = what and f"{'too quiet' if flies else 'at rest'}: {what}"
        return self._reason


def _noise(rates: FloatArray) -> float:
    """Return the noise of rates (k, 3) on the worst axis, from second differences, rad/s."""
    if len(rates) < 3:
        return math.inf
    second = rates[2:] - 2.0 * rates[1:-1] + rates[:-2]
    return float(np.sqrt(np.mean(second * second, axis=0).max() / 6.0))


def at_limit(raw: FloatArray, settings: ActuatorSettings) -> str:
    """Return the reason to pause if a channel is at its limit: its surface may not follow.

    The values, (k, N), are those that still affect the state of the filters.
    """
    if not len(raw) or not (settings.lower_limit or settings.upper_limit):
        return ""
    low, high = settings.lower_limit or -np.inf, settings.upper_limit or np.inf
    at = np.logical_or.reduce((raw <= np.array(low)) | (raw >= np.array(high)))
    return f"channel {settings.channels[int(at.argmax())]} is at its limit" if at.any() else ""


class ExcitationGate:
    """Excitation of the rows, and the weight that follows.

    A row learns while at least one of its inputs is excited. Its weight falls with the excitation.
    In quiet flight the autopilot's surfaces answer the gusts, and an estimator that goes on
    learning identifies the autopilot. Forgetting by direction does not help; less weight of the
    whole row does. A switch in the place of the weight starves the instruments on a flight with
    little excitation.
    """

    def __init__(
        self,
        free: BoolArray,  # (3, n) Coefficients that are estimated: their inputs count
        settings: SupervisionSettings,  # May change at any time
    ) -> None:
        self.settings = settings
        self._watched: BoolArray = free[:, INPUT_COLUMNS]
        self._blind: BoolArray = ~self._watched.any(axis=1)
        # Of each update: time, and the integrals of u, u^2 and the squared residuals
        self._window: deque[FloatArray] = deque()
        self._window_time = 0.0
        self._since_look = 0.0
        # Baseline: the mean variance of each input while learning, and the time of this
        self._usual: FloatArray = np.zeros(4)
        self._usual_time: FloatArray = np.zeros(4)
        # Variance that the inputs explain in each row, relative to that of the residual
        self.signal: FloatArray = np.zeros(3)
        self.weight: FloatArray = np.ones(3)  # Weight of each row, 0 ... 1
        self.learning: BoolArray = np.ones(3, dtype=bool)  # Rows of full weight
        # Those of them in which the inputs explain more than all else together. In a storm an
        # autopilot's answers resemble a change, and large residuals are no reason to learn.
        self.clear: BoolArray = np.ones(3, dtype=bool)

    def update(
        self,
        samples: Regression,
        residual: FloatArray,  # (m, 3) Of the samples, rad/s^2
        coefficients: FloatArray,  # (3, n) The present estimate
    ) -> FloatArray:
        """Return the weight of samples in the rows, shape (3,)."""
        u = samples.f[:, INPUT_COLUMNS]
        signals = np.concatenate((np.ones((len(u), 1)), u, u * u, residual * residual), axis=1)
        self._window.append(samples.dt * np.add.reduce(signals))
        self._since_look += samples.time
        if self._since_look >= LOOK_TIME - 0.5 * samples.dt or len(self._window) == 1:
            self._look(coefficients[:, INPUT_COLUMNS])
        return self.weight

    def _look(self, effect: FloatArray) -> None:
        """Compare the inputs' variance with its baseline and with the residuals."""
        elapsed, self._since_look = self._since_look, 0.0
        self._window_time += elapsed
        while self._window_time > EXCITATION_TIME and len(self._window) > 1:
            self._window_time -= self._window.popleft()[0]
        sums = np.add.accumulate(np.array(self._window)[::-1])
        means = sums[-1] / sums[-1, 0]
        # The residuals of the newest part only: a gust front then shows at once.
        newest = sums[sums[:-1, 0].searchsorted(INDEPENDENT_TIME)]
        variance = np.maximum(means[5:9] - means[1:5] ** 2, 0.0)
        # Relative to the largest variance, one wild manoeuvre would close the gate for an ordinary
        # flight.
        share = np.divide(variance, self._usual, out=np.ones(4), where=self._usual > 0.0)
        residual = np.maximum(newest[9:] / newest[0], TINY)
        self.signal = (self._watched * effect**2) @ variance / residual
        enough = max(self.settings.min_excitation, TINY)
        liveliest = np.maximum.reduce(self._watched * share, axis=1) / enough
        liveliest[self._blind] = 1.0
        # The square: the samples' information falls as the inputs' variance, feedback's bias does
        # not.
        self.weight = np.minimum(liveliest, 1.0) ** 2
        self.learning = self.weight == 1.0
        self.clear = self.learning & (self.signal >= 1.0)
        counted = np.logical_or.reduce(self._watched & self.learning[:, None])
        spent = elapsed * counted
        self._usual_time += spent
        self._usual += spent / np.maximum(self._usual_time, elapsed) * (variance - self._usual)


def grounded(settings: Settings, armed: bool | None, airspeed: float | None) -> str:
    """Return the reason why the aircraft is not flying; empty if there is none.

    None stands for a value that has not arrived; the airspeed is the true one, m/s.
    """
    if settings.armed.type and not armed:
        return "not armed" if armed is not None else "no message says that it is armed"
    if airspeed is None:
        return ""
    if airspeed < (least := settings.supervision.min_airspeed):
        return f"not flying: the airspeed is below {least:g} m/s"
    if airspeed < (slow := slowest(settings.airspeed)):
        return (
            f"not flying: the airspeed is below {slow:.2g} m/s, a third of 'airspeed.reference'; "
            "in flight look at the pitot tube, or set that to the speed flown"
        )
    return ""
