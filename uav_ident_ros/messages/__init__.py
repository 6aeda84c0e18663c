# SPDX-License-Identifier: Apache-2.0
"""Every supported message type: ROS messages to plain values and back."""
