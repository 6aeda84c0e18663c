# SPDX-License-Identifier: Apache-2.0
"""A replayed flight, notes on its bag, and summary.json.

The same bag gives the same bytes.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.identification.delay import DelayEstimate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.linearisation import Mode, level_modes
from uav_ident_ros.identification.prediction import HORIZONS, PredictionFit
from uav_ident_ros.identification.samples import NS
from uav_ident_ros.identification.structure import RATES, ROWS, FloatArray
from uav_ident_ros.messages.streams import STREAMS
from uav_ident_ros.offline.advice import advise
from uav_ident_ros.offline.evidence import FIT_WINDOWS, Evidence
from uav_ident_ros.offline.inputs import candidates
from uav_ident_ros.offline.run import OfflineRun
from uav_ident_ros.report.flight import ReplayedFlight

MISSING_TIME = 1.0
"""Time without actuators at the beginning or the end that is reported, s."""


def notes_on(bag: Bag, run: OfflineRun) -> Iterator[str]:
    """Yield notes on a replayed bag: damage, unread topics, mixed frames, missing actuators."""
    yield from bag.damage
    yield from _other_sensors(bag, run)
    yield from _mixed_frames(run)
    yield from _missing_actuators(run)


def _other_sensors(bag: Bag, run: OfflineRun) -> Iterator[str]:
    """Yield notes on unread topics that fit an input."""
    taken = run.inputs.streams
    for stream in STREAMS:
        if not stream.setting:
            continue  # many topics are JointState: the type is no evidence
        others = [topic for topic in candidates(bag, stream.types) if topic not in taken.values()]
        if stream.name in taken and others:
            yield (
                f"{taken[stream.name]} was read; the bag also has {', '.join(others)}: "
                f"--topic {stream.topic}:={others[0]} reads that instead"
            )
        elif stream.name not in taken:
            for topic in others:
                if stream.topic in topic:  # only the name is evidence of such common types
                    yield f"{topic} was not read: --topic {stream.topic}:={topic} reads it"


def _mixed_frames(run: OfflineRun) -> Iterator[str]:
    """Yield a note if two sensors share a topic."""
    if len(run.frame_ids) > 1:
        frames = ", ".join(f"'{frame}'" for frame in sorted(run.frame_ids))
        yield (
            f"{run.inputs.streams['rates']} has messages of several frames, {frames}: if these are "
            "two sensors, record them on two topics"
        )


def _missing_actuators(run: OfflineRun) -> Iterator[str]:
    """Yield notes on actuators that start late or stop early."""
    flown = run.flown()
    imu, actuators = flown.t_ns, flown.inputs.t_ns
    if not len(actuators):
        topic = run.inputs.streams["actuators"]
        problem = run.problems("actuators") or "nothing is learned"
        yield f"{topic} has no messages that could be used: {problem}"
        return
    late, early = int(actuators[0] - imu[0]) * NS, int(imu[-1] - actuators[-1]) * NS
    if late > MISSING_TIME:
        yield f"the actuators start {late:.1f} s after the Imu: nothing is learned before"
    if early > MISSING_TIME:
        yield f"the actuators stop {early:.1f} s before the Imu: nothing is learned after"


# --- the results ----------------------------------------------------------------------------------


SUMMARY_VERSION = 2


@dataclass(frozen=True)
class Replayed:
    """A replayed flight with its scores, measured quantities and notes."""

    name: str  # Name of the flight
    bag: Path  # Path of the bag
    run: OfflineRun  # The replay, with at least one estimate
    fits: Mapping[str, PredictionFit]  # Score of record, by windows
    evidence: Evidence  # Measured quantities of the flight
    # Notes on the bag: damage, topics that were not read, inputs that end early
    notes: tuple[str, ...] = ()

    @property
    def doubt(self) -> str:
        """Reason why a controller should not use the model; empty if it may.

        It follows from the verdict of the last tick that learned, and from a score of record that
        is worse than holding the rates.
        """
        judged, score = self.run.judged, self.fits[FIT_WINDOWS]
        if not judged.usable:
            return judged.reason or "the verdict of the last tick that learned"
        worse = [axis for axis, lost in zip(RATES, score.model < score.hold, strict=True) if lost]
        if worse:
            return f"over the last part of the flight {', '.join(worse)} loses to holding the rate"
        return ""

    @cached_property
    def flight(self) -> ReplayedFlight:
        """The flight on one clock, for charts."""
        return ReplayedFlight(self.run)

    @cached_property
    def modes(self) -> list[Mode]:
        """Modes in level flight at the last airspeed; none without flow angles or learning."""
        last = self.run.estimates[-1]
        if not any(estimate.adapting for estimate in self.run.estimates):
            return []
        airspeed = last.flow.airspeed if last.flow is not None else 0.0
        return level_modes(self.run.structure, last.coefficients, last.sigma, airspeed)

    @cached_property
    def summary(self) -> dict[str, Any]:
        """Content of summary.json, in plain values."""
        run = self.run
        content: dict[str, Any] = _json(
            {
                "version": SUMMARY_VERSION,
                "bag": self.name,
                "ticks": len(run.estimates),
                "first_tick_ns": run.estimates[0].t_ns,
                "last_tick_ns": run.estimates[-1].t_ns,
                "frame_id": run.frame_id,
                "inputs": _inputs(run),
                **self._verdict(),
                **_signals(run.identifier),
                "structure": run.structure.name,
                "coefficients": _coefficients(run),
                "modes": [_mode(mode) for mode in self.modes],
                "notes": self.notes,
                "advice": [advice._asdict() for advice in advise(self.evidence)],
                "prediction_fit": {windows: _fit(fit) for windows, fit in self.fits.items()},
                "settings": run.inputs.settings.values(),
            }
        )
        return content

    def _verdict(self) -> dict[str, Any]:
        """Return state and verdict at the end, and the share of the ticks with a usable row."""
        run, last = self.run, self.run.estimates[-1]
        usable = np.mean([estimate.usable_rows for estimate in run.estimates], axis=0)
        return {
            "state": last.state,
            "reason": last.reason,
            "fault": run.fault,
            "judged_ns": run.judged.t_ns,
            "usable": not self.doubt,
            "doubt": self.doubt,
            "usable_rows": dict(zip(ROWS, run.judged.usable_rows, strict=True)),
            "usable_share": dict(zip(ROWS, usable, strict=True)),
        }


def _inputs(run: OfflineRun) -> dict[str, Any]:
    """Return topic, type and counts of each stream that was read."""
    topics, settings = run.inputs.streams, run.inputs.settings
    return {
        name: {
            "topic": topics[name],
            "type": stream.type_of(settings),
            **asdict(run.refusals(name)),
        }
        for stream in STREAMS
        if (name := stream.name) in topics
    }


def _signals(identifier: OnlineIdentifier) -> dict[str, Any]:
    """Return what was found about the signals: gates, implausible ones, delay and lag."""
    costs = identifier.supervisor.gates.costs()
    return {
        "gates": {name: cost._asdict() for name, cost in costs.items()},
        "implausible": [found.text for found in identifier.plausibility.noted.values()],
        "delay": identifier.delay,
        "delay_sigma": identifier.delay_estimate.sigma,
        "delay_confidence": identifier.delay_estimate.confidence,
        "servo_lag": _servo_lag(identifier.delays.estimate, identifier.lag),
    }


def _coefficients(run: OfflineRun) -> dict[str, Any]:
    """Return value and standard deviation of each free coefficient at the end."""
    result = run.result()
    return {
        name: {"value": result.values[index], "sigma": result.sigma[index]}
        for name, index in run.structure.places.items()
    }


def _servo_lag(found: DelayEstimate, in_use: float) -> dict[str, float] | None:
    """Return the lag with its delay; None if the flight does not separate them."""
    if not found.lag_sure:
        return None
    return {
        "value": found.lag,
        "sigma": found.lag_sigma,
        "delay": found.total - found.lag,
        "in_use": in_use,
    }


def _json(value: Any) -> Any:
    """Return plain values: JSON has no tuples, no NumPy numbers, no NaN and no infinity."""
    if isinstance(value, Mapping):
        return {key: _json(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_json(entry) for entry in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return bool(value) if isinstance(value, np.bool_) else value


def _fit(fit: PredictionFit) -> dict[str, Any]:
    def by_axis(values: FloatArray) -> dict[str, float]:
        return dict(zip(RATES, values, strict=True))

    return {
        "unit": "percent",
        "windows": fit.windows,
        "samples": fit.samples,
        "model": by_axis(fit.model),
        "hold": by_axis(fit.hold),
        "model_with_measured_forces": by_axis(fit.measured_force),
        "free": {
            f"{horizon:g} s": {"model": by_axis(model), "hold": by_axis(hold)}
            for horizon, model, hold in zip(HORIZONS, fit.free, fit.free_hold, strict=True)
        },
    }


def _mode(mode: Mode) -> dict[str, Any]:
    numbers = {name: value for name, value in asdict(mode).items() if isinstance(value, float)}
    return {
        "name": mode.name,
        "eigenvalue": [mode.eigenvalue.real, mode.eigenvalue.imag],
        **numbers,
    }
