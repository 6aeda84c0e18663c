# SPDX-License-Identifier: Apache-2.0
"""Attitude, sideslip and angle of attack from the Imu, against the true ones."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import flying
import numpy as np
import pytest
from equations import AIRCRAFT, flown, matrix, with_down
from light_aircraft import TRUTH

from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.flow import FlowObserver, FlowState
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.prior import first_values, slope_bounds
from uav_ident_ros.identification.regression import StateVariableFilter
from uav_ident_ros.identification.scales import GRAVITY_BAND
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.speed import LARGEST_SPEED_RATIO
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray
from uav_ident_ros.simulation.flight import CoefficientChange
from uav_ident_ros.simulation.inputs import ColouredNoise, Segment
from uav_ident_ros.simulation.noise import Measurements, Sensors, measure

FLIGHT = STRUCTURES["flight_dynamics"]
SPEED, CUTOFF = 20.0, 15.0
MOMENTS = np.s_[:3, FLIGHT.column("beta") :]


def observed(
    observer: FlowObserver,
    x: FloatArray,
    force: FloatArray,
    u: FloatArray,
    h: float,
    values: FloatArray | None = None,
    airspeed: float | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return flow angles (N, 2), and roll and pitch (N, 2), at the end of each cell, rad."""
    angles, attitude = [], []
    values = first_values(FLIGHT) if values is None else values
    for block in flying.blocks(x, u, h, force, cells=10):
        observer.follow(block, values, airspeed)
        state = block.state[1:]
        angles.append(state[:, 3:5])
        down = state[:, 5:]
        np.testing.assert_allclose(np.linalg.norm(down, axis=1), 1.0, atol=1e-4)
        attitude.append(np.stack([np.arctan2(down[:, 1], down[:, 2]), -np.arcsin(down[:, 0])], 1))
    return np.concatenate(angles), np.concatenate(attitude)


# --- attitude ----------------------------------------------------------------------------------


def turn(bank: float, seconds: float, h: float, roll_in: float = 2.0) -> tuple[FloatArray, ...]:
    """Roll, rates and specific force of a coordinated level turn with a smooth roll-in."""
    t = np.arange(round(seconds / h) + 1) * h
    s = np.clip(t / roll_in, 0.0, 1.0)
    roll = bank * (3.0 * s**2 - 2.0 * s**3)
    heading_rate = GRAVITY * np.tan(roll) / SPEED
    x = np.stack(
        [np.gradient(roll, h), heading_rate * np.sin(roll), heading_rate * np.cos(roll)], axis=1
    )
    force = np.zeros((len(t), 3))
    force[:, 2] = -GRAVITY / np.cos(roll)
    return roll, x, force


def observer() -> FlowObserver:
    return FlowObserver(FLIGHT, CUTOFF, SPEED)


@pytest.mark.parametrize(("bank", "h"), [(0.3, 0.02), (-0.8, 0.005), (-0.8, 0.02)])
def test_the_roll_angle_of_a_coordinated_turn_does_not_decay(bank: float, h: float) -> None:
    """The accelerometer alone indicates level flight throughout the turn."""
    roll, x, force = turn(bank, 60.0, h)
    _, attitude = observed(observer(), x, force, np.zeros((len(x) - 1, 4)), h)
    error = attitude - np.stack([roll[1:], 0.0 * roll[1:]], axis=1)[: len(attitude)]
    assert np.abs(error).max() < math.radians(1.0)


def test_the_attitude_is_corrected_for_a_gyro_bias() -> None:
    _, x, force = turn(0.0, 360.0, 0.04)
    drift = np.array([0.02, -0.015, 0.0])
    _, attitude = observed(observer(), x + drift, force, np.zeros((len(x) - 1, 4)), 0.04)
    assert np.abs(attitude[len(attitude) // 2 :]).max() < math.radians(0.5)
    assert np.abs(attitude).max() > math.radians(1.0)


@pytest.mark.parametrize(("bank", "limit"), [(0.0, GRAVITY_BAND), (0.3, 0.12)])
def test_a_bias_found_realigns_the_attitude_in_a_new_stretch(bank: float, limit: float) -> None:
    """Until then it drifts by half a radian; level, the roll may look like a yaw."""
    _, x, force = turn(bank, 60.0, 0.04)
    own, errors, begun = observer(), [], []
    inputs, biased = np.zeros((len(x) - 1, 4)), x + np.array([0.1, -0.1, 0.0])
    for block in flying.blocks(biased, inputs, 0.04, force, cells=10):
        own.follow(block, first_values(FLIGHT), None)
        begun.append(block.restarted)
        errors.append(np.abs(np.subtract(own.attitude, (bank, 0.0))).max())
    found = begun.index(True, 1)
    assert sum(begun) == 2  # the flight's and the one then
    assert max(errors[:found]) > 2.0 * GRAVITY_BAND
    assert max(errors[found:]) < limit


def test_the_observer_starts_at_the_attitude_of_the_first_samples() -> None:
    roll, pitch = 0.5, -0.3
    level = math.cos(pitch)
    down = np.array([-math.sin(pitch), math.sin(roll) * level, math.cos(roll) * level])
    force = np.tile(-GRAVITY * down, (11, 1))
    own = observer()
    _, attitude = observed(own, np.zeros((11, 3)), force, np.zeros((10, 4)), 0.01)
    np.testing.assert_allclose(attitude[-1], [roll, pitch], atol=1e-6)
    state = own.state(first_values(FLIGHT), np.zeros(FLIGHT.mask.shape))
    assert (state.roll, state.pitch) == pytest.approx((roll, pitch), abs=1e-6)
    np.testing.assert_allclose(state.down, down, atol=1e-6)


def pushed(forward: float, seconds: float, scale: float = 1.0) -> FloatArray:
    """Roll and pitch, level and then accelerated forward, m/s^2, without an airspeed."""
    h = 0.02
    force = np.tile([0.0, 0.0, -GRAVITY], (round((1.0 + seconds) / h) + 1, 1))
    force[round(1.0 / h) :, 0] = forward
    force *= scale
    return observed(observer(), np.zeros_like(force), force, np.zeros((len(force) - 1, 4)), h)[1]


def test_only_a_long_forward_acceleration_within_30_percent_of_gravity_tilts() -> None:
    """It resembles a pitch of 11 degrees, followed at a tenth of 1/s; a launch at one g is none."""
    apparent = math.atan2(2.0, GRAVITY)
    assert 0.07 < pushed(2.0, 1.0)[-1, 1] / apparent < 0.1
    assert pushed(2.0, 180.0)[-1, 1] == pytest.approx(apparent, rel=0.01)
    assert np.abs(pushed(0.9 * GRAVITY, 2.0)).max() < math.radians(0.1)
    for scale in (0.8, 1.2):  # errors of the accelerometer
        apparent = math.atan2(1.0, GRAVITY)
        assert pushed(1.0, 180.0, scale)[-1, 1] == pytest.approx(apparent, rel=0.05)


# --- flow angles --------------------------------------------------------------------------------


def test_the_flow_angles_of_a_jsbsim_aircraft_vary_as_the_true_ones() -> None:
    """The means differ: alpha is relative to zero lift here, and the origin is a convention.

    Forces by rates have no regressor and make the remaining error.
    """
    pytest.importorskip("jsbsim", reason="JSBSim is a development extra")
    from uav_ident_ros.simulation.jsbsim_flight import AircraftFlight

    segment = Segment("multisine", amplitudes=dict.fromkeys(("de", "dr", "da"), 0.05), seed=1)
    flight = AircraftFlight((segment,), 30.0, 200.0, aircraft="c172p").fly()
    values, u = matrix(FLIGHT, flight.local_truth), (flight.extra["surfaces"] - flight.trim)[:-1]
    assert flight.airspeed is not None
    own = FlowObserver(FLIGHT, CUTOFF, float(flight.airspeed.mean()))
    found, _ = observed(own, flight.rates, flight.specific_force, u, 1.0 / flight.rate, values)
    true = np.stack([flight.extra["beta"], flight.extra["alpha"]], axis=1)[1 : len(found) + 1]
    found, true = (part[round(2.0 * flight.rate) :] for part in (found, true))
    assert (true.std(axis=0) > math.radians(0.3)).all()
    assert ((found - true).std(axis=0) < 0.2 * true.std(axis=0)).all()


def test_a_roll_in_a_sideslip_changes_alpha_as_the_kinematics_row_predicts() -> None:
    h, a, az = 0.01, matrix(FLIGHT, AIRCRAFT), FLIGHT.index("az/alpha")
    t = np.arange(round(10.0 / h)) * h
    u, whole, force = np.zeros((len(t), 4)), [with_down(np.zeros(7))], []
    u[:, 0], u[:, 1] = 0.01 * np.sin(9.0 * t), 0.4
    u[:, 2] = 0.15 + 0.2 * np.sign(np.sin(4.0 * t))
    state = np.zeros(7)
    for held in [*u, u[-1]]:
        p, q, r, beta, alpha = state[:5]
        f = np.array([p * q, q * r, p * r, p * p, r * r, p, q, r, *held, 1.0, beta, alpha])
        force.append([0.0, *(a[3:5] @ f)])
        state = flown(a, state, held, SPEED, h)
        whole.append(with_down(state))
    states = np.array(whole[:-1])
    assert np.abs(states[:, 0] * states[:, 3]).max() > 0.2  # rad/s
    (block,) = flying.blocks(states[:, :3], u, h, np.array(force))
    block = replace(block, state=states, airspeed=SPEED)
    found = StateVariableFilter(FLIGHT, CUTOFF, h, np.zeros(3)).apply(block, None, a)
    columns = [FLIGHT.size + 1, -2, FLIGHT.column("1")]  # kinematics, de's slope, bias
    slopes, *_ = np.linalg.lstsq(found.f[:, columns], found.y[:, 4], rcond=None)
    left = found.y[:, 4] - found.f[:, columns] @ slopes
    assert slopes[0] == pytest.approx(a[az], rel=0.01)
    assert np.std(left) < 0.01 * np.std(found.y[:, 4])


def test_the_sigma_of_the_flow_angles_is_that_of_the_slopes() -> None:
    own = observer()
    own.angles = [0.1, -0.2]
    values, sigma = first_values(FLIGHT), np.zeros(FLIGHT.mask.shape)
    sigma[FLIGHT.index("ay/beta")] = 0.1 * abs(values[FLIGHT.index("ay/beta")])
    sigma[FLIGHT.index("az/alpha")] = 0.5 * abs(values[FLIGHT.index("az/alpha")])
    state = own.state(values, sigma)
    assert isinstance(state, FlowState)
    assert (state.beta, state.alpha) == (0.1, -0.2)
    assert state.beta_sigma == pytest.approx(0.01)
    assert state.alpha_sigma == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("airspeed", "used"),
    [
        (None, SPEED),
        (0.9 * SPEED / LARGEST_SPEED_RATIO, SPEED),
        (1.1 * SPEED / LARGEST_SPEED_RATIO, 1.1 * SPEED / LARGEST_SPEED_RATIO),
        (2.0 * SPEED, 2.0 * SPEED),
    ],
)
def test_the_airspeed_is_the_measured_one_unless_it_is_below_flying_speed(
    airspeed: float | None, used: float
) -> None:
    own = observer()
    force = np.tile([0.0, 0.0, -GRAVITY], (11, 1))
    observed(own, np.zeros((11, 3)), force, np.zeros((10, 4)), 0.01, airspeed=airspeed)
    assert own.state(first_values(FLIGHT), np.zeros(FLIGHT.mask.shape)).airspeed == used


# --- an aircraft without an accelerometer -------------------------------------------------------


def without_accelerometer(stream: list[flying.SentSample]) -> list[flying.SentSample]:
    return [
        message._replace(values=(*message.values[:3], 0.0, 0.0, 0.0))
        if message.stream == "rates"
        else message
        for message in stream
    ]


@pytest.mark.parametrize("estimator", ["least_squares", "instrumental_variable"])
def test_without_an_accelerometer_the_moment_rows_are_those_without_flow(estimator: str) -> None:
    m = measure(
        flying.plant_flight(10.0, gusts=ColouredNoise(0.3, 0.3)), Sensors(gyro_noise=0.02), seed=1
    )
    stream = without_accelerometer(flying.messages(m))
    fixed = {"fixed_coefficients": ("pdot/ay", "qdot/az", "rdot/ay")}
    last, expected = (
        flying.identified(m, stream=stream, estimator=estimator, structure=structure, **own)[1][-1]
        for structure, own in (("flight_dynamics", {}), ("augmented", fixed))
    )
    np.testing.assert_allclose(last.coefficients[:3], expected.coefficients, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(last.sigma[:3], expected.sigma, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(last.predicted_rates, expected.predicted_rates, atol=1e-6)
    assert not last.coefficients[MOMENTS].any()
    assert not last.sigma[MOMENTS].any()
    np.testing.assert_array_equal(last.coefficients[3:], first_values(FLIGHT)[3:])


def test_a_warm_start_is_published_complete_before_the_first_update() -> None:
    """The coefficients of the flow angles do not wait for an accelerometer."""
    values = np.where(FLIGHT.mask, -5.0, 0.0)
    saved = CoefficientSet("flight_dynamics", values, 0.1 * np.abs(values))
    identifier = OnlineIdentifier(Settings())
    identifier.resume(saved)
    identifier.add_rates(10**9, (0.0, 0.0, 0.0), (0.0, 0.0, GRAVITY))
    first = identifier.update(2 * 10**9)
    assert first is not None
    assert first.state == "waiting"
    expected = np.where(FLIGHT.mask, np.minimum(values, slope_bounds(FLIGHT)), 0.0)
    np.testing.assert_array_equal(first.coefficients, expected)
    assert (first.sigma[FLIGHT.mask] > 0.0).all()


def test_the_flow_rows_are_learned_with_a_late_accelerometer() -> None:
    m = flying.light_measured(60.0, gust=0.0)
    stream = flying.messages(m)
    late = int(m.imu_t_ns[0]) + 15 * 10**9
    mixed = [
        changed if message.t_ns < late else message
        for message, changed in zip(stream, without_accelerometer(stream), strict=True)
    ]
    _, estimates = flying.identified(m, stream=mixed)
    before = next(e for e in estimates if e.t_ns > late - 10**9)
    assert not before.coefficients[MOMENTS].any()
    assert (flying.light_errors(estimates[-1], "az/alpha", "qdot/alpha")[0] < 0.15).all()


def test_a_reversed_rudder_has_its_moment_and_its_side_force_reversed() -> None:
    """The whole rdot/dr includes the effect of the rudder's own side force, as does pdot/dr."""
    weak = dict.fromkeys(("de", "dr", "da"), 0.04)
    reversed_at = (CoefficientChange(34.0, {"dr": -1.0}),)
    imu = {"accelerometer_noise": 0.3}
    m = flying.light_measured(49.0, weak, 0.0, imu, noise_seed=2, seed=2, changes=reversed_at)
    _, (*_, last) = flying.identified(m)
    shares, sigmas = flying.light_errors(last, "rdot/dr", "ay/dr", factor=-1.0)
    assert (shares < 0.2).all() and (sigmas < 2.0).all()
    assert flying.light_errors(last, "pdot/dr", factor=-1.0)[0] < 1.0


def rudder_alone(
    seconds: float, seed: int, sensors: Mapping[str, Any] | None = None
) -> Measurements:
    """Measurements of a flight in calm air with excitation of the rudder alone."""
    segments = (Segment("multisine", 0.0, seconds, {"dr": 0.08}, 10.0, (0.2, 2.0), seed=seed),)
    flight = {"segments": segments, "delay": 0.02, "gust": 0.0, "seed": seed}
    return flying.light_measured(seconds, sensors=sensors, noise_seed=seed, **flight)


@pytest.mark.parametrize("seed", [1, 6])
def test_with_a_resting_elevator_the_lift_bound_limits_the_angle_of_attack(seed: int) -> None:
    """Without the bound, alpha of a radian would turn the sideslip into roll."""
    _, estimates = flying.identified(rudder_alone(80.0, seed))
    assert max(abs(e.flow.alpha) for e in estimates[500:] if e.flow is not None) < 0.5
    off, _ = flying.light_errors(estimates[-1], "ay/beta", "rdot/r", "rdot/beta", "rdot/dr")
    assert (off < 0.4).all()


@pytest.mark.parametrize("arm", [(0.0, 0.0, 0.0), (1.5, 0.0, -0.3)])
def test_a_force_step_of_the_rudder_does_not_bias_the_aileron(arm: tuple[float, ...]) -> None:
    """A force half a sample early would change pdot/da from 45 to 33."""
    quiet = {"gyro_noise": 1e-6, "accelerometer_noise": 1e-5, "lever_arm": arm}
    *_, last = flying.identified(rudder_alone(40.0, 1, quiet))[1]
    assert flying.light_errors(last, "pdot/da")[0] < 0.05


# An accelerometer this far ahead feels the turn by the fin as much as this little side force, the
# other way
AHEAD = (0.27, 0.0, 0.06)
SLIM = TRUTH | {"rdot/beta": 38.0, "ay/beta": -6.0}


def at(arm: tuple[float, ...], **changes: Any) -> Measurements:
    """Measurements by an accelerometer at `arm`."""
    sensors = {"lever_arm": arm, "gyro_noise": 0.003}
    return flying.light_measured(40.0, sensors=sensors, derivatives=SLIM, **changes)


def test_sideslip_and_delay_are_those_by_an_accelerometer_at_the_centre_of_gravity() -> None:
    slips, delays = [], []
    for arm in ((0.0, 0.0, 0.0), AHEAD):
        identifier, estimates = flying.identified(
            at(arm, gust=0.8, delay=0.05), actuators__delay=0.05
        )
        slips.append(np.array([e.flow.beta for e in estimates[-300:] if e.flow is not None]))
        delays.append(identifier.delays.estimate.delay)
    assert np.std(slips[1] - slips[0]) < 0.2 * np.std(slips[0])
    assert abs(delays[1] - delays[0]) < 0.005


def test_an_accelerometer_ahead_is_not_taken_for_a_reversed_yaw_rate() -> None:
    """Its force grows with the velocity across the body, unless the arm is configured."""
    ahead = at(AHEAD)
    assert flying.identified(ahead)[0].plausibility.doubt is None
    doubt = flying.identified(ahead, imu__lever_arm=[0.0, 0.0, 0.0])[0].plausibility.doubt
    assert doubt is not None
    assert "imu.lever_arm" in doubt.finding.text
