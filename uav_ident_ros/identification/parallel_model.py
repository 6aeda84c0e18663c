# SPDX-License-Identifier: Apache-2.0
"""The identified model in parallel with the aircraft: what it predicts, and the instruments."""

from __future__ import annotations

import numpy as np

from uav_ident_ros.identification.flow import FlowObserver
from uav_ident_ros.identification.model import IdentifiedModel
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.scales import RESPONSE_TIME
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import FloatArray, Structure


class ParallelModel:
    """The identified model, run on the same inputs as the aircraft.

    Its states have neither gyro noise nor gusts in them, which makes them instruments. While
    something is injected on purpose, its response to that alone is free of feedback, too.

    Parameters
    ----------
    settings : Settings
        Lever arm, filter and reference airspeed.
    structure : Structure
        Regressors and coefficients.

    Attributes
    ----------
    model : IdentifiedModel
        What predicts the rates.
    flow : FlowObserver or None
        Observer of attitude and flow angles; None for a structure without them.
    """

    def __init__(self, settings: Settings, structure: Structure) -> None:
        arm = np.array(settings.imu.lever_arm)
        self.model = IdentifiedModel(structure, arm)
        self._response = IdentifiedModel(structure, arm)
        self._since_injected = RESPONSE_TIME
        self.flow: FlowObserver | None = None
        if structure.has_flow:
            self.flow = FlowObserver(structure, settings.filter.cutoff, settings.airspeed.reference)

    def follow(
        self, block: Block, coefficients: FloatArray, airspeed: float | None, leak_time: float
    ) -> tuple[FloatArray, bool]:
        """Run over a block, and observe the flow in it.

        Parameters
        ----------
        block : Block
            Measured signals over m cells; its flow is set.
        coefficients : (R, n) array
            A_m at the airspeed flown.
        airspeed : float or None
            True airspeed, m/s; None where none is measured.
        leak_time : float
            Time constant of the pull towards the measured state, s; 0 for none.

        Returns
        -------
        states : (m + 1, 3 or 8) array
            The state at the edges, of which instruments are made.
        injected : bool
            Whether it is the response to what was injected on purpose alone.
        """
        if self.flow is not None:
            block.flow = self.flow.follow(block, coefficients, airspeed)
        states = self.model.run(coefficients, block, leak_time)
        self._since_injected += block.time
        if block.excitation is None:
            return states, False
        if block.excitation.any():
            self._since_injected = 0.0
        if self._since_injected >= RESPONSE_TIME:
            return states, False
        return self._response.respond(coefficients, block, leak_time), True
