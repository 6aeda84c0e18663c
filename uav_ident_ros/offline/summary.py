# SPDX-License-Identifier: Apache-2.0
"""summary.json: everything about a replay, the same bytes for the same bag."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

from uav_ident_ros.identification.linearisation import Mode
from uav_ident_ros.identification.prediction import HORIZONS, PredictionFit
from uav_ident_ros.identification.structure import ROWS
from uav_ident_ros.messages.streams import STREAMS
from uav_ident_ros.offline.inputs import Inputs
from uav_ident_ros.offline.replayed import Replayed

SUMMARY_VERSION = 2
AXES = ("p", "q", "r")


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
    settings = inputs.settings.values()
    types = {
        stream.name: str(settings[stream.setting]) if stream.setting else stream.types[0]
        for stream in STREAMS
    }
    return tuple((name, topic, types[name]) for name, topic in inputs.streams.items())


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
