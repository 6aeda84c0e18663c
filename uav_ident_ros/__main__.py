# SPDX-License-Identifier: Apache-2.0
"""``python -m uav_ident_ros COMMAND ...``: a command without its executable."""

import sys

from uav_ident_ros.commandline import COMMANDS, OneLineParser, run

if __name__ == "__main__":
    parser = OneLineParser(prog="python -m uav_ident_ros", add_help=False)
    parser.add_argument("command", choices=COMMANDS)
    sys.exit(run(parser.parse_args(sys.argv[1:2]).command, sys.argv[2:]))
