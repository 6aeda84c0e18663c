# SPDX-License-Identifier: Apache-2.0
"""What is left of the jerk without the aircraft's own motion is what the inputs make."""

import numpy as np
import pytest
from equations import AIRCRAFT, flight_equations, matrix, slope

from uav_ident_ros.client import AttitudeModel
from uav_ident_ros.control import Response
from uav_ident_ros.control.response import FORGETTING, own_motion
from uav_ident_ros.identification.flow import FlowState
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.structure import INPUT_COLUMNS, STRUCTURES, FloatArray

STRUCTURE, AIRSPEED, DT, SUBSTEPS = STRUCTURES["flight_dynamics"], 25.0, 0.01, 5
LEVEL = np.array([0.0, 0.0, 0.0, 0.0, -GRAVITY / AIRCRAFT["az/alpha"], 0.0, 0.0])


def gains(share: FloatArray | float, airspeed: float = AIRSPEED) -> tuple[FloatArray, FloatArray]:
    """g of each axis by least squares, and the share of the jerk that it leaves unexplained."""
    believed = matrix(STRUCTURE, AIRCRAFT)
    flow = FlowState(0.0, 0.0, 0.0, 0.0, roll=0.0, pitch=0.0, airspeed=airspeed)
    model = AttitudeModel(STRUCTURE, believed, STRUCTURE.mask, flow)
    true, effect = believed.copy(), believed[:3, INPUT_COLUMNS]
    true[:3, INPUT_COLUMNS] *= np.reshape(share, (-1, 1))
    true[:, STRUCTURE.index("qdot/1")[1]] = 0.0
    true[STRUCTURE.index("qdot/1")] = -AIRCRAFT["qdot/alpha"] * LEVEL[4]  # in trim
    response, state, found, before = Response(), LEVEL, [], np.zeros(4)
    for k in range(1000):
        u = 0.03 * np.sin(np.array([2.0, 3.0, 2.5, 0.0]) * DT * k)
        u[:3] *= np.array([1.0, 2.0, 0.5])
        if response.update(state[:3], effect, before[None], DT, model):
            found.append((response.answered, response.made[0]))
        for _ in range(SUBSTEPS):
            state = state + DT / SUBSTEPS * flight_equations(true, state, u, AIRSPEED)
        before = u
    answered, made = np.moveaxis(np.array(found)[200:], 1, 0)
    g = (answered * made).sum(axis=0) / (made**2).sum(axis=0)
    rest = np.sqrt(np.mean((answered - g * made) ** 2, axis=0) / np.mean(answered**2, axis=0))
    return g, rest


@pytest.mark.parametrize("share", [(1.0, 1.0, 1.0), (0.5, 1.0, 1.0), (-1.0, 0.5, 0.5)])
def test_what_the_inputs_make_is_left(share: tuple[float, float, float]) -> None:
    assert gains(np.array(share))[0] == pytest.approx(share, abs=0.15)


def test_it_needs_to_know_what_the_flow_does() -> None:
    """Without an airspeed no bank makes a sideslip, and nothing damps the angle of attack."""
    (_, known), (_, unknown) = gains(1.0), gains(1.0, np.inf)
    assert (unknown > 1.5 * known)[1:].all()


def test_the_own_motion_is_that_of_level_flight() -> None:
    """At the angle of attack that carries the aircraft, of which a roll makes sideslip."""
    true = matrix(STRUCTURE, AIRCRAFT)
    flow = FlowState(0.0, 0.0, 0.0, 0.0, roll=0.0, pitch=0.0, airspeed=AIRSPEED)
    own = own_motion(AttitudeModel(STRUCTURE, true, STRUCTURE.mask, flow))
    slopes = slope(lambda x: flight_equations(true, x, np.zeros(4), AIRSPEED), LEVEL)[:6, :6]
    slopes[range(3, 6), range(3, 6)] -= 1.0 / FORGETTING
    np.testing.assert_allclose(own, slopes, atol=1e-6)
