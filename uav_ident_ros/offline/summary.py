# SPDX-License-Identifier: Apache-2.0
"""A flight that was replayed, and summary.json: the same bytes for the same bag."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from uav_ident_ros.identification.linearisation import Mode, level_modes
from uav_ident_ros.identification.prediction import HORIZONS, PredictionFit
from uav_ident_ros.identification.structure import ROWS
from uav_ident_ros.messages.streams import STREAMS
from uav_ident_ros.offline.advice import Advice
from uav_ident_ros.offline.inputs import Inputs
from uav_ident_ros.offline.run import OfflineRun

SUMMARY_VERSION = 2
AXES = ("p", "q", "r")

VERDICT_WINDOWS = "last_40_percent"
"""The windows of the score that the verdict must not contradict."""


@dataclass(frozen=True)
class Replayed:
    """Everything that the results of a replay are made of."""

    name: str  # Name of the flight
    run: OfflineRun  # The replay, with at least one estimate
    fits: Mapping[str, PredictionFit]  # Its score of record, by windows
    # What the bag is like: damage, topics that were not read, inputs that end early
    notes: tuple[str, ...] = ()
    advice: tuple[Advice, ...] = ()  # What to do about the model

    @property
    def doubt(self) -> str:
        """Why a controller should not act on the model; empty if it may.

        The verdict of the last tick, unless the score beside it loses to holding the rates.
        """
        last = self.run.estimates[-1]
        if not last.usable:
            return last.reason or "the verdict of the last tick"
        score = self.fits[VERDICT_WINDOWS]
        worse = [
            axis
            for axis, model, hold in zip("pqr", score.model, score.hold, strict=True)
            if model < hold
        ]
        if worse:
            return f"over the last part of the flight {', '.join(worse)} loses to holding the rate"
        return ""

    def modes(self) -> list[Mode]:
        """Return the modes of the model, level at the airspeed flown; none without flow angles."""
        last = self.run.estimates[-1]
        airspeed = last.flow.airspeed if last.flow is not None else 0.0
        return level_modes(self.run.structure, last.coefficients, last.sigma, airspeed)


def summarise(replayed: Replayed) -> dict[str, Any]:
    """Return everything worth keeping about a replay, ready for JSON."""
    run = replayed.run
    last = run.estimates[-1]
    result = run.result()
    settings = run.inputs.settings
    return {
        "version": SUMMARY_VERSION,
        "bag": replayed.name,
        "ticks": len(run.estimates),
        "first_tick_ns": run.estimates[0].t_ns,
        "last_tick_ns": last.t_ns,
        "frame_id": run.frame_id,
        "inputs": {
            stream: {
                "topic": topic,
                "type": msgtype,
                "received": run.refusals(stream).received,
                "dropped": run.refusals(stream).dropped,
            }
            for stream, topic, msgtype in streams(run.inputs)
        },
        "state": last.state,
        "reason": last.reason,
        "fault": run.fault,
        "usable": not replayed.doubt,
        "usable_rows": dict(zip(ROWS, last.usable_rows, strict=True)),
        "gates": {name: cost._asdict() for name, cost in run.identifier.gate_costs().items()},
        "implausible": [found.text for found in run.identifier.noted],
        "delay": run.identifier.delay,
        "delay_sigma": _json(run.identifier.delay_sigma),
        "structure": run.structure.name,
        "coefficients": {
            coefficient: {
                "value": _json(result.values[index]),
                "sigma": _json(result.sigma[index]),
            }
            for coefficient, index in zip(run.structure.names, run.structure.free, strict=True)
        },
        "modes": [_json_mode(mode) for mode in replayed.modes()],
        "notes": list(replayed.notes),
        "advice": [advice._asdict() for advice in replayed.advice],
        "prediction_fit": {windows: _json_fit(fit) for windows, fit in replayed.fits.items()},
        "settings": {key: _json_setting(v) for key, v in settings.values().items()},
    }


def streams(inputs: Inputs) -> tuple[tuple[str, str, str], ...]:
    """Return name, topic and message type of the streams that are read."""
    return tuple(
        (stream.name, inputs.streams[stream.name], stream.type_of(inputs.settings))
        for stream in STREAMS
        if stream.name in inputs.streams
    )


def _json(value: float) -> float | None:
    """Return a number for JSON, which knows neither NaN nor infinity."""
    number = float(value)
    return number if math.isfinite(number) else None


def _json_fit(fit: PredictionFit) -> dict[str, Any]:
    def by_axis(values: Any) -> dict[str, float | None]:
        return {axis: _json(value) for axis, value in zip(AXES, values, strict=True)}

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


def _json_mode(mode: Mode) -> dict[str, Any]:
    numbers = {
        field.name: _json(getattr(mode, field.name))
        for field in fields(mode)
        if isinstance(getattr(mode, field.name), float)
    }
    eigenvalue = [_json(mode.eigenvalue.real), _json(mode.eigenvalue.imag)]
    return {"name": mode.name, "eigenvalue": eigenvalue, **numbers}


def _json_setting(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
