# SPDX-License-Identifier: Apache-2.0
"""Write both layouts, for the default names or for others.

``python -m uav_ident_ros.layouts config`` writes those that the package ships.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.layouts import foxglove, plotjuggler
from uav_ident_ros.layouts.plots import Names

DEFAULTS = Names("/identifier", "/imu/data", STRUCTURES[Settings().structure])
FAILED = 1


def full_name(text: str) -> str:
    """Return a node's or topic's name with its leading slash."""
    return f"/{text.strip('/')}"


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    result = argparse.ArgumentParser(
        prog="python -m uav_ident_ros.layouts",
        description="Write plotjuggler.xml and foxglove.json for the topics of an identifier.",
    )
    result.add_argument("folder", type=Path, help="folder for the two files")
    result.add_argument(
        "--node", type=full_name, default=DEFAULTS.node, help=f"its full name ({DEFAULTS.node})"
    )
    result.add_argument(
        "--imu-topic",
        type=full_name,
        default=DEFAULTS.rates_topic,
        help=f"topic of the measured rates, a sensor_msgs/msg/Imu ({DEFAULTS.rates_topic})",
    )
    result.add_argument(
        "--structure",
        choices=tuple(STRUCTURES),
        default=DEFAULTS.structure.name,
        help=f"structure of its coefficients ({DEFAULTS.structure.name})",
    )
    return result


def main(arguments: list[str] | None = None) -> int:
    """Write the files; the return value is the exit status."""
    options = parser().parse_args(arguments)
    names = Names(options.node, options.imu_topic, STRUCTURES[options.structure])
    try:
        for file, text in (
            ("plotjuggler.xml", plotjuggler.render(names)),
            ("foxglove.json", foxglove.render(names)),
        ):
            (options.folder / file).write_text(text, encoding="utf-8")
    except OSError as error:
        print(f"layouts: cannot write into '{options.folder}': {error.strerror}", file=sys.stderr)
        return FAILED
    return 0


if __name__ == "__main__":
    sys.exit(main())
