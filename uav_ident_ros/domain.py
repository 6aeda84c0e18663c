# SPDX-License-Identifier: Apache-2.0
"""A ROS domain for a program and its children alone."""

import os
import secrets
import socket
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

HIGHEST_DOMAIN = 101
"""Highest ROS domain whose ports are free of the system's ephemeral ones."""

LAST_DOMAIN = 232
"""The last that has ports at all."""

CLAIM = "\0uav_ident_ros/domain/{}"
"""Abstract socket that stands for a domain: it belongs to one process and ends with it."""


@contextmanager
def own_domain(
    # The domain; one that no other such process of this machine has if left out
    domain: int | None = None,
) -> Iterator[int]:
    """Keep the traffic of this process and its children to this machine and one domain.

    Yields
    ------
    int
        The domain.
    """
    with _claimed() if domain is None else nullcontext(domain) as chosen:
        own = {"ROS_DOMAIN_ID": str(chosen), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        before = {name: os.environ.get(name) for name in own}
        os.environ.update(own)
        try:
            yield chosen
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name)
                else:
                    os.environ[name] = value


@contextmanager
def _claimed() -> Iterator[int]:
    """Yield a domain and hold it; a random one first, so that searches do not queue up."""
    first = secrets.randbelow(HIGHEST_DOMAIN)
    for offset in range(HIGHEST_DOMAIN):
        domain = 1 + (first + offset) % HIGHEST_DOMAIN
        with socket.socket(socket.AF_UNIX) as claim:
            try:
                claim.bind(CLAIM.format(domain))
            except OSError:
                continue
            yield domain
            return
    raise RuntimeError(f"all {HIGHEST_DOMAIN} ROS domains of this machine are taken")
