# SPDX-License-Identifier: Apache-2.0
"""Online identification of the attitude dynamics of unmanned aircraft, for ROS 2."""

__version__ = "0.1.0"
