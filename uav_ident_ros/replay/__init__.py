# SPDX-License-Identifier: Apache-2.0
"""`replay`: the identifier over recorded flights, and how good its models were."""

from uav_ident_ros.replay.command import main

__all__ = ["main"]
