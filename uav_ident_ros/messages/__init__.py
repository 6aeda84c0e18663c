# SPDX-License-Identifier: Apache-2.0
"""Conversion of all supported ROS messages to plain values and back."""
