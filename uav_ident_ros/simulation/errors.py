# SPDX-License-Identifier: Apache-2.0
"""The exception of the simulation."""


class SimulationError(ValueError):
    """A flight cannot be simulated as asked; the message names what and why."""
