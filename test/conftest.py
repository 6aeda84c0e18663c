# SPDX-License-Identifier: Apache-2.0
"""For all tests: BLAS threads, signals, drawn examples, and a ROS domain of their own."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator

import pytest
from hypothesis import settings

# The package limits BLAS's threads by the environment, so it must load before NumPy.
import uav_ident_ros  # noqa: F401

HIGHEST_DOMAIN = 101
"""Highest ROS domain whose ports are free of the system's ephemeral ones."""

# A shell starts what it runs in the background with SIGINT ignored, and every child inherits
# that: the programs under test could not be interrupted.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Every run draws the same examples, however slow the machine is. Others, and more of them:
# scripts/test --hypothesis-profile anew
settings.register_profile(
    "repeatable", max_examples=50, derandomize=True, deadline=None, database=None
)
settings.register_profile("anew", max_examples=500, deadline=None, print_blob=True)
settings.load_profile("repeatable")


@pytest.fixture(scope="session", autouse=True)
def ros_environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the traffic, logs and saved files of this process and its children to themselves."""
    domain, claim = claim_domain()
    environment = {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(tmp_path_factory.mktemp("log")),
        "ROS_HOME": str(tmp_path_factory.mktemp("ros_home")),
        "ROS_PYTHON_CHECK_FIELDS": "1",
        "RCUTILS_LOGGING_BUFFERED_STREAM": "0",
    }
    with claim, pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        yield


def claim_domain() -> tuple[int, socket.socket]:
    """Return a ROS domain of this machine and the socket that reserves it while it is open.

    Workers of pytest-xdist and test runs side by side each get one of their own: an abstract
    socket name belongs to one process, and the kernel frees it when that process ends.
    """
    for offset in range(HIGHEST_DOMAIN):
        domain = 1 + (os.getpid() + offset) % HIGHEST_DOMAIN
        claim = socket.socket(socket.AF_UNIX)
        try:
            claim.bind(f"\0uav_ident_ros/domain/{domain}")
        except OSError:
            claim.close()
            continue
        return domain, claim
    raise RuntimeError(f"all {HIGHEST_DOMAIN} ROS domains of this machine are taken by test runs")
