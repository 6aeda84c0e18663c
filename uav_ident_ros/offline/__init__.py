# SPDX-License-Identifier: Apache-2.0
"""`replay`: the identifier on recorded flights, with scores of its models."""

import argparse
import os
import sys

from uav_ident_ros.commandline import (
    NOT_USABLE,
    USABLE,
    OneLineParser,
    given_path,
    importing,
    number,
)

NODE_NAME = "/identifier"

NO_RESULT = 2
"""Exit status of a bag that cannot be replayed."""

DESCRIPTION = """\
Run the identifier over recorded flights, as the node would have run, and score its predictions.
Writes for each flight the bag 'estimates', summary.json, coefficients.yaml and table.txt.
"""

EXIT_STATUS = f"""\
exit status:
  {USABLE}  the model is usable: by the verdict of its last tick, and no axis loses to holding the
     rate over the last part of the flight
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


def main(args: list[str] | None = None) -> int:
    """Run the command; the return value is the exit status, see `replay --help`."""
    command_line = parser()
    options = command_line.parse_args(args)
    with importing():
        from uav_ident_ros.offline.command import run  # help needs none of its imports
    return run(command_line, options)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    result = OneLineParser(
        prog="replay",
        description=DESCRIPTION,
        epilog=EXIT_STATUS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("bags", type=given_path, nargs="+", metavar="BAG",
        help="MCAP file, rosbag2 folder, or a folder with any number of them")  # fmt: skip
    add = result.add_argument_group("parameters").add_argument
    add("--params-file", type=given_path, action="append", default=[], metavar="FILE",
        help="ROS 2 parameter file, as for the node; may be given several times: the last "
             "counts")  # fmt: skip
    add("--node", default=NODE_NAME, metavar="NAME",
        help="node whose sections of the parameter file count (default: %(default)s)")  # fmt: skip
    add("--compare", type=given_path, nargs="+", metavar="FILE",
        help="rank configurations on one bag: parameter files, each on top of "
             "--params-file")  # fmt: skip
    add = result.add_argument_group("topics").add_argument
    add("--topic", type=_remapping, action="append", default=[], metavar="NAME:=TOPIC",
        help="topic of the bag to read as the node's topic NAME, such as imu/data:=/gyro; may be "
             "given several times (default: the topic of that name, else the only one of a fitting "
             "type)")  # fmt: skip
    add = result.add_argument_group("output").add_argument
    add("--output", type=given_path, metavar="DIR",
        help="folder of the results (default: replay_BAG); of several bags or configurations each "
             "gets a folder of its own in it")  # fmt: skip
    add("--plot", action="store_true", help="also write replay.png: rates and coefficients")
    add("--report", action="store_true",
        help="also write report.html: everything on one page, for any browser")  # fmt: skip
    add = result.add_argument_group("several bags").add_argument
    add("--jobs", type=number(int, 1, sys.maxsize, " is not a number from 1 on"), metavar="N",
        default=os.cpu_count() or 1,
        help="processes at a time for several bags or configurations (default: "
             "%(default)s)")  # fmt: skip
    add("--scheduler", default="", metavar="ADDRESS",
        help="Dask scheduler whose workers do the work, such as tcp://host:8786; they must see the "
             "same paths")  # fmt: skip
    add("--again", action="store_true",
        help="replay all bags; without it those are skipped whose result is there already, of the "
             "same bag with the same settings")  # fmt: skip
    add("--aircraft", default="", metavar="NAME",
        help="aircraft in the table of flights (default: name of the folder that the bag is "
             "in)")  # fmt: skip
    return result


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
