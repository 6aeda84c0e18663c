# SPDX-License-Identifier: Apache-2.0
"""The command line of `replay`."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn

from uav_ident_ros.replay.job import NO_RESULT, NODE_NAME, NOT_USABLE, USABLE

STREAMS: Mapping[str, str] = {
    "imu/data": "rates",
    "actuators": "actuators",
    "airspeed": "airspeed",
}
"""The node's input topics, as ``--topic`` names them, and the streams they carry."""

EXIT_STATUS = f"""\
exit status:
  {USABLE}  the model is usable: the verdict of its last tick, as a controller would have read it
  {NOT_USABLE}  the bag was replayed, but its model is not usable
  {NO_RESULT}  no result: a bag, topic or parameter cannot be used
  of several bags the largest counts; with --compare that of the best configuration, unless one
  gave no result

examples:
  replay flight --params-file vehicle.yaml --plot
  replay flight --topic imu/data:=/mavros/imu/data_raw --topic actuators:=/mavros/rc/out
  replay logs/ --params-file vehicle.yaml --output output/logs
  replay flight --params-file vehicle.yaml --compare fast_filter.yaml paper.yaml
"""


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(NO_RESULT, f"{self.prog}: {message} (see {self.prog} --help)\n")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    result = _Parser(
        prog="replay",
        description="Run the identifier over recorded flights, as the node would have run, and "
        "score its predictions. Writes for each the bag 'estimates', summary.json, "
        "coefficients.yaml and table.txt.",
        epilog=EXIT_STATUS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument(
        "bags",
        type=Path,
        nargs="+",
        metavar="BAG",
        help="MCAP file, rosbag2 folder, or a folder with any number of them",
    )
    _add_parameters(result)
    _add_topics(result)
    _add_output(result)
    return result


def _add_parameters(result: argparse.ArgumentParser) -> None:
    group = result.add_argument_group("parameters")
    group.add_argument(
        "--params-file", type=Path, metavar="FILE", help="ROS 2 parameter file, as for the node"
    )
    group.add_argument(
        "--node",
        default=NODE_NAME,
        metavar="NAME",
        help="node whose sections of the parameter file count (default: %(default)s)",
    )
    group.add_argument(
        "--compare",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="rank configurations on one bag: parameter files, each on top of --params-file",
    )


def _add_topics(result: argparse.ArgumentParser) -> None:
    group = result.add_argument_group("topics")
    group.add_argument(
        "--topic",
        type=_remapping,
        action="append",
        default=[],
        metavar="NAME:=TOPIC",
        help="topic of the bag to read as the node's topic NAME, which is imu/data, actuators "
        "or airspeed; may be given several times",
    )
    defaults = {
        "imu": "/imu/data, else the only one of a known type",
        "actuators": "/actuators, else the only one of a known type",
        "airspeed": "none, or with 'airspeed.type' /airspeed, else the only one of that type",
    }
    for stream, default in defaults.items():
        name = "imu/data" if stream == "imu" else stream
        group.add_argument(
            f"--{stream}-topic",
            type=absolute,
            metavar="TOPIC",
            help=f"the same as --topic {name}:=TOPIC (default: {default})",
        )


def _add_output(result: argparse.ArgumentParser) -> None:
    group = result.add_argument_group("output")
    group.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="folder of the results (default: replay_BAG); of several bags or configurations "
        "each gets a folder of its own in it",
    )
    group.add_argument(
        "--plot", action="store_true", help="also write replay.png: rates and coefficients"
    )
    group.add_argument(
        "--report",
        action="store_true",
        help="also write report.html: everything on one page, for any browser",
    )
    group.add_argument(
        "--jobs",
        type=_positive,
        default=os.cpu_count() or 1,
        metavar="N",
        help="processes at a time for several bags or configurations (default: %(default)s)",
    )


def absolute(name: str) -> str:
    """Return a topic with its leading slash."""
    return name if name.startswith("/") else f"/{name}"


def _remapping(text: str) -> tuple[str, str]:
    """Return stream and topic of ``NAME:=TOPIC``."""
    name, found, topic = text.partition(":=")
    stream = STREAMS.get(name.lstrip("/"))
    if not found or stream is None or not topic:
        raise argparse.ArgumentTypeError(
            f"'{text}' is not NAME:=TOPIC with a NAME among {', '.join(STREAMS)}"
        )
    return stream, absolute(topic)


def _positive(text: str) -> int:
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number from 1 on")
    return number


def topics(options: argparse.Namespace) -> dict[str, str]:
    """Return the topics that were asked for, by stream; `--topic` wins."""
    named = {
        "rates": options.imu_topic,
        "actuators": options.actuators_topic,
        "airspeed": options.airspeed_topic,
    }
    return {stream: topic for stream, topic in named.items() if topic} | dict(options.topic)
