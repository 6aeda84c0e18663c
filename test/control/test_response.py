# SPDX-License-Identifier: Apache-2.0
"""The response to the inputs: the jerk without the aircraft's own motion."""

import numpy as np
import pytest
from equations import AIRCRAFT, flight_equations, matrix, slope

from uav_ident_ros.client import AttitudeModel
from uav_ident_ros.control import Response
from uav_ident_ros.control.response import FORGETTING, PHI, own_motion
from uav_ident_ros.identification.flow import ATTITUDE_GAIN, FlowState
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    MAIN_DERIVATIVES,
    STRUCTURES,
    FloatArray,
)

STRUCTURE, AIRSPEED, DT, SUBSTEPS = STRUCTURES["flight_dynamics"], 25.0, 0.01, 5
LEVEL = np.array([0.0, 0.0, 0.0, 0.0, -GRAVITY / AIRCRAFT["az/alpha"], 0.0, 0.0])


def model_of(values: FloatArray, airspeed: float) -> AttitudeModel:
    flow = FlowState(0.0, 0.0, 0.0, 0.0, roll=0.0, pitch=0.0, airspeed=airspeed)
    return AttitudeModel(STRUCTURE, values, STRUCTURE.mask, flow)


def gains(share: FloatArray | float, airspeed: float = AIRSPEED) -> tuple[FloatArray, FloatArray]:
    """g of each axis by least squares, and its residual relative to the jerk, rms."""
    believed = matrix(STRUCTURE, AIRCRAFT)
    model = model_of(believed, airspeed)
    true, effect = believed.copy(), believed[:3, INPUT_COLUMNS]
    true[MAIN_DERIVATIVES] *= share
    true[:, STRUCTURE.index("qdot/1")[1]] = 0.0
    true[STRUCTURE.index("qdot/1")] = -AIRCRAFT["qdot/alpha"] * LEVEL[4]  # in trim
    response, state, found, before = Response(), LEVEL, [], np.zeros(4)
    for k in range(1000):
        u = 0.03 * np.sin(np.array([2.0, 3.0, 2.5, 0.0]) * DT * k)
        u[:3] *= np.array([1.0, 2.0, 0.5])
        if response.update(state[:3], effect, before[None], DT, model):
            found.append((response.answered[0], response.made[0]))
        for _ in range(SUBSTEPS):
            state = state + DT / SUBSTEPS * flight_equations(true, state, u, AIRSPEED)
        before = u
    answered, made = np.moveaxis(np.array(found)[200:], 1, 0)
    g = (answered * made).sum(axis=0) / (made**2).sum(axis=0)
    rest = np.sqrt(np.mean((answered - g * made) ** 2, axis=0) / np.mean(answered**2, axis=0))
    return g, rest


@pytest.mark.parametrize("share", [(1.0, 1.0, 1.0), (0.5, 1.0, 1.0), (-1.0, 0.5, 0.5)])
def test_the_response_is_that_of_the_inputs_alone(share: tuple[float, float, float]) -> None:
    assert gains(np.array(share))[0] == pytest.approx(share, abs=0.15)


@pytest.mark.parametrize("airspeed", [np.inf, 0.0])
def test_without_an_airspeed_more_of_the_response_is_unexplained(airspeed: float) -> None:
    """The own motion then has no sideslip by bank and no damping of the angle of attack."""
    (_, known), (_, unknown) = gains(1.0), gains(1.0, airspeed)
    assert (unknown > 1.5 * known)[1:].all()


def test_the_own_motion_is_that_of_level_flight() -> None:
    """The angle of attack is that of level flight; a roll turns it into sideslip."""
    true = matrix(STRUCTURE, AIRCRAFT)
    own = own_motion(model_of(true, AIRSPEED))
    slopes = slope(lambda x: flight_equations(true, x, np.zeros(4), AIRSPEED), LEVEL)[:6, :6]
    slopes[range(3, 5), range(3, 5)] -= 1.0 / FORGETTING
    slopes[PHI, PHI] -= ATTITUDE_GAIN
    np.testing.assert_allclose(own, slopes, atol=1e-6)


def test_the_effect_of_another_input_is_not_attributed_to_the_axis() -> None:
    """The aileron yaws, and the rudder compensates all of it."""
    true, effect = (
        np.zeros((3, 4)),
        np.array([[0.0, 0.0, 30.0], [-26.0, 0.0, 0.0], [0.0, -8.0, -5.0]]),
    )
    true[:, :3] = effect * np.array([1.0, 0.5, 1.0])
    model = AttitudeModel(STRUCTURE, matrix(STRUCTURE, {}), STRUCTURE.mask)
    response, x, found = Response(), np.zeros(3), []
    for k in range(600):
        aileron = 0.1 * np.sin(3.0 * DT * k)
        u = np.array([0.0, -5.0 / 4.0 * aileron, aileron, 0.0])
        believed = np.column_stack([effect, np.zeros(3)])
        if response.update(x, believed, u[None], DT, model, np.array([0.3, 0.0, 0.0])):
            found.append((response.answered[0, 2], response.made[0, 2]))
        x = x + DT * true @ u
    answered, made = np.array(found)[200:].T
    assert (answered * made).sum() / (made**2).sum() == pytest.approx(0.5, abs=0.05)


def test_a_tight_turn_does_not_bias_the_effect_of_the_elevator() -> None:
    """At 15 m/s, 35 degrees to both sides: a linear model has twice the lift of the turn."""
    airspeed, true = 15.0, matrix(STRUCTURE, AIRCRAFT | {"qdot/pr": 0.0, "qdot/1": 0.0})
    true[STRUCTURE.index("qdot/1")] = -AIRCRAFT["qdot/alpha"] * LEVEL[4]  # in trim
    response, state, u, found = Response(), LEVEL, np.zeros(4), []
    for k in range(3000):
        roll, pitch = state[5:]
        flow = FlowState(0.0, 0.0, 0.0, 0.0, roll, pitch, airspeed)
        if k % 5 == 0:  # a message arrives
            model = AttitudeModel(STRUCTURE, true, STRUCTURE.mask, flow)
        if response.update(state[:3], true[:3, INPUT_COLUMNS], u[None], DT, model):
            found.append((response.answered[0, 1], response.made[0, 1]))
        for _ in range(SUBSTEPS):
            state = state + DT / SUBSTEPS * flight_equations(true, state, u, airspeed)
        turn = GRAVITY / airspeed * np.tan(roll)
        bank = np.clip(0.6 * np.sign(np.sin(DT * k)) - roll, -0.4, 0.4)
        wanted = np.array([bank, turn * np.sin(roll) - pitch, turn * np.cos(roll)])
        u[[2, 0, 1]] = np.array([0.1, -0.3, -1.0]) * (wanted - state[:3])
    answered, made = np.array(found)[500:].T
    assert (answered * made).sum() / (made**2).sum() == pytest.approx(1.0, abs=0.1)


def test_the_filter_answers_a_step_most_after_70_ms() -> None:
    """Its bandwidth is 15 rad/s: beyond all laws, and below the noise of a gyro's derivative."""
    model = AttitudeModel(STRUCTURE, matrix(STRUCTURE, {}), STRUCTURE.mask)
    response, effect, made = Response(), np.zeros((3, 4)), []
    effect[0, 2] = 30.0
    for k in range(40):
        inputs = np.array([[0.0, 0.0, 0.1 * (k > 0), 0.0]])
        if response.update(np.zeros(3), effect, inputs, 0.01, model):
            made.append(response.made[0, 0])
    assert 0.01 * (1 + np.argmax(made)) == pytest.approx(np.arctan(0.75) / 9.0, abs=0.01)
    assert 0.01 * np.sum(made) == pytest.approx(3.0, rel=0.02)


def test_the_bias_of_a_gyro_turns_into_a_sideslip_of_half_a_minute() -> None:
    """Not into one that grows for ever: 0.01 rad/s make 0.3 rad."""
    own = own_motion(model_of(matrix(STRUCTURE, {}), AIRSPEED))
    assert own[3, 2] * 0.01 / -own[3, 3] == pytest.approx(-0.3)
    assert own[4, 1] * 0.01 / -own[4, 4] == pytest.approx(0.3)
