# SPDX-License-Identifier: Apache-2.0
"""The demonstration: the node on a recorded flight, live, and then its report.

The node is a process of its own, in a ROS domain of its own. The flight is played to it over DDS
with /clock, and its outputs are shown as in `monitor`. `replay` then repeats the computation, with
score, picture and report.
"""

import argparse
import contextlib
import os
import sys
import tempfile
import time
from pathlib import Path

from uav_ident_ros.bags.reading import Bag, Message
from uav_ident_ros.commandline import (
    USAGE_ERROR,
    OneLineParser,
    end_as_on_ctrl_c,
    given_path,
    number,
)
from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.samples import NS
from uav_ident_ros.messages.streams import STREAMS
from uav_ident_ros.messages.types import ACTUATOR_ADAPTERS, import_type
from uav_ident_ros.monitor.cli import discover
from uav_ident_ros.monitor.picture import View
from uav_ident_ros.node.ending import Ending
from uav_ident_ros.offline import NO_RESULT, NODE_NAME
from uav_ident_ros.offline import main as replay
from uav_ident_ros.offline.inputs import BagInputs, choose_inputs
from uav_ident_ros.offline.job import REPLAY_REFUSALS, parameters_beside, reserved
from uav_ident_ros.player import Player, PlayerError
from uav_ident_ros.process import NodeProcess, own_domain
from uav_ident_ros.share import shared

FAILED = 1

DEFAULT_BAG = shared("bags/c172p")
DEFAULT_SPEED = 2.0
"""Playing speed relative to real time: the 75 s of the default flight take under a minute."""

BLOCK_EVERY = 5.0
"""Seconds between two blocks of text without a terminal."""


def running_node(inputs: BagInputs, parameter_file: Path | None, log: Path) -> NodeProcess:
    """Start the node with the settings of a flight."""
    settings, streams = inputs.settings, inputs.streams
    return NodeProcess(
        "uav_ident_ros.node",
        log,
        {
            # a recorded flight must neither read nor write the vehicle's state file
            "state_file": "none",
            "use_sim_time": True,
            "imu.type": settings.imu.type,
            "actuators.type": settings.actuators.type,
        },
        file=parameter_file,
        remappings={s.topic: streams[s.name] for s in STREAMS if s.name in streams},
    )


# --- command line -----------------------------------------------------------------------------


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    result = OneLineParser(
        prog="demo",
        description="Play a recorded flight to the identifier, live, watch it learn, and "
        "leave its picture and report.",
    )
    add = result.add_argument
    add("bag", nargs="?", type=given_path, default=DEFAULT_BAG, help="bag to play (bags/c172p)")
    file_help = "parameters of the node (identifier.yaml beside the bag, if there is one)"
    add("--params-file", type=given_path, help=file_help)
    speed = number(float, 0.1, 5.0, ": 0.1 to 5 times real time are possible")
    speed_help = (
        f"times real time, 0.1 to 5 (default {DEFAULT_SPEED:g}; 1 if the actuators carry no "
        "stamp, as they are stamped on arrival)"
    )
    add("--speed", type=speed, help=speed_help)
    output_help = "folder for the results and the node's log (output)"
    add("--output", type=given_path, default=Path("output"), help=output_help)
    return result


def run_demo(options: argparse.Namespace) -> int:
    """Play a flight, show it and write its report; return the exit status."""
    file = options.params_file or parameters_beside(options.bag)
    with Bag(options.bag) as bag:
        inputs = choose_inputs(bag, load_parameters(file, NODE_NAME) if file else {})
        messages = list(bag.messages(inputs.topics))
        topics = {topic: import_type(bag.type_of(topic)) for topic in inputs.topics}
    stamped = ACTUATOR_ADAPTERS[inputs.settings.actuators.type].stamp is not None
    speed = options.speed or (DEFAULT_SPEED if stamped else 1.0)
    name = options.bag.resolve().stem
    folder = options.output / f"demo_{name}"
    with reserved(folder):
        log = folder / "node.log"
        log.unlink(missing_ok=True)
        print(
            f"{name}: {(messages[-1].log_ns - messages[0].log_ns) * NS:.0f} s at {speed:g} times "
            f"real time, ROS domain {os.environ['ROS_DOMAIN_ID']}",
            flush=True,
        )
        if not play(running_node(inputs, file, log), topics, messages, speed):
            print(f"demo: the node published nothing: {log.read_text().strip()}", file=sys.stderr)
            return FAILED
    print(f"\nthe node's log: {log}\nthe same flight by replay, with its score:\n", flush=True)
    parameters = ["--params-file", str(file)] if file else []
    status = replay([str(options.bag), *parameters, "--output", str(folder), "--plot", "--report"])
    print(f"picture: {folder / 'replay.png'}\nreport: {folder / 'report.html'}")
    return FAILED if status == NO_RESULT else 0


def play(
    node: NodeProcess,  # Ended after the flight
    topics: dict[str, type],  # Message classes
    messages: list[Message],  # Of these topics, in log-time order
    speed: float,  # Times real time
) -> bool:
    """Play a flight to a node and show its outputs; return whether there were any."""
    ending = Ending()
    with contextlib.ExitStack() as open_:
        open_.callback(ending.restore)
        open_.enter_context(node)
        player = open_.enter_context(contextlib.closing(Player(topics, ending=ending)))
        player.wait_until(lambda: node.poll() is not None or player.node_is_there(), "the node")
        if node.poll() is not None:
            return False
        player.wait_for_node()
        watched = discover(player, NODE_NAME)
        view = open_.enter_context(contextlib.closing(View()))
        period = view.period if sys.stdout.isatty() else BLOCK_EVERY
        shown = time.monotonic()

        def show(_: int) -> None:
            nonlocal shown
            if time.monotonic() - shown >= period:
                view.show(watched)
                shown = time.monotonic()

        player.play(messages, speed=speed, on_time=show, in_step=True)
        view.show(watched)
        return watched.newest is not None


def main(arguments: list[str] | None = None) -> int:
    """Run the demonstration; the return value is the exit status."""
    options = parser().parse_args(arguments)
    end_as_on_ctrl_c()
    try:
        with own_domain(), tempfile.TemporaryDirectory() as logs:
            os.environ["ROS_LOG_DIR"] = logs
            return run_demo(options)
    except REPLAY_REFUSALS as error:
        print(f"demo: {error}", file=sys.stderr)
        return USAGE_ERROR
    except (PlayerError, OSError) as error:
        print(f"demo: {error}", file=sys.stderr)
        return FAILED
