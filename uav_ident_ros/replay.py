# SPDX-License-Identifier: Apache-2.0
"""`replay`: the identifier over a recorded flight, and how good its model was."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from uav_ident_ros.bag_writer import BagWriteError
from uav_ident_ros.bags import Bag, BagError, Message
from uav_ident_ros.coefficients_file import (
    CoefficientsFileError,
    load_coefficients,
    save_coefficients,
)
from uav_ident_ros.estimates_bag import write_estimates
from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.prediction import PredictionFit
from uav_ident_ros.identification.settings import Settings, SettingsError
from uav_ident_ros.messages import MessageTypeError
from uav_ident_ros.offline import Inputs, OfflineRun, choose_inputs
from uav_ident_ros.parameter_file import ParameterFileError, load_parameters
from uav_ident_ros.pictures import PictureError, save_overview

USAGE_ERROR = 2
"""Exit status for bad input: a bag, a topic, a parameter that cannot be used."""

SUMMARY_VERSION = 1
NODE_NAME = "/identifier"
AXES = ("p", "q", "r")

REFUSALS = (
    BagError,
    BagWriteError,
    CoefficientsFileError,
    MessageTypeError,
    ParameterFileError,
    PictureError,
    SettingsError,
)
"""What bad input raises."""

Progress = Callable[[Iterable[Message], int], Iterable[Message]]


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(USAGE_ERROR, f"{self.prog}: {message} (see {self.prog} --help)\n")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    result = _Parser(
        prog="replay",
        description="Run the identifier over a recorded flight, as the node would have run, and "
        "score its predictions. Writes the bag 'estimates', summary.json and coefficients.yaml.",
    )
    result.add_argument("bag", type=Path, metavar="BAG", help="MCAP file or rosbag2 folder")
    result.add_argument(
        "--params-file", type=Path, metavar="FILE", help="ROS 2 parameter file, as for the node"
    )
    result.add_argument(
        "--node",
        default=NODE_NAME,
        metavar="NAME",
        help="node whose sections of the parameter file count (default: %(default)s)",
    )
    result.add_argument(
        "--output", type=Path, metavar="DIR", help="folder of the results (default: replay_BAG)"
    )
    result.add_argument(
        "--imu-topic",
        type=_topic,
        metavar="TOPIC",
        help="default: /imu/data, else the only one of a known type",
    )
    result.add_argument(
        "--actuators-topic",
        type=_topic,
        metavar="TOPIC",
        help="default: /actuators, else the only one of a known type",
    )
    result.add_argument(
        "--airspeed-topic",
        type=_topic,
        metavar="TOPIC",
        help="default: none, or with 'airspeed.type' /airspeed, else the only one of that type",
    )
    result.add_argument(
        "--plot", action="store_true", help="also write replay.png: rates and coefficients"
    )
    return result


def _topic(name: str) -> str:
    return name if name.startswith("/") else f"/{name}"


def main(args: list[str] | None = None) -> int:
    """Run the command; the return value is the exit status: 2 for bad input."""
    options = parser().parse_args(args)
    try:
        replay(options)
    except REFUSALS as error:
        print(f"replay: {error}", file=sys.stderr)
        return USAGE_ERROR
    except BrokenPipeError:
        # The reader of the table has gone; there is nobody left to tell.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def replay(options: argparse.Namespace) -> None:
    """Run the identifier over a bag, print the results and write them.

    Raises
    ------
    BagError, SettingsError, ParameterFileError and others of `REFUSALS`
        If the input cannot be used or the results cannot be written.
    """
    values: dict[str, Any] = {}
    if options.params_file is not None:
        values = dict(load_parameters(options.params_file, options.node))
    with Bag(options.bag) as bag:
        inputs = choose_inputs(
            bag, values, options.imu_topic, options.actuators_topic, options.airspeed_topic
        )
        run = OfflineRun(inputs, _initial(inputs.settings))
        run.run(bag, _progress)
    if run.fault:
        print(f"replay: fault: {run.fault}", file=sys.stderr)
    if not run.estimates:
        raise BagError(f"bag '{options.bag}': no tick came due: {_why_nothing(run)}")
    fits = run.score()
    name = options.bag.resolve().stem
    folder = options.output or Path(f"replay_{name}")
    _write(folder, name, run, fits)
    if options.plot:
        _plot(folder / "replay.png", name, run, fits)
    print(_table(name, run, fits))
    print(f"\nwritten to {folder}{os.sep}", flush=True)


def _initial(settings: Settings) -> CoefficientSet | None:
    """Read the coefficients to start from, if the settings name a file."""
    if not settings.initial_coefficients_file:
        return None
    return load_coefficients(settings.initial_coefficients_file, settings.structure)


def _progress(messages: Iterable[Message], total: int) -> Iterable[Message]:
    """Show a progress bar on a terminal, if there is a package for one."""
    if not sys.stderr.isatty():
        return messages
    try:
        from tqdm import tqdm  # type: ignore[import-untyped]
    except ImportError:
        return messages
    bar: Iterable[Message] = tqdm(
        messages, total=total, unit=" messages", unit_scale=True, leave=False
    )
    return bar


def _why_nothing(run: OfflineRun) -> str:
    """Say what became of the rates of a bag that gave no estimate."""
    rates = run.refusals("rates")
    topic = run.inputs.rates_topic
    if not rates.dropped:
        return f"'{topic}' has {rates.received} messages, too few for one tick"
    reasons = ", ".join(f"{count} {reason}" for reason, count in rates.dropped.items())
    return f"of {rates.received} messages on '{topic}' were dropped: {reasons}"


# --- summary -----------------------------------------------------------------------------------


def summary(name: str, run: OfflineRun, fits: dict[str, PredictionFit]) -> dict[str, Any]:
    """Everything worth keeping about a replay, ready for JSON; the same for the same bag."""
    last = run.estimates[-1]
    result = run.result()
    settings = run.inputs.settings
    return {
        "version": SUMMARY_VERSION,
        "bag": name,
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
            for stream, topic, msgtype in _streams(run.inputs)
        },
        "state": last.state,
        "reason": last.reason,
        "fault": run.fault,
        "usable": last.usable,
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
        "prediction_fit": {windows: _json_fit(fit) for windows, fit in fits.items()},
        "settings": {key: _json_setting(v) for key, v in settings.values().items()},
    }


def _streams(inputs: Inputs) -> tuple[tuple[str, str, str], ...]:
    settings = inputs.settings
    streams = (
        ("rates", inputs.rates_topic, settings.imu.type),
        ("actuators", inputs.actuators_topic, settings.actuators.type),
        ("airspeed", inputs.airspeed_topic, settings.airspeed.type),
    )
    return streams if inputs.airspeed_topic else streams[:2]


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
        "model_with_ay_az_held": by_axis(fit.held_force),
        "hold": by_axis(fit.hold),
    }


def _json_setting(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _write(folder: Path, name: str, run: OfflineRun, fits: dict[str, PredictionFit]) -> None:
    """Write the bag of estimates, the summary and the coefficients."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(summary(name, run, fits), indent=2, allow_nan=False) + "\n"
        (folder / "summary.json").write_text(text, encoding="utf-8")
    except OSError as error:
        raise BagWriteError(f"cannot write to '{folder}': {error.strerror}") from None
    write_estimates(
        folder / "estimates", run.estimates, run.structure, NODE_NAME, run.frame_id or ""
    )
    save_coefficients(run.result(), folder / "coefficients.yaml")


# --- table -------------------------------------------------------------------------------------

_TITLES = {
    "last_40_percent": "over the last 40 % of the flight",
    "after_30_s": "after 30 s",
}


def _table(name: str, run: OfflineRun, fits: dict[str, PredictionFit]) -> str:
    """Results in words and columns."""
    last = run.estimates[-1]
    result = run.result()
    settings = run.inputs.settings
    seconds = (last.t_ns - run.estimates[0].t_ns) * 1e-9
    lines = [
        f"{name}: {seconds:.1f} s, {len(run.estimates)} ticks",
        f"structure {settings.structure}, estimator {settings.estimator}",
        f"state at the end: {last.state}{f' ({last.reason})' if last.reason else ''}",
    ]
    for stream, topic, msgtype in _streams(run.inputs):
        refusals = run.refusals(stream)
        dropped = "".join(f", {count} {reason}" for reason, count in refusals.dropped.items())
        lines.append(f"{stream}: {topic} ({msgtype}), {refusals.received} messages{dropped}")
    if settings.actuators.estimate_delay:
        sigma = _sigma(run.identifier.delay_sigma)
        lines.append(f"estimated delay of the inputs: {run.identifier.delay:.3f} s, sigma {sigma}")
    if settings.airspeed.type:
        lines.append(f"coefficients at the reference airspeed, {settings.airspeed.reference:g} m/s")
    lines += ["", f"{'coefficient':<12}{'value':>12}{'sigma':>12}"]
    for coefficient, index in zip(run.structure.names, run.structure.free, strict=True):
        value, sigma = result.values[index], result.sigma[index]
        lines.append(f"{coefficient:<12}{value:>+12.4g}{_sigma(sigma):>12}")
    for windows, fit in fits.items():
        lines += ["", *_fit_lines(_TITLES[windows], fit)]
    return "\n".join(lines)


def _sigma(sigma: float) -> str:
    if sigma == 0.0:
        return "fixed"
    return f"{sigma:.2g}" if math.isfinite(sigma) else "unknown"


def _fit_lines(title: str, fit: PredictionFit) -> list[str]:
    header = f"1-second prediction fit {title} [%]"
    if not fit.windows:
        return [f"{header}: no window to score"]
    rows = [("identified model", fit.model)]
    if np.isfinite(fit.held_force).any():
        rows.append(("  with ay, az held", fit.held_force))
    rows.append(("holding the rates", fit.hold))
    lines = [f"{header}, {fit.windows} windows", f"{'':<20}" + "".join(f"{a:>9}" for a in AXES)]
    return lines + [f"{row:<20}" + "".join(f"{v:>9.1f}" for v in values) for row, values in rows]


def _plot(path: Path, name: str, run: OfflineRun, fits: dict[str, PredictionFit]) -> None:
    """Draw the flight."""
    first_ns = run.estimates[0].t_ns
    fit = fits["last_40_percent"]
    notes = [
        f"1-second prediction fit {model:.1f} %, holding the rates {hold:.1f} %"
        for model, hold in zip(fit.model, fit.hold, strict=True)
    ]
    predicted = np.array([estimate.predicted_rates for estimate in run.estimates])
    error = np.array([estimate.prediction_error for estimate in run.estimates])
    save_overview(
        path,
        t=np.array([(estimate.t_ns - first_ns) * 1e-9 for estimate in run.estimates]),
        measured=predicted + error,
        predicted=predicted,
        coefficients=np.array([estimate.coefficients for estimate in run.estimates]),
        structure=run.structure,
        title=f"{name}: {run.inputs.settings.estimator}, {run.structure.name}",
        notes=(notes[0], notes[1], notes[2]),
    )


if __name__ == "__main__":
    sys.exit(main())
