# SPDX-License-Identifier: Apache-2.0
"""Identify the attitude dynamics of an unmanned aircraft while it flies.

topics in:   imu/data, actuators, excitation; airspeed and armed if their type is set
topics out:  ~/coefficients_named, ~/coefficients, ~/predicted_rates, ~/prediction_error,
             ~/excitation, /diagnostics
services:    ~/reset, ~/save, ~/adapt, ~/excite
exit status: 0, ended by a signal; 2, not started, with the reason in one line
"""

import sys

from uav_ident_ros.node.ending import Ending


def main(args: list[str] | None = None) -> int:
    """Run the node; the return value is the exit status: 2 after a wrong start."""
    ending = Ending()  # before the imports, which take a second
    from uav_ident_ros.identification.settings import declarations
    from uav_ident_ros.node.identifier_node import IdentifierNode, work
    from uav_ident_ros.node.program import run

    return run("identifier", IdentifierNode, work, args, __doc__, declarations(), ending)


if __name__ == "__main__":
    sys.exit(main())
