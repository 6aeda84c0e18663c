# SPDX-License-Identifier: Apache-2.0
"""The command line of `replay`."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from uav_ident_ros.commandline import OneLineParser
from uav_ident_ros.messages.streams import STREAMS, Stream
from uav_ident_ros.offline.status import NO_RESULT, NODE_NAME, NOT_USABLE, USABLE

DESCRIPTION = """\
Run the identifier over recorded flights, as the node would have run, and score its predictions.
Writes for each flight the bag 'estimates', summary.json, coefficients.yaml and table.txt.
"""

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
  replay logs/ --output output/logs --scheduler tcp://cluster:8786
  replay flight --params-file vehicle.yaml --compare fast_filter.yaml paper.yaml
"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    result = OneLineParser(
        prog="replay",
        description=DESCRIPTION,
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
    _add_fleet(result)
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
        help="topic of the bag to read as the node's topic NAME, which is one of "
        f"{', '.join(stream.topic for stream in STREAMS)}; may be given several times",
    )
    for stream in STREAMS:
        group.add_argument(
            f"--{_option(stream)}-topic",
            type=absolute,
            metavar="TOPIC",
            help=f"the same as --topic {stream.topic}:=TOPIC (default: {_default(stream)})",
        )


def _option(stream: Stream) -> str:
    """Return what a stream is called in the name of an option: imu, not imu/data."""
    return stream.topic.partition("/")[0]


def _default(stream: Stream) -> str:
    found = f"/{stream.topic}, else the only one"
    if not stream.setting:
        return f"{found} whose name ends so, if there is one"
    if stream.optional:
        return f"none, or with '{stream.setting}' {found} of that type"
    return f"{found} of a known type"


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


def _add_fleet(result: argparse.ArgumentParser) -> None:
    group = result.add_argument_group("several bags")
    group.add_argument(
        "--jobs",
        type=_positive,
        default=os.cpu_count() or 1,
        metavar="N",
        help="processes at a time for several bags or configurations (default: %(default)s)",
    )
    group.add_argument(
        "--scheduler",
        default="",
        metavar="ADDRESS",
        help="Dask scheduler whose workers do the work, such as tcp://host:8786; they must see the "
        "same paths",
    )
    group.add_argument(
        "--again",
        action="store_true",
        help="replay all bags; without it those are skipped whose result is there already, of the "
        "same bag with the same settings",
    )
    group.add_argument(
        "--aircraft",
        default="",
        metavar="NAME",
        help="aircraft in the table of flights (default: name of the folder that the bag is in)",
    )


def absolute(name: str) -> str:
    """Return a topic with its leading slash."""
    return name if name.startswith("/") else f"/{name}"


def _remapping(text: str) -> tuple[str, str]:
    """Return stream and topic of ``NAME:=TOPIC``."""
    name, found, topic = text.partition(":=")
    streams = {stream.topic: stream.name for stream in STREAMS}
    stream = streams.get(name.lstrip("/"))
    if not found or stream is None or not topic:
        raise argparse.ArgumentTypeError(
            f"'{text}' is not NAME:=TOPIC with a NAME among {', '.join(streams)}"
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
    named = {stream.name: getattr(options, f"{_option(stream)}_topic") for stream in STREAMS}
    return {stream: topic for stream, topic in named.items() if topic} | dict(options.topic)
