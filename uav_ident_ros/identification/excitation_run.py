# SPDX-License-Identifier: Apache-2.0
"""A run of excitation: its start, its limits, its end, and the value to inject at each tick."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.samples import NS, NS_PER_S
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
    """Information gained in a run of excitation, and the time until it suffices.

    Under steady excitation information grows linearly in time: 1 / sigma^2 = I_0 + k t, with the
    information before the run in I_0. The time until a required sigma follows from it.

    A coefficient is known if its sigma is below its value over the required t-ratio. A small
    coefficient is also known if its sigma is that small relative to the largest known one of its
    kind in the row. The kinds: control derivatives of excited inputs, rate and flow derivatives.
    """

    def __init__(
        self,
        structure: Structure,
        excited: tuple[str, ...],  # Labels of the excited inputs
        wanted: float,  # Required t-ratio
    ) -> None:
        self._names, self._wanted = structure.names, wanted
        self._rows, self._columns = np.array(structure.free).T
        labels = np.array(structure.regressors)[self._columns]
        # Places of the coefficients of each kind in each moment row, and of all control derivatives
        self._kinds = [
            np.flatnonzero((self._rows == row) & np.isin(labels, kind))
            for row in range(len(ROWS))
            for kind in (excited, RATES, FLOW_ANGLES)
        ]
        self._controls = np.flatnonzero((self._rows < len(ROWS)) & np.isin(labels, INPUTS)).tolist()
        self._start: tuple[int, FloatArray] | None = None
        self.unknown: tuple[str, ...] = ()
        """Names of the coefficients that are not known yet."""
        self.time_left = math.inf
        """Time of excitation until the slowest of them is known, s; inf if it is unpredictable."""
        self.effects: dict[str, tuple[str, float, float]] = {}
        """For each input with an effect its control derivative of largest t-ratio, value, sigma."""

    def update(self, t_ns: int, coefficients: FloatArray, sigma: FloatArray) -> None:
        """Update the state with the estimate of a tick."""
        values, sigmas = (a[self._rows, self._columns] for a in (coefficients, sigma))
        limits = self._limits(np.abs(values), sigmas)
        unknown = sigmas > limits
        self.unknown = tuple(name for name, u in zip(self._names, unknown, strict=True) if u)
        self.time_left = self._time_left(t_ns, sigmas, limits, unknown)
        self._record_effects(values, sigmas)

    def _limits(self, values: FloatArray, sigmas: FloatArray) -> FloatArray:
        """Return the sigma below which each coefficient is known; inf for those not required."""
        limits = np.full(len(values), math.inf)
        for kind in self._kinds:
            # only known coefficients set the scale of the others of their kind
            sure = values[kind] >= self._wanted * sigmas[kind]
            scale = values[kind].max(initial=0.0, where=sure)
            limits[kind] = np.maximum(values[kind], scale) / self._wanted
        return limits

    def _time_left(
        self, t_ns: int, sigmas: FloatArray, limits: FloatArray, unknown: BoolArray
    ) -> float:
        """Return the time until the slowest of the unknown coefficients is known, s."""
        with np.errstate(divide="ignore"):
            information = 1.0 / np.square(sigmas)
            needed = 1.0 / np.square(limits)
        if self._start is None:
            self._start = t_ns, information
        if not unknown.any():
            return 0.0
        start_ns, before = self._start
        span = (t_ns - start_ns) * NS
        gained = information[unknown] - before[unknown]
        if span < RESPONSE_TIME or (gained <= 0.0).any():
            return math.inf
        return float(((needed - information)[unknown] / gained).max() * span)

    def _record_effects(self, values: FloatArray, sigmas: FloatArray) -> None:
        """Record for each input the control derivative of largest t-ratio, from `SURE` on."""
        surest: dict[str, float] = {}
        for k in self._controls:
            value, deviation = values.item(k), sigmas.item(k)
            name = self._names[k].partition("/")[2]
            ratio = abs(value) / deviation if deviation > 0.0 else 0.0
            if ratio > max(surest.get(name, 0.0), SURE):
                surest[name] = ratio
                self.effects[name] = self._names[k], value, deviation


# --- the run --------------------------------------------------------------------------------------


ZERO_TIME_NS = round(2e9 * EXCITATION_TIMEOUT)
"""Time for which zeros are sent after a run, ns, in case the first one is lost."""


class Phase(StrEnum):
    """Phase of a run."""

    IDLE = "idle"
    RUNNING = "running"
    ENDING = "fading out"


@dataclass(frozen=True)
class Flying:
    """Measured flight state, which is compared with the limits of a run."""

    rates: FloatArray | None  # (3,) Newest measured p, q, r, rad/s; None before any
    # Attitude, rad; None if it is not known
    roll: float | None = None
    pitch: float | None = None
    airspeed: float | None = None  # True airspeed, m/s; None if it is not known
    grounded: str = ""  # Reason why the aircraft is not flying; empty if none

    def beyond(self, limits: ExcitationSettings) -> str:
        """Return the problem if a limit is exceeded; else empty."""
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
    """Values that the controller adds to the inputs."""

    t_ns: int  # Message time from which they hold, ns
    values: FloatArray  # (4,) de, dr, da, dth, in the units of the inputs


class ExcitationRun:
    """Source of programmed inputs, while the flight is within limits and coefficients are unknown.

    It has no clock: `start`, `step` and `abort` receive the message time. After a run it outputs
    zeros for `ZERO_TIME_NS`, and then nothing.
    """

    def __init__(self, structure: Structure) -> None:
        self._structure = structure
        self.phase = Phase.IDLE
        self.why = ""  # Reason for the end of the last run; empty before and during one
        self.sufficiency: Sufficiency | None = None  # Of the present or last run
        self._input: ProgrammedInput | None = None
        self._start_ns = self._now_ns = self._end_ns = 0
        self._zeros_until_ns: int | None = 0  # None from the end of a run to the next tick

    @property
    def active(self) -> bool:
        """Whether a run is going on: other values than zero may be output."""
        return self.phase is not Phase.IDLE

    @property
    def elapsed(self) -> float:
        """Time since the start of the run, s."""
        return max(0.0, (self._now_ns - self._start_ns) * NS) if self._input else 0.0

    @property
    def remaining(self) -> float:
        """Time until the latest end of the run, s; 0 while there is none."""
        return self._input.duration - self.elapsed if self._input and self.active else 0.0

    def start(self, settings: ExcitationSettings, flying: Flying, estimate: Estimate) -> str:
        """Begin a run after a tick, with settings that hold until its end.

        Returns the reason for a refusal, or an empty string.
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
        self._lead_ns = round(settings.lead * NS_PER_S)
        self._now_ns, self._start_ns = estimate.t_ns, estimate.t_ns + self._lead_ns
        names = self._input.names
        self.sufficiency = Sufficiency(self._structure, names, settings.min_t_ratio or math.inf)
        self.phase, self.why = Phase.RUNNING, ""
        return ""

    def abort(self, t_ns: int, why: str) -> Injection:
        """End the run at once; return an injection of zero, which holds from `t_ns`."""
        if self.active:
            self.phase, self.why = Phase.IDLE, why
        self._now_ns, self._zeros_until_ns = t_ns, None
        return Injection(t_ns, np.zeros(len(INPUTS)))

    def step(self, flying: Flying, estimate: Estimate) -> Injection | None:
        """Return the injection requested at a tick; None if nothing is to be sent."""
        t_ns = estimate.t_ns
        if not self.active:  # zero for a moment after a run, then nothing
            if self._zeros_until_ns is None:
                self._zeros_until_ns = t_ns + ZERO_TIME_NS
            if not 0 <= self._zeros_until_ns - t_ns <= ZERO_TIME_NS:  # over, or the clock went back
                self._zeros_until_ns = 0
                return None
            return Injection(t_ns, np.zeros(len(INPUTS)))
        assert self._input is not None and self.sufficiency is not None
        self._now_ns = t_ns
        problem = _problem(self._settings, flying, estimate)
        if problem:
            return self.abort(t_ns, f"aborted: {problem}")
        self.sufficiency.update(t_ns, estimate.coefficients, estimate.sigma)
        unknown = ", ".join(self.sufficiency.unknown)
        enough = self._settings.min_t_ratio > 0.0 and not unknown
        t = (t_ns + self._lead_ns - self._start_ns) * NS
        if self.phase is Phase.RUNNING and t >= self._input.period and enough:
            self.phase, self._end_ns = Phase.ENDING, t_ns
            self.why = f"everything is known after {self.elapsed:.0f} s"
        share = self._share(t_ns)
        if t >= self._input.duration or share <= 0.0:
            known = f"not known yet: {unknown}" if unknown else "everything is known"
            self.abort(t_ns, self.why or f"complete; {known}")
        return Injection(t_ns + self._lead_ns, self._input.sample(t) * share)

    def _share(self, t_ns: int) -> float:
        """Return the factor of the signal while it fades out early, 0 ... 1."""
        if self.phase is not Phase.ENDING:
            return 1.0
        since = (t_ns - self._end_ns) * NS
        fade = self._settings.fade_time
        return max(0.0, 1.0 - since / fade) if fade > 0.0 else 0.0


def _problem(settings: ExcitationSettings, flying: Flying, estimate: Estimate) -> str:
    """Return the reason why nothing must be injected now; empty if none."""
    if estimate.state in (State.WAITING, State.FAULT):
        return f"{estimate.state}: {estimate.reason}"
    return flying.beyond(settings)
