# SPDX-License-Identifier: Apache-2.0
"""Rate control on identified coefficients, to copy: NumPy and `uav_ident_ros.client`, no ROS.

`allocate` distributes an angular acceleration over limited inputs. `IncrementalLaw` and
`InversionLaw` are the control laws. `Response` and `Effectiveness` measure control effectiveness.
`AxisChoice` selects the control derivatives of each axis. `RateController` combines these parts.
"""

from uav_ident_ros.control.allocation import allocate
from uav_ident_ros.control.choice import AxisChoice, Effect
from uav_ident_ros.control.controller import LAWS, RateController
from uav_ident_ros.control.effectiveness import Effectiveness
from uav_ident_ros.control.laws import Gains, IncrementalLaw, InversionLaw
from uav_ident_ros.control.response import Response

__all__ = [
    "LAWS",
    "AxisChoice",
    "Effect",
    "Effectiveness",
    "Gains",
    "IncrementalLaw",
    "InversionLaw",
    "RateController",
    "Response",
    "allocate",
]
