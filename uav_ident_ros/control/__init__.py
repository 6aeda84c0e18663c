# SPDX-License-Identifier: Apache-2.0
"""Rate control on identified coefficients, to copy: NumPy and `uav_ident_ros.client`, no ROS.

`allocate` gives inputs within their limits; `IncrementalLaw` and `InversionLaw` say which angular
acceleration to ask for; `Response` and `Effectiveness` measure what the inputs really do;
`AxisChoice` decides axis by axis whose control derivatives to fly on; `RateController` is all of it
together.
"""

from uav_ident_ros.control.allocation import allocate
from uav_ident_ros.control.choice import AxisChoice, Effect
from uav_ident_ros.control.controller import LAWS, RateController
from uav_ident_ros.control.effectiveness import Effectiveness
from uav_ident_ros.control.incremental import IncrementalLaw
from uav_ident_ros.control.inversion import InversionLaw
from uav_ident_ros.control.reference import Gains
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
