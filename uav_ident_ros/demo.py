# SPDX-License-Identifier: Apache-2.0
"""The first five minutes: the node on a recorded flight, live, with a running picture.

The node runs as a process of its own, in a ROS domain of its own. The flight is played to it
over DDS with /clock; what it publishes is shown while it learns and drawn at the end.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, Protocol

import numpy as np
import yaml

from uav_ident_ros.bags.reading import Bag, BagError, Message
from uav_ident_ros.files.parameter_file import ParameterFileError, load_parameters
from uav_ident_ros.identification.prediction import PredictionFit, score
from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.identification.settings import SettingsError
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray, Structure
from uav_ident_ros.messages.types import ACTUATORS, FIT_NAMES, MessageTypeError, import_type
from uav_ident_ros.node.notices import OnChange
from uav_ident_ros.offline.run import Inputs, OfflineRun, choose_inputs
from uav_ident_ros.pictures import PictureError, save_overview
from uav_ident_ros.player import Outputs, Player, PlayerError, stamp_ns

USAGE_ERROR = 2
FAILED = 1
INTERRUPTED = 130

DEFAULT_BAG = Path(__file__).parents[1] / "bags" / "multisine"
DEFAULT_SPEED = 2.0
"""The 75 s of the default flight then take well under a minute."""

HIGHEST_DOMAIN = 101
"""Highest ROS domain whose ports are free of the system's ephemeral ones."""

REFRESH = 0.5
"""Seconds between two pictures on a terminal."""

LINE_EVERY = 3.0
"""Seconds between two lines where there is no terminal."""

SHOWN = ("pdot/p", "pdot/da", "qdot/q", "qdot/de", "rdot/r", "rdot/dr")
"""Coefficients that fit on a line: damping and control of each axis."""

AXES = "pqr"

REFUSALS = (
    BagError,
    SettingsError,
    MessageTypeError,
    ParameterFileError,
    PictureError,
)
"""What bad input raises."""


@dataclass(frozen=True)
class Flight:
    """A recorded flight, ready to be played.

    Parameters
    ----------
    name : str
        Name of the bag.
    path : Path
        The bag.
    parameter_file : Path or None
        Parameters that describe its topics.
    inputs : Inputs
        Its topics and the settings.
    messages : list of Message
        Everything on the topics of the inputs, in log-time order.
    types : dict
        Message type of each topic.
    truth : dict
        True coefficients by name, where they are known.
    """

    name: str
    path: Path
    parameter_file: Path | None
    inputs: Inputs
    messages: list[Message]
    types: dict[str, str]
    truth: dict[str, float]


def load_flight(path: Path, parameter_file: Path | None) -> Flight:
    """Read a bag, and the parameters and the truth that may lie beside it.

    Raises
    ------
    BagError, SettingsError, ParameterFileError
        If the bag or the parameters cannot be used.
    """
    beside = path / "identifier.yaml"
    if parameter_file is None and beside.is_file():
        parameter_file = beside
    parameters: Mapping[str, object] = {}
    if parameter_file is not None:
        parameters = load_parameters(parameter_file, "identifier")
    with Bag(path) as bag:
        inputs = choose_inputs(bag, parameters)
        messages = list(bag.messages(inputs.topics))
        for line in bag.damage:
            print(f"demo: {line}", file=sys.stderr)
        return Flight(
            name=path.resolve().stem,
            path=path,
            parameter_file=parameter_file,
            inputs=inputs,
            messages=messages,
            types={topic: bag.type_of(topic) for topic in inputs.topics},
            truth=_truth(path / "truth.yaml"),
        )


def _truth(path: Path) -> dict[str, float]:
    """Return the true coefficients or local derivatives of a flight, if they are known."""
    if not path.is_file():
        return {}
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    known = content.get("coefficients") or content.get("local_derivatives") or {}
    return {str(name): float(value) for name, value in known.items()}


# --- the node ---------------------------------------------------------------------------------


def node_command(flight: Flight) -> list[str]:
    """Return the command line of the node for a flight."""
    # A recorded flight must neither start from the vehicle's state file nor end up in it.
    command = [sys.executable, "-m", "uav_ident_ros.node"]
    command += ["--ros-args", "-p", "state_file:=none"]
    if flight.parameter_file is not None:
        command += ["--params-file", str(flight.parameter_file)]
    settings = flight.inputs.settings
    for name, value in (
        ("use_sim_time", "true"),
        ("imu.type", settings.imu.type),
        ("actuators.type", settings.actuators.type),
    ):
        command += ["-p", f"{name}:={value}"]
    command += ["-r", f"imu/data:={flight.inputs.rates_topic}"]
    command += ["-r", f"actuators:={flight.inputs.actuators_topic}"]
    if flight.inputs.airspeed_topic:
        command += ["-r", f"airspeed:={flight.inputs.airspeed_topic}"]
    return command


@contextlib.contextmanager
def running_node(flight: Flight, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run the node; it is ended in any case."""
    with log.open("wb") as file:
        process = subprocess.Popen(node_command(flight), stdout=file, stderr=subprocess.STDOUT)
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


# --- what it published, and how good that is -------------------------------------------------


@dataclass(frozen=True)
class Ticks:
    """What the node published, K ticks long.

    Parameters
    ----------
    t_ns : (K,) int array
        Ticks, ns.
    coefficients : (K, 3, n) array
        Coefficients, SI.
    predicted, measured : (K, 3) array
        Rates in the Imu's axes, rad/s.
    """

    t_ns: TimeArray
    coefficients: FloatArray
    predicted: FloatArray
    measured: FloatArray


def received(outputs: Outputs, structure: Structure) -> Ticks:
    """Gather the ticks of which every message arrived."""
    streams = (
        outputs.named,
        outputs.coefficients,
        outputs.predicted_rates,
        outputs.prediction_error,
    )
    count = min(len(stream) for stream in streams)
    named, dense, predicted, error = (stream[:count] for stream in streams)
    rates = _vectors(predicted)
    return Ticks(
        t_ns=np.array([stamp_ns(m.header.stamp) for m in named], dtype=np.int64),
        coefficients=np.array([m.data for m in dense]).reshape(count, *structure.mask.shape),
        predicted=rates,
        measured=rates + _vectors(error),
    )


def _vectors(messages: list[Any]) -> FloatArray:
    return np.array([(m.vector.x, m.vector.y, m.vector.z) for m in messages]).reshape(-1, 3)


def live_score(flight: Flight, ticks: Ticks, structure: Structure) -> PredictionFit:
    """Score the coefficients as they were published live, over the last 40 % of the flight."""
    # Only for the flight's record: measured rates and inputs as the identifier takes them.
    record = OfflineRun(flight.inputs)
    with Bag(flight.path) as bag:
        record.run(bag, lambda messages, _: messages)
    t_ns, rates, force = record.measured()
    fits = score(
        t_ns,
        rates,
        record.input_signal(),
        force,
        ticks.t_ns,
        ticks.coefficients,
        structure,
        lever_arm=np.array(flight.inputs.settings.imu.lever_arm),
    )
    return fits["last_40_percent"]


# --- the running picture ----------------------------------------------------------------------


class View(Protocol):
    """Shows the newest outputs."""

    def show(self, seconds: float, outputs: Outputs) -> None:
        """Show what the node has published by `seconds` into the flight."""

    def close(self) -> None:
        """Leave the terminal as it was."""


def newest_values(outputs: Outputs) -> dict[str, float]:
    """Return the newest entries of ~/coefficients_named by name; empty before the first."""
    if not outputs.named:
        return {}
    message = outputs.named[-1]
    return dict(zip(message.name, message.position, strict=True))


def newest_state(outputs: Outputs) -> str:
    """Return what the node last said about itself."""
    return outputs.status[-1].message if outputs.status else "starting"


def fit_words(values: Mapping[str, float]) -> str:
    """Return the node's own running fit in words."""
    fits = [values.get(name, 0.0) for name in FIT_NAMES]
    if not any(fits):
        return "no fit yet"
    return "fit " + " ".join(f"{a} {f:.0f}" for a, f in zip(AXES, fits, strict=True)) + " %"


class Lines:
    """A line every few seconds, for logs and pipes."""

    def __init__(self) -> None:
        self._next = 0.0
        self._said = OnChange()

    def show(self, seconds: float, outputs: Outputs) -> None:
        """Print a line if it is time for one, and the node's state when it changes."""
        state = newest_state(outputs)
        if self._said.changed(state):
            print(f"{seconds:6.1f} s  {state}", flush=True)
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + LINE_EVERY
        values = newest_values(outputs)
        shown = "  ".join(f"{n} {values[n]:+.2f}" for n in SHOWN if n in values)
        print(f"{seconds:6.1f} s  {fit_words(values):<24}  {shown}", flush=True)

    def close(self) -> None:
        """Nothing to leave behind."""


class Table:
    """A table that is drawn anew, for terminals; needs the package `rich`."""

    def __init__(self, flight: Flight) -> None:
        from rich.live import Live

        self._flight = flight
        self._next = 0.0
        self._live = Live(auto_refresh=False)
        self._live.start()

    def show(self, seconds: float, outputs: Outputs) -> None:
        """Draw the table if it is time for it."""
        from rich.table import Table as RichTable

        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + REFRESH
        table = RichTable(
            title=f"{self._flight.name}: {seconds:.1f} s, {newest_state(outputs)}",
            caption="running 1-second prediction: " + fit_words(newest_values(outputs)),
        )
        for column in ("coefficient", "value", "1 sigma", "truth"):
            table.add_column(column, justify="left" if column == "coefficient" else "right")
        for name, value, sigma, truth in coefficient_rows(outputs, self._flight.truth):
            table.add_row(name, value, sigma, truth)
        self._live.update(table, refresh=True)

    def close(self) -> None:
        """Stop drawing."""
        self._live.stop()


def coefficient_rows(
    outputs: Outputs, truth: Mapping[str, float]
) -> Iterator[tuple[str, str, str, str]]:
    """Yield name, value, sigma and truth of the newest coefficients, as text."""
    if not outputs.named:
        return
    message = outputs.named[-1]
    for name, value, sigma in zip(message.name, message.position, message.effort, strict=True):
        if name.startswith(("fit/", "verdict/")):
            continue
        shown = "fixed" if sigma == 0.0 else f"{sigma:.2g}" if np.isfinite(sigma) else "unknown"
        known = f"{truth[name]:+.3f}" if name in truth else ""
        yield name, f"{value:+.3f}", shown, known


def make_view(flight: Flight) -> View:
    """Return a table on a terminal if `rich` is installed, else lines."""
    if sys.stdout.isatty():
        with contextlib.suppress(ImportError):
            return Table(flight)
    return Lines()


# --- the result -------------------------------------------------------------------------------


def result_lines(flight: Flight, outputs: Outputs, final: PredictionFit) -> str:
    """Return coefficients and score as text."""
    lines = [f"{'coefficient':<12}{'value':>10}{'1 sigma':>10}{'truth':>10}"]
    for row in coefficient_rows(outputs, flight.truth):
        lines.append(f"{row[0]:<12}" + "".join(f"{text:>10}" for text in row[1:]))
    lines += ["", "1-second prediction fit over the last 40 % of the flight [%]"]
    lines.append(f"{'':<20}" + "".join(f"{axis:>8}" for axis in AXES))
    for label, values in (("identified model", final.model), ("holding the rates", final.hold)):
        lines.append(f"{label:<20}" + "".join(f"{value:>8.1f}" for value in values))
    return "\n".join(lines)


def draw(path: Path, flight: Flight, ticks: Ticks, final: PredictionFit) -> None:
    """Draw the flight as the node saw it."""
    settings = flight.inputs.settings
    notes = [
        f"1-second prediction fit {model:.1f} %, holding the rates {hold:.1f} %"
        for model, hold in zip(final.model, final.hold, strict=True)
    ]
    save_overview(
        path,
        t=(ticks.t_ns - ticks.t_ns[0]) * 1e-9,
        measured=ticks.measured,
        predicted=ticks.predicted,
        coefficients=ticks.coefficients,
        structure=STRUCTURES[settings.structure],
        title=f"{flight.name}, live: {settings.estimator}, {settings.structure}",
        notes=(notes[0], notes[1], notes[2]),
    )


# --- command line -----------------------------------------------------------------------------


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(USAGE_ERROR, f"{self.prog}: {message} (see {self.prog} --help)\n")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    result = _Parser(
        prog="demo",
        description="Play a recorded flight to the identifier, live, and watch it learn.",
    )
    result.add_argument(
        "bag", nargs="?", type=Path, default=DEFAULT_BAG, help="bag to play (bags/multisine)"
    )
    result.add_argument(
        "--params-file",
        type=Path,
        help="parameters of the node (identifier.yaml beside the bag, if there is one)",
    )
    result.add_argument(
        "--speed",
        type=_speed,
        help=f"times real time, 0.1 to 5 (default {DEFAULT_SPEED:g}; 1 if the actuators carry no "
        "stamp, as they are stamped on arrival)",
    )
    result.add_argument(
        "--output",
        type=Path,
        default=Path("output"),
        help="folder for the picture and the node's log (output)",
    )
    result.add_argument(
        "--domain", type=int, help="ROS domain, to watch with other tools (one of its own)"
    )
    return result


def _speed(text: str) -> float:
    speed = float(text)
    if not 0.1 <= speed <= 5.0:
        raise argparse.ArgumentTypeError(f"'{text}': 0.1 to 5 times real time are possible")
    return speed


def run_demo(options: argparse.Namespace) -> int:
    """Play, show, score and draw; return the exit status."""
    flight = load_flight(options.bag, options.params_file)
    options.output.mkdir(parents=True, exist_ok=True)
    log = options.output / f"demo_{flight.name}.log"
    start_ns = flight.messages[0].log_ns
    seconds = (flight.messages[-1].log_ns - start_ns) * 1e-9
    stamped = ACTUATORS[flight.inputs.settings.actuators.type].stamped
    speed = options.speed or (DEFAULT_SPEED if stamped else 1.0)
    print(
        f"{flight.name}: {seconds:.0f} s at {speed:g} times real time, ROS domain "
        f"{os.environ['ROS_DOMAIN_ID']}"
    )
    with running_node(flight, log) as node:
        player = Player({topic: import_type(name) for topic, name in flight.types.items()})
        view: View | None = None
        try:
            player.wait_until(lambda: node.poll() is not None or player.node_is_there(), "the node")
            if node.poll() is not None:
                print(f"demo: the node did not start: {log.read_text().strip()}", file=sys.stderr)
                return FAILED
            player.wait_for_node()
            view = make_view(flight)
            shown = view

            def on_time(t_ns: int) -> None:
                shown.show((t_ns - start_ns) * 1e-9, player.outputs)

            player.play(flight.messages, speed=speed, on_time=on_time)
            player.spin_for(1.0)
        finally:
            if view is not None:
                view.close()
            player.close()
    if not player.outputs.named:
        print(f"demo: the node published nothing; its log is {log}", file=sys.stderr)
        return FAILED
    report(options.output / f"demo_{flight.name}.png", flight, player.outputs)
    print(f"the node's log: {log}")
    return 0


def report(picture: Path, flight: Flight, outputs: Outputs) -> None:
    """Print the result and leave the picture."""
    structure = STRUCTURES[flight.inputs.settings.structure]
    ticks = received(outputs, structure)
    final = live_score(flight, ticks, structure)
    print(f"\n{result_lines(flight, outputs, final)}")
    draw(picture, flight, ticks, final)
    print(f"\nmeasured against predicted rates, coefficients over time: {picture}")


def _interrupt(*_: object) -> NoReturn:
    """End on SIGTERM as on Ctrl-C: the node must not be left behind."""
    raise KeyboardInterrupt


def main(arguments: list[str] | None = None) -> int:
    """Run the demonstration; the return value is the exit status."""
    options = parser().parse_args(arguments)
    signal.signal(signal.SIGTERM, _interrupt)
    domain = options.domain
    if domain is None:
        domain = 1 + secrets.randbelow(HIGHEST_DOMAIN)
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    try:
        with tempfile.TemporaryDirectory() as logs:
            os.environ["ROS_LOG_DIR"] = logs
            return run_demo(options)
    except REFUSALS as error:
        print(f"demo: {error}", file=sys.stderr)
        return USAGE_ERROR
    except (PlayerError, OSError) as error:
        print(f"demo: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
