# SPDX-License-Identifier: Apache-2.0
"""`replay`: the identifier over recorded flights, and how good its models were."""

import sys

NODE_NAME = "/identifier"

USABLE, NOT_USABLE, NO_RESULT = 0, 1, 2
"""Exit status: what scripts are told."""


def main(args: list[str] | None = None) -> int:
    """Run the command; the return value is the exit status, see `replay --help`."""
    from uav_ident_ros.offline.options import parser

    command_line = parser()
    options = command_line.parse_args(args)  # help needs none of what follows
    try:
        from uav_ident_ros.offline.command import run
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        print(
            f"replay: the Python package '{package}' is missing, which apt does not have: run "
            "scripts/setup, or in a virtual environment with --system-site-packages: "
            "pip install rosbags mcap",
            file=sys.stderr,
        )
        return NO_RESULT
    return run(command_line, options)
