# SPDX-License-Identifier: Apache-2.0
"""A custom message type: rates in a `geometry_msgs/msg/TwistStamped`, of a source without an Imu.

``python3 examples/own_message.py identifier --ros-args --params-file FILE`` runs the node with it,
``python3 examples/own_message.py replay BAG --params-file FILE`` replays a bag. The file has the
line ``imu.type: geometry_msgs/msg/TwistStamped``.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

from uav_ident_ros.commandline import replay
from uav_ident_ros.messages.types import RATE_ADAPTERS, RatesAdapter, RatesReading, header_ns
from uav_ident_ros.node.__main__ import main as identifier


def read_twist(message: Any) -> RatesReading:
    """Return the reading of a twist in the axes of the body, as `imu.convention` gives them."""
    rates = message.twist.angular
    return RatesReading(
        stamp_ns=header_ns(message),
        rates=(rates.x, rates.y, rates.z),
        specific_force=None,  # A twist has none
        frame_id=message.header.frame_id,
    )


RATE_ADAPTERS["geometry_msgs/msg/TwistStamped"] = RatesAdapter(read_twist)
"""From here on it is a choice of the setting ``imu.type``. The tables `ACTUATOR_ADAPTERS`,
`AIRSPEED_READERS` and `ARMED_READERS` beside `RATE_ADAPTERS` are those of the other inputs."""


def main(program: str, arguments: list[str]) -> int:
    """Run the node or a replay; return its exit status."""
    return identifier([program, *arguments]) if program == "identifier" else replay(arguments)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("program", choices=("identifier", "replay"))
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="those of the program")
    given = parser.parse_args()
    sys.exit(main(given.program, given.arguments))
