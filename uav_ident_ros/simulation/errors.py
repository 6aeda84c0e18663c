# SPDX-License-Identifier: Apache-2.0
"""The exception of the simulation."""

from __future__ import annotations


class SimulationError(ValueError):
    """A flight cannot be simulated as asked; the message names what and why."""
