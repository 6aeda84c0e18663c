# SPDX-License-Identifier: Apache-2.0
"""The delay is found where the flight shows it, and nowhere else."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import flying
import numpy as np
import pytest
from numpy.typing import ArrayLike

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.identification import delay
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.residuals import ANSWER_TIMES
from uav_ident_ros.identification.sampling import Block
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray
from uav_ident_ros.offline.inputs import choose_inputs
from uav_ident_ros.offline.run import OfflineRun
from uav_ident_ros.simulation.flight import Flight
from uav_ident_ros.simulation.inputs import ColouredNoise, Segment
from uav_ident_ros.simulation.noise import Sensors, measure
from uav_ident_ros.simulation.quadrotor_flight import AMPLITUDES, QuadrotorFlight

NOISY = Sensors(gyro_noise=0.02, accelerometer_noise=0.1)
REAL_FLIGHT = Path(__file__).resolve().parents[3] / "shared" / "bags" / "thor75_auto"
UNKNOWN = {"actuators__delay": 0.0, "actuators__estimate_delay": True}
DELAYS = delay.STEP * np.arange(-2, 13)


def found(flight: Flight, sensors: Sensors = NOISY, **changes: Any) -> OnlineIdentifier:
    m = measure(flight, sensors)
    return flying.identified(m, estimator="least_squares", **{**UNKNOWN, **changes})[0]


@pytest.mark.parametrize(("delay", "lag"), [(0.15, 0.0), (0.02, 0.12)])
def test_in_calm_air_delay_and_lag_are_found_together(delay: float, lag: float) -> None:
    """With the lag in use."""
    estimate = found(flying.plant_flight(32.0, delay=delay, time_constant=lag)).delays.estimate
    assert estimate.sure and estimate.delay == pytest.approx(delay, abs=0.015)
    assert estimate.total_sure and estimate.total == pytest.approx(delay + lag, abs=0.015)


@pytest.mark.parametrize("rate", [20.0, 1000.0])
def test_at_any_rate_of_the_imu(rate: float) -> None:
    flight = flying.plant_flight(30.0, delay=0.06, rate=1000.0, max_step=1e-3)
    identifier = found(flight, Sensors(rate=rate, gyro_noise=0.01))
    assert identifier.delay == pytest.approx(0.06, abs=0.015)


def test_a_wrong_start_is_corrected_in_gusts_under_an_autopilot() -> None:
    flight = flying.plant_flight(30.0, delay=0.06, gusts=ColouredNoise(0.3, 0.3), autopilot=True)
    assert found(flight, actuators__delay=0.2).delay == pytest.approx(0.06, abs=0.015)


@pytest.mark.parametrize("gusts", [0.3, 1.0])
def test_without_excitation_it_says_nothing(gusts: float) -> None:
    """The autopilot's answers to gusts tell of the autopilot, not of the delay."""
    air = ColouredNoise(gusts, 0.3)
    flight = flying.plant_flight(30.0, segments=(), delay=0.06, gusts=air, autopilot=True)
    identifier = found(flight, actuators__delay=0.04)
    assert identifier.delay == 0.04
    assert identifier.delay_confidence != "sure"


def test_an_autopilot_that_answers_every_gust_leaves_the_delay_unknown() -> None:
    """In gusts a hovering quadrotor's comes out 30 ms too long."""
    segments = (Segment("multisine", 2.0, amplitudes=AMPLITUDES, band=(0.2, 4.0)),)
    noise = ColouredNoise(0.5, 0.3)
    flight = QuadrotorFlight(segments, 30.0, 500.0, delay=0.012, gusts=noise).fly()
    sensors = Sensors(rate=100.0, gyro_noise=0.01)
    estimate = found(flight, sensors).delays.estimate
    assert abs(estimate.delay - 0.012) < 1.5 * estimate.sigma
    assert not estimate.sure


def test_nothing_is_known_before_there_are_data() -> None:
    identifier = OnlineIdentifier(Settings.from_values({"actuators.estimate_delay": True}))
    assert (identifier.delay, identifier.delay_confidence) == (0.0, "none")
    assert identifier.delay_sigma == math.inf


def flown_with(
    delay: float, told: float, lag_told: float = 0.0, lag: float = 0.0, seconds: float = 40.0,
    **changes: Any,
) -> tuple[OnlineIdentifier, Estimate]:  # fmt: skip
    """Return an identifier, told a delay and a lag, after a flight with those of the servos."""
    m = flying.light_measured(seconds, delay=delay, time_constant=lag)
    values = {"actuators__delay": told, "actuators__time_constant": lag_told, **changes}
    identifier, (*_, last) = flying.identified(m, **values)
    return identifier, last


def sigma_of(estimate: Estimate, name: str) -> float:
    return float(estimate.sigma[STRUCTURES["flight_dynamics"].index(name)])


def test_a_delay_that_is_a_little_off_makes_the_rows_less_sure() -> None:
    """Each by how fast it settles: pdot by 7 1/s times 25 ms."""
    told, off = (flown_with(0.045, told) for told in (0.045, 0.02))
    assert told[1].usable
    assert off[0].delay == 0.02
    assert off[0].delay_confidence == "none"
    for name in ("pdot/da", "qdot/de"):
        assert sigma_of(off[1], name) > 2.0 * sigma_of(told[1], name)
    assert (flying.light_errors(off[1], "pdot/da", "qdot/de")[1] < 2.0).all()


@pytest.mark.parametrize(
    ("delay", "told", "lag", "words"),
    [
        (0.14, 0.02, 0.0, "later than 'actuators.delay'"),
        (0.02, 0.08, 0.0, "earlier than 'actuators.delay'"),
        (0.02, 0.02, 0.1, "lower 'actuators.time_constant'"),
    ],
)
def test_no_row_is_usable_that_inputs_would_falsify_by_a_quarter(
    delay: float, told: float, lag: float, words: str
) -> None:
    identifier, last = flown_with(delay, told, lag)
    assert identifier.delay == told
    assert not any(last.usable_rows[:2])
    assert words in last.reason


def test_inputs_that_come_seldom_are_held_too_long_and_a_line_mends_it() -> None:
    """'Correct their stamps' was said of commands at 10 Hz, whose stamps were right."""
    m = flying.light_measured(50.0, delay=0.02)
    fifth = slice(None, None, 5)
    m = replace(
        m,
        actuators=m.actuators[fifth],
        actuator_t_ns=m.actuator_t_ns[fifth],
        actuator_log_ns=m.actuator_log_ns[fifth],
    )
    _, (*_, held) = flying.identified(m)
    assert "they come every 100 ms and are held until then: publish" in held.reason
    _, (*_, joined) = flying.identified(m, actuators__interpolation="linear")
    assert "the inputs act" not in joined.reason
    assert (flying.light_errors(joined, "pdot/da", "qdot/de")[0] < 0.15).all()


def test_what_was_learned_with_the_wrong_delay_does_not_stay() -> None:
    flight = flying.plant_flight(45.0, delay=0.06)
    identifier = found(flight, Sensors(), structure="throttle_coupled")
    assert identifier.delay == pytest.approx(0.06, abs=0.005)
    assert identifier.delay_confidence == "sure"
    assert flying.worst_error(identifier.estimator.coefficients, flight) < 0.05


def test_what_was_learned_with_another_delay_counts_for_a_second() -> None:
    """Its sigma grows by the root of that and a little, since few seconds have told the scatter.

    The value stays until there are new data: a tick is none.
    """
    m = measure(flying.plant_flight(25.0, delay=0.06), NOISY)
    flown = OnlineIdentifier(
        flying.settings(m, estimator="least_squares", structure="throttle_coupled", **UNKNOWN)
    )
    damping, kept = flown.structure.index("pdot/p"), []
    for message in flying.messages(m):
        kept += [(flown.delay > 0.0, e) for e in flying.run(flown, [message])]
    first = [after for after, _ in kept].index(True)
    (_, before), (_, after) = kept[first], kept[first + 1]  # forgotten behind the tick
    grown = np.sqrt((before.t_ns - kept[0][1].t_ns) * 1e-9)  # learned from the start on
    assert 1.0 < after.sigma[damping] / before.sigma[damping] / grown < 1.4
    assert after.coefficients[damping] == pytest.approx(before.coefficients[damping], rel=0.02)


def test_the_model_s_own_error_with_the_wrong_delay_is_forgotten() -> None:
    """A rudder that came 0.12 s late by then is known again within twenty seconds."""
    identifier, last = flown_with(0.14, 0.02, seconds=52.0, actuators__estimate_delay=True)
    assert identifier.delay == pytest.approx(0.14, abs=0.015)
    assert sigma_of(last, "rdot/dr") < 0.15 * 9.0
    assert flying.light_errors(last, "rdot/dr")[1] < 2.0


def test_a_lag_that_a_delay_stands_for_makes_the_quick_axes_unsure() -> None:
    """It takes from an aileron what no delay does, and predicts no better."""
    (hidden, unsure), (_, last) = (
        flown_with(0.02, 0.02, told, 0.12, 60.0, actuators__estimate_delay=True)
        for told in (0.0, 0.12)
    )
    assert hidden.delay_confidence == "sure"
    share, sigmas = flying.light_errors(unsure, "pdot/da")
    assert share > 0.2 and sigmas < 3.0
    assert "servo lag are not separated" in unsure.reason
    assert "'actuators.time_constant'" in unsure.reason
    assert flying.light_errors(last, "pdot/da")[1] < 2.0
    assert sigma_of(last, "pdot/da") < 0.1 * 45.0
    assert "a servo lag of" not in last.reason


def test_the_delay_survives_a_gap_and_a_new_time_base() -> None:
    m = measure(flying.plant_flight(45.0, delay=0.06), NOISY)
    start = int(m.imu_t_ns[0])
    identifier = OnlineIdentifier(flying.settings(m, **UNKNOWN))

    def broken(message: flying.Message) -> flying.Message:
        after = message.t_ns - start
        return message._replace(t_ns=message.t_ns + (after > 38e9) * 3600 * 10**9)

    kept = [m for m in flying.messages(m) if not 19e9 < m.t_ns - start < 19.6e9]
    flying.run(identifier, [broken(message) for message in kept])
    assert identifier.delay == pytest.approx(0.06, abs=0.015)
    identifier.reset()
    assert (identifier.delay, identifier.delay_confidence) == (0.0, "none")


def test_small_differences_are_left_alone() -> None:
    estimate = delay.judge(curve(0.11), DELAYS)
    near = 2.0 * estimate.sigma
    assert estimate.off(estimate.delay - 0.9 * near) == 0.0
    assert estimate.off(estimate.delay - 1.1 * near) == pytest.approx(1.1 * near)


def test_quiet_flight_is_left_out_unless_something_is_injected() -> None:
    """As if the rates came before the inputs: they are answers."""
    h, cells = 0.01, 6000
    rng = np.random.default_rng(1)
    t = np.arange(cells + 1) * 10_000_000
    x = np.repeat(rng.normal(size=(cells // 20 + 1, 3)), 20, axis=0)[: cells + 1]
    u = np.hstack((x[:-1], np.zeros((cells, 1))))
    force = np.zeros((cells + 1, 3))

    def judged(*, excited: bool, injected: float) -> int:
        bank = delay.DelayBank(0.3)
        for k in range(0, cells, 50):
            own, edges = slice(k, k + 50), slice(k, k + 51)
            block = Block(t[edges], h, x[edges], u[own], force[edges], k == 0)
            block.excitation = np.full((50, 4), injected)
            bank.add(block, 0.0, excited)
        return len(bank._errors)

    assert judged(excited=True, injected=0.0) > delay.FEWEST_BLOCKS
    assert judged(excited=False, injected=0.1) > delay.FEWEST_BLOCKS
    assert judged(excited=False, injected=0.0) == 0


def test_a_vibration_beyond_the_steps_of_the_bank_accuses_no_delay() -> None:
    """At 40 Hz of steps 50 Hz looked like 10 Hz: 'the inputs act 20 ms later' was said."""
    m = flying.light_measured(60.0, rate=1000.0, sensors={"rate": 250.0}, delay=0.02)
    t = (m.imu_t_ns - m.imu_t_ns[0]) * 1e-9
    phases = np.cumsum(np.random.default_rng(5).normal(0.0, 0.1, len(t)))
    shake = np.sin((2.0 * np.pi * 50.5 * t + phases)[:, None] + np.arange(3.0))
    identifier, estimates = flying.identified(replace(m, rates=m.rates + 0.3 * shake))
    estimate = identifier.delays.estimate
    assert estimate.sure and estimate.off(0.02) == 0.0
    assert not any("the inputs act" in e.reason for e in estimates)


def test_the_delay_rests_when_the_excitation_ends() -> None:
    segments = (Segment("multisine", 0.0, 40.0, flying.AMPLITUDES, seed=1),)
    air = ColouredNoise(0.3, 0.3)
    flight = flying.plant_flight(75.0, segments=segments, delay=0.06, gusts=air, autopilot=True)
    m = measure(flight, NOISY)
    identifier = OnlineIdentifier(flying.settings(m, **UNKNOWN))
    start, looks = int(m.imu_t_ns[0]), []
    for after, until in ((0.0, 50.0), (50.0, 75.0)):
        part = [m for m in flying.messages(m) if after <= (m.t_ns - start) * 1e-9 < until]
        flying.run(identifier, part)
        looks.append(identifier.delays.errors)
    np.testing.assert_array_equal(*looks)
    assert identifier.delay == pytest.approx(0.06, abs=0.015)


def curve(
    best: ArrayLike,  # One delay, or one for each lag
    lag_cost: float = 1.0,
    noise: float = 0.01,
    delays: FloatArray = DELAYS,
) -> FloatArray:
    """Errors of blocks, (B, L, J, 3), least at `best`; longer lags predict worse."""
    rng, lags = np.random.default_rng(2), len(delay.LAGS)
    bowl = ((delays - np.reshape(best, (-1, 1))) / 0.1) ** 2 + lag_cost * np.arange(lags)[:, None]
    chance = rng.normal(size=(2 * delay.FEWEST_BLOCKS, lags, len(delays), 3))
    return np.asarray(np.exp(bowl[:, :, None] + noise * chance))


def test_the_minimum_of_the_curve_is_the_delay_unless_it_is_flat_or_at_an_end() -> None:
    estimate = delay.judge(curve(0.11), DELAYS)
    assert estimate.total_sure
    assert estimate.delay == pytest.approx(0.11, abs=2.0 * delay.SYSTEMATIC_ERROR)
    assert estimate.total == pytest.approx(estimate.delay, abs=delay.SYSTEMATIC_ERROR)
    assert delay.judge(curve(0.11), DELAYS, lag=0.05).total == pytest.approx(estimate.total + 0.05)
    assert not delay.judge(curve(0.11, noise=2.0), DELAYS).sure
    for beyond in (-0.1, 0.4):
        assert not delay.judge(curve(beyond), DELAYS).sure


def test_one_block_that_nothing_predicts_outweighs_no_other() -> None:
    blocks = np.concatenate([curve(0.11)] * 4)
    take_off = 1e3 * curve(0.02)[:1]  # larger than all others together, and least elsewhere
    estimate = delay.judge(np.concatenate((take_off, blocks)), DELAYS)
    assert estimate.sure
    assert estimate.delay == pytest.approx(0.11, abs=estimate.sigma)


def test_answers_make_the_delay_as_unsure_as_the_motion_is_unexplained() -> None:
    errors = curve(0.11)
    share = np.sqrt((1.0 / errors.sum(axis=0)[0].max(axis=0)).mean() * errors[:, 0].shape[0])
    plain, answered = (delay.judge(errors, DELAYS, opposed=o).sigma for o in (False, True))
    assert math.sqrt(answered**2 - plain**2) == pytest.approx(ANSWER_TIMES[0] * share, rel=0.1)


@pytest.mark.parametrize(
    ("best", "opposed", "told"), [(-0.03, False, True), (-0.03, True, False), (0.05, True, True)]
)
def test_answers_that_come_after_the_motion_are_no_early_inputs(
    best: float, opposed: bool, told: bool
) -> None:
    early = delay.STEP * np.arange(-6, 13)
    estimate = delay.judge(curve(best, 0.0, delays=early), early, opposed=opposed)
    assert estimate.sure == told
    assert bool(estimate.off(0.2)) == told


@pytest.mark.parametrize(("total", "told"), [(0.015, True), (0.2, False)])
def test_no_lag_is_possible_that_needs_inputs_before_they_are_given(
    total: float, told: bool
) -> None:
    """All lags predict alike, each with the delay that leaves the sum as it is."""
    delays = delay.STEP * np.arange(-8, 13)
    estimate = delay.judge(curve(total - np.array(delay.LAGS), 0.0, delays=delays), delays)
    assert estimate.total == pytest.approx(total, abs=delay.SYSTEMATIC_ERROR)
    assert (estimate.hidden < 0.5 * delay.SURE_SIGMA) == told


def test_lags_that_predict_alike_leave_their_sum_with_the_delay_unknown() -> None:
    given = delay.judge(curve(0.11, lag_cost=0.3 * delay.ALIKE), DELAYS)
    assert given.sure and not given.total_sure
    assert given.total_sigma > 0.04


def test_a_lag_that_costs_two_points_of_the_fit_has_a_third_of_the_odds() -> None:
    """Of a fit of 50 %: the squared error is 8 % larger, and larger again for twice the lag."""
    cost = 2.0 * math.log(0.52 / 0.5)
    odds = np.exp(-np.arange(len(delay.LAGS)))
    hidden = math.sqrt(odds @ np.square(delay.LAGS) / odds.sum())
    assert delay.judge(curve(0.11, cost, noise=0.0), DELAYS).hidden == pytest.approx(
        hidden, rel=0.1
    )


@pytest.mark.parametrize(("rise", "sure"), [(3.0, False), (7.0, True)])
def test_a_wrong_delay_is_one_that_is_off_by_75_milliseconds(rise: float, sure: bool) -> None:
    """That far from the least error it must be clearly larger; a step off it hardly is."""
    delays = 0.025 * np.arange(-4, 17)
    distance = delays - 0.15
    blocks = np.zeros((24, len(delay.LAGS), len(delays), 3))
    chance = np.random.default_rng(1).normal(size=(24, 1, 1, 1))
    chance = (chance - chance.mean()) / chance.std() * math.sqrt(23)  # a mean has a sigma of one
    blocks += (rise + chance) * (distance / 0.075)[:, None] ** 2
    blocks += 30.0 * np.arange(len(delay.LAGS))[:, None, None]
    estimate = delay.judge(np.exp(0.1 * blocks), delays)
    assert estimate.rise == pytest.approx(rise, rel=0.1)
    assert estimate.sure == sure


@pytest.mark.skipif(not REAL_FLIGHT.exists(), reason=f"there is no {REAL_FLIGHT.name}")
def test_the_real_flight_has_80_to_120_milliseconds() -> None:
    with Bag(REAL_FLIGHT) as bag:
        flown = OfflineRun(choose_inputs(bag, {"actuators.estimate_delay": True}))
        flown.run(bag, lambda messages, _: (m for m in messages if m.log_ns < bag.start_ns + 9e10))
    assert 0.08 <= flown.identifier.delay <= 0.12
    assert flown.identifier.delay_confidence == "sure"
