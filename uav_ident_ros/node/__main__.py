# SPDX-License-Identifier: Apache-2.0
"""The program `identifier`, and ``python -m uav_ident_ros.node``."""

import sys

from uav_ident_ros.node.ending import Ending


def main(args: list[str] | None = None) -> int:
    """Run the node; the return value is the exit status: 2 if it was started wrongly."""
    ending = Ending()  # before the imports, which take a second
    from uav_ident_ros.node.identifier_node import IdentifierNode, work
    from uav_ident_ros.node.program import identifier_usage, run

    return run("identifier", IdentifierNode, work, args, identifier_usage(), ending)


if __name__ == "__main__":
    sys.exit(main())
