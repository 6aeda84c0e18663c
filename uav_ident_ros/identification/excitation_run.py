# SPDX-License-Identifier: Apache-2.0
"""A run of excitation: started, watched, ended; what is asked of the controller at each tick."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.scales import RESPONSE_TIME, SURE
from uav_ident_ros.identification.settings import EXCITATION_TIMEOUT, ExcitationSettings
from uav_ident_ros.identification.structure import (
    FLOW_ANGLES,
    INPUTS,
    RATES,
    ROWS,
    BoolArray,
    FloatArray,
    Structure,
)
from uav_ident_ros.identification.supervision import State
from uav_ident_ros.identification.waveforms import ProgrammedInput, WaveformError


class Sufficiency:
    """Follows what a run of excitation teaches, and when it will be enough.

    Under steady excitation information grows with time: 1 / sigma^2 = I_0 + k t, with what was
    known before the run in I_0. So the run itself says when a wanted sigma will be reached.

    A coefficient is known when it, or else the largest of its kind in its row, is the wanted
    number of sigmas: what is next to nothing need not be told from nothing. Of a kind are the
    control derivatives of the excited inputs, the rate derivatives, and those of the flow angles.
    """

    def __init__(
        self,
        structure: Structure,
        excited: tuple[str, ...],  # The inputs that are
        wanted: float,  # Value over sigma
    ) -> None:
        self._names = structure.names
        self._free = structure.free
        self._wanted = wanted
        kinds = (excited, RATES, FLOW_ANGLES)
        self._kinds = [
            [
                k
                for k, (i, j) in enumerate(self._free)
                if i == row and structure.regressors[j] in kind
            ]
            for row in range(len(ROWS))
            for kind in kinds
        ]
        self._controls = [
            k for k, (i, j) in enumerate(self._free)
            if i < len(ROWS) and structure.regressors[j] in INPUTS
        ]  # fmt: skip
        self._start: tuple[int, FloatArray] | None = None
        self.unknown: tuple[str, ...] = ()
        """Names of the coefficients that are not known yet."""
        self.time_left = math.inf
        """Time of excitation that the slowest of them still takes, s; inf if it cannot be told."""
        self.effects: dict[str, tuple[str, float, float]] = {}
        """Of every input seen to act: its surest control derivative, value and sigma."""

    def update(self, t_ns: int, coefficients: FloatArray, sigma: FloatArray) -> None:
        """Look at the estimate of a tick."""
        rows, columns = np.array(self._free).T
        values, sigmas = np.abs(coefficients[rows, columns]), sigma[rows, columns]
        limits = self._limits(values, sigmas)
        unknown = sigmas > limits
        self.unknown = tuple(name for name, u in zip(self._names, unknown, strict=True) if u)
        self.time_left = self._time_left(t_ns, sigmas, limits, unknown)
        self._see_effects(coefficients, sigma)

    def _limits(self, values: FloatArray, sigmas: FloatArray) -> FloatArray:
        """Sigma from which each coefficient is known; inf for those that nobody asks for."""
        limits = np.full(len(values), math.inf)
        for kind in self._kinds:
            # only what is itself known says how large the others of its kind may be
            sure = [k for k in kind if values[k] >= self._wanted * sigmas[k]]
            scale = max((values[k] for k in sure), default=0.0)
            for k in kind:
                limits[k] = max(values[k], scale) / self._wanted
        return limits

    def _time_left(
        self, t_ns: int, sigmas: FloatArray, limits: FloatArray, unknown: BoolArray
    ) -> float:
        """Seconds until the slowest of the unknown coefficients is known."""
        with np.errstate(divide="ignore"):
            information = 1.0 / np.square(sigmas)
            needed = 1.0 / np.square(limits)
        if self._start is None:
            self._start = t_ns, information
        if not unknown.any():
            return 0.0
        start_ns, before = self._start
        span = (t_ns - start_ns) * 1e-9
        gained = information[unknown] - before[unknown]
        if span < RESPONSE_TIME or (gained <= 0.0).any():
            return math.inf
        return float(((needed - information)[unknown] / gained).max() * span)

    def _see_effects(self, coefficients: FloatArray, sigma: FloatArray) -> None:
        """Note what each input is seen to do."""
        surest: dict[str, float] = {}
        for k in self._controls:
            i, j = self._free[k]
            value, deviation = float(coefficients[i, j]), float(sigma[i, j])
            name = self._names[k].partition("/")[2]
            ratio = abs(value) / deviation if deviation > 0.0 else 0.0
            if ratio > max(surest.get(name, 0.0), SURE):
                surest[name] = ratio
                self.effects[name] = self._names[k], value, deviation


# --- the run --------------------------------------------------------------------------------------


ZERO_TIME_NS = round(2e9 * EXCITATION_TIMEOUT)
"""How long zeros follow a run, ns, before it is silent: for a listener that missed the first."""


class Phase(StrEnum):
    """What a run is doing, in a word."""

    IDLE = "idle"
    RUNNING = "running"
    ENDING = "fading out"


@dataclass(frozen=True)
class Flying:
    """What is known of the flight, to hold against the limits."""

    rates: FloatArray | None  # (3,) Newest measured p, q, r, rad/s; None before any
    # roll, pitch: Attitude, rad; None if it is not known
    roll: float | None = None
    pitch: float | None = None
    airspeed: float | None = None  # True airspeed, m/s; None if it is not known
    grounded: str = ""  # Why it does not fly; empty if there is no reason to think so

    def beyond(self, limits: ExcitationSettings) -> str:
        """Return which limit is passed, in words; empty if none is."""
        if self.rates is None:
            return "no rates are measured"
        if self.grounded:
            return self.grounded
        for name, rate in zip(("roll", "pitch", "yaw"), self.rates.tolist(), strict=True):
            if not abs(rate) <= limits.max_rate:  # NaN fails too
                return f"{name} rate {rate:.2f} rad/s: the limit is {limits.max_rate:g}"
        for name, angle in (("roll", self.roll), ("pitch", self.pitch)):
            if angle is not None and not abs(angle) <= limits.max_attitude:
                return f"{name} angle {angle:.2f} rad: the limit is {limits.max_attitude:g}"
        if self.airspeed is not None:
            highest = limits.max_airspeed or math.inf
            if not limits.min_airspeed <= self.airspeed <= highest:
                allowed = f"{limits.min_airspeed:g} to {highest:g}"
                return f"airspeed {self.airspeed:.1f} m/s: the limits are {allowed}"
        return ""


@dataclass(frozen=True)
class Injection:
    """What the controller is asked to add."""

    t_ns: int  # Message time from which it counts, ns
    values: FloatArray  # (4,) de, dr, da, dth, in the units of the inputs


class ExcitationRun:
    """Asks for programmed inputs while that is safe and still teaches something.

    It knows no clock: `start`, `step` and `abort` are told the message time. Between two runs it
    asks for zero for a moment, and then for nothing.
    """

    def __init__(self, structure: Structure) -> None:
        self._structure = structure
        self.phase = Phase.IDLE
        self.why = ""  # How the last run ended; empty before and during one
        self.sufficiency: Sufficiency | None = None  # What the run, or the last one, has taught
        self._input: ProgrammedInput | None = None
        self._start_ns = self._now_ns = self._end_ns = self._zeros_until_ns = 0

    @property
    def active(self) -> bool:
        """Whether anything but zero may be asked for."""
        return self.phase is not Phase.IDLE

    @property
    def elapsed(self) -> float:
        """Time since the start of the run, s."""
        return max(0.0, (self._now_ns - self._start_ns) * 1e-9) if self._input else 0.0

    @property
    def remaining(self) -> float:
        """Time until the run ends by itself at the latest, s; 0 while there is none."""
        return self._input.duration - self.elapsed if self._input and self.active else 0.0

    def start(self, settings: ExcitationSettings, flying: Flying, estimate: Estimate) -> str:
        """Begin a run after a tick, by settings that hold to its end.

        Returned is why that cannot be, or an empty word.
        """
        if self.active:
            return f"a run is going on, for {self.elapsed:.0f} s"
        if not any(settings.amplitude):
            return "'excitation.amplitude' is 0 for every input: nothing would move"
        problem = _problem(settings, flying, estimate)
        if problem:
            return problem
        try:
            self._input = ProgrammedInput(settings)
        except WaveformError as error:
            return f"'excitation.band': {error}"
        self._settings = settings
        self._lead_ns = round(settings.lead * 1e9)
        self._now_ns, self._start_ns = estimate.t_ns, estimate.t_ns + self._lead_ns
        names = self._input.names
        self.sufficiency = Sufficiency(self._structure, names, settings.min_t_ratio or math.inf)
        self.phase, self.why = Phase.RUNNING, ""
        return ""

    def abort(self, t_ns: int, why: str) -> Injection:
        """End the run at once; return the zero that says so, which counts from `t_ns`."""
        if self.active:
            self.phase, self.why = Phase.IDLE, why
        self._now_ns = t_ns
        self._zeros_until_ns = t_ns + ZERO_TIME_NS
        return Injection(t_ns, np.zeros(len(INPUTS)))

    def step(self, flying: Flying, estimate: Estimate) -> Injection | None:
        """Return what to ask for at a tick; None where silence is right."""
        t_ns = estimate.t_ns
        if not self.active:  # zero for a moment after a run, then nothing
            done = t_ns > self._zeros_until_ns
            return None if done else Injection(t_ns, np.zeros(len(INPUTS)))
        assert self._input is not None and self.sufficiency is not None
        self._now_ns = t_ns
        problem = _problem(self._settings, flying, estimate)
        if problem:
            return self.abort(t_ns, f"aborted: {problem}")
        self.sufficiency.update(t_ns, estimate.coefficients, estimate.sigma)
        unknown = ", ".join(self.sufficiency.unknown)
        enough = self._settings.min_t_ratio > 0.0 and not unknown
        t = (t_ns + self._lead_ns - self._start_ns) * 1e-9
        if self.phase is Phase.RUNNING and t >= self._input.period and enough:
            self.phase, self._end_ns = Phase.ENDING, t_ns
            self.why = f"everything is known after {self.elapsed:.0f} s"
        share = self._share(t_ns)
        if t >= self._input.duration or share <= 0.0:
            known = f"not known yet: {unknown}" if unknown else "everything is known"
            self.abort(t_ns, self.why or f"complete; {known}")
        return Injection(t_ns + self._lead_ns, self._input.sample(t) * share)

    def _share(self, t_ns: int) -> float:
        """Return what is left of the signal while it fades out early, 0 ... 1."""
        if self.phase is not Phase.ENDING:
            return 1.0
        since = (t_ns - self._end_ns) * 1e-9
        fade = self._settings.fade_time
        return max(0.0, 1.0 - since / fade) if fade > 0.0 else 0.0


def _problem(settings: ExcitationSettings, flying: Flying, estimate: Estimate) -> str:
    """Return why nothing must be injected now; empty if there is no reason."""
    if estimate.state in (State.WAITING, State.FAULT):
        return f"{estimate.state}: {estimate.reason}"
    return flying.beyond(settings)
