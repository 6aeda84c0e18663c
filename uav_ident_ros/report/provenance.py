# SPDX-License-Identifier: Apache-2.0
"""What a report was made from and with: versions of the software."""

from __future__ import annotations

import platform
from importlib import metadata

import uav_ident_ros

PACKAGES = ("numpy", "rosbags", "bokeh")
"""Packages that the numbers or the pictures depend on."""


def versions() -> dict[str, str]:
    """Return the versions of this package, of Python and of what it computes and draws with."""
    found = {"uav_ident_ros": uav_ident_ros.__version__, "Python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "unknown"
    return found
