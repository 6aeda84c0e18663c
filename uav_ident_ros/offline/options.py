# SPDX-License-Identifier: Apache-2.0
"""The command line of `replay`."""

import argparse
import os
import sys
from pathlib import Path
from typing import Any

from uav_ident_ros.commandline import OneLineParser, number
from uav_ident_ros.offline import NO_RESULT, NODE_NAME, NOT_USABLE, USABLE

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
    result.add_argument("bags", type=Path, nargs="+", metavar="BAG",
        help="MCAP file, rosbag2 folder, or a folder with any number of them")  # fmt: skip
    for title, options in _groups().items():
        group = result.add_argument_group(title)
        for name, words, more in options:
            group.add_argument(name, help=words, **more)
    return result


def _groups() -> dict[str, list[tuple[str, str, dict[str, Any]]]]:
    """Return name, help and the rest of every option, by group."""
    file, folder, switch = (
        {"type": Path, "metavar": "FILE"}, {"type": Path, "metavar": "DIR"},
        {"action": "store_true"},
    )  # fmt: skip
    return {
        "parameters": [
            ("--params-file", "ROS 2 parameter file, as for the node", file),
            ("--node", "node whose sections of the parameter file count (default: %(default)s)",
             {"default": NODE_NAME, "metavar": "NAME"}),
            ("--compare", "rank configurations on one bag: parameter files, each on top of "
             "--params-file", {**file, "nargs": "+"}),
        ],
        "topics": [
            ("--topic", "topic of the bag to read as the node's topic NAME, such as "
             "imu/data:=/gyro; may be given several times (default: the topic of that name, else "
             "the only one of a fitting type)",
             {"type": _remapping, "action": "append", "default": [], "metavar": "NAME:=TOPIC"}),
        ],
        "output": [
            ("--output", "folder of the results (default: replay_BAG); of several bags or "
             "configurations each gets a folder of its own in it", folder),
            ("--plot", "also write replay.png: rates and coefficients", switch),
            ("--report", "also write report.html: everything on one page, for any browser",
             switch),
        ],
        "several bags": [
            ("--jobs", "processes at a time for several bags or configurations (default: "
             "%(default)s)",
             {"type": number(int, 1, sys.maxsize, " is not a number from 1 on"),
              "default": os.cpu_count() or 1, "metavar": "N"}),
            ("--scheduler", "Dask scheduler whose workers do the work, such as tcp://host:8786; "
             "they must see the same paths", {"default": "", "metavar": "ADDRESS"}),
            ("--again", "replay all bags; without it those are skipped whose result is there "
             "already, of the same bag with the same settings", switch),
            ("--aircraft", "aircraft in the table of flights (default: name of the folder that "
             "the bag is in)", {"default": "", "metavar": "NAME"}),
        ],
    }  # fmt: skip


def _remapping(text: str) -> tuple[str, str]:
    """Return stream and topic of ``NAME:=TOPIC``."""
    from uav_ident_ros.messages.streams import STREAMS  # needs NumPy, which help does not

    name, found, topic = text.partition(":=")
    streams = {stream.topic: stream.name for stream in STREAMS}
    stream = streams.get(name.lstrip("/"))
    if not found or stream is None or not topic:
        raise argparse.ArgumentTypeError(
            f"'{text}' is not NAME:=TOPIC with a NAME among {', '.join(streams)}"
        )
    return stream, f"/{topic.lstrip('/')}"
