# SPDX-License-Identifier: Apache-2.0
"""Transport delay and servo lag: estimated in excited flight, and unknown otherwise."""

import math
from dataclasses import replace
from typing import Any

import flying
import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.signal import lfilter

from uav_ident_ros.identification import delay
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.residuals import ANSWER_TIMES
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray
from uav_ident_ros.simulation.flight import Flight
from uav_ident_ros.simulation.inputs import ColouredNoise, Segment
from uav_ident_ros.simulation.noise import Sensors, measure
from uav_ident_ros.simulation.quadrotor_flight import AMPLITUDES, QuadrotorFlight

NOISY = Sensors(gyro_noise=0.02, accelerometer_noise=0.1)
UNKNOWN = {"actuators__delay": 0.0, "actuators__estimate_delay": True}
DELAYS = delay.STEP * np.arange(-2, 13)


def found(flight: Flight, sensors: Sensors = NOISY, **changes: Any) -> OnlineIdentifier:
    m = measure(flight, sensors)
    return flying.identified(m, estimator="least_squares", **{**UNKNOWN, **changes})[0]


@pytest.mark.parametrize(("delay", "lag"), [(0.15, 0.0), (0.02, 0.12)])
def test_in_calm_air_the_delay_and_its_sum_with_the_lag_are_sure(delay: float, lag: float) -> None:
    """The delay is that for the lag in use."""
    estimate = found(flying.plant_flight(32.0, delay=delay, time_constant=lag)).delays.estimate
    assert estimate.sure and estimate.delay == pytest.approx(delay, abs=0.015)
    assert estimate.total_sure and estimate.total == pytest.approx(delay + lag, abs=0.015)


@pytest.mark.parametrize(
    ("sensors", "flown", "first"),
    [
        (Sensors(rate=20.0, gyro_noise=0.01), {}, 0.0),
        (Sensors(rate=1000.0, gyro_noise=0.01), {"rate": 1000.0}, 0.0),
        (NOISY, {"gusts": ColouredNoise(0.3, 0.3), "autopilot": True}, 0.2),
    ],
    ids=["slow Imu", "fast Imu", "wrong at first, in gusts under an autopilot"],
)
def test_delays_are_found_to_15_ms(sensors: Sensors, flown: dict[str, Any], first: float) -> None:
    flight = flying.plant_flight(30.0, delay=0.06, **flown)
    assert found(flight, sensors, actuators__delay=first).delay == pytest.approx(0.06, abs=0.015)


@pytest.mark.parametrize("gusts", [0.3, 1.0])
def test_without_excitation_the_initial_delay_stays(gusts: float) -> None:
    """Feedback of the autopilot to gusts contains no information on the delay."""
    air = ColouredNoise(gusts, 0.3)
    flight = flying.plant_flight(30.0, segments=(), delay=0.06, gusts=air, autopilot=True)
    identifier = found(flight, actuators__delay=0.04)
    assert identifier.delay == 0.04
    assert identifier.delay_estimate.confidence != "sure"


def test_the_delay_of_a_hovering_quadrotor_in_gusts_stays_unsure() -> None:
    """Feedback biases it by 30 ms."""
    segments = (Segment("multisine", 2.0, amplitudes=AMPLITUDES, band=(0.2, 4.0)),)
    noise = ColouredNoise(0.5, 0.3)
    flight = QuadrotorFlight(segments, 30.0, 500.0, delay=0.012, gusts=noise).fly()
    sensors = Sensors(rate=100.0, gyro_noise=0.01)
    estimate = found(flight, sensors).delays.estimate
    assert abs(estimate.delay - 0.012) < 1.5 * estimate.sigma
    assert not estimate.sure


def flown_with(
    delay: float, setting: float, lag_setting: float = 0.0, lag: float = 0.0, seconds: float = 34.0,
    **changes: Any,
) -> tuple[OnlineIdentifier, Estimate]:  # fmt: skip
    """Return an identifier with a configured delay and lag, after a flight with the true ones."""
    m = flying.light_measured(seconds, delay=delay, time_constant=lag)
    values = {"actuators__delay": setting, "actuators__time_constant": lag_setting, **changes}
    identifier, (*_, last) = flying.identified(m, **values)
    return identifier, last


def sigma_of(estimate: Estimate, name: str) -> float:
    return float(estimate.sigma[STRUCTURES["flight_dynamics"].index(name)])


def test_a_small_delay_error_increases_sigma() -> None:
    """The increase is the damping times the error: 7 1/s times 30 ms in pdot."""
    setting, off = (flown_with(0.05, setting) for setting in (0.05, 0.02))
    assert setting[1].usable
    assert off[0].delay == 0.02
    assert off[0].delay_estimate.confidence == "none"
    for name in ("pdot/da", "qdot/de"):
        assert sigma_of(off[1], name) > 2.0 * sigma_of(setting[1], name)
    assert (flying.light_errors(off[1], "pdot/da", "qdot/de")[1] < 2.0).all()


@pytest.mark.parametrize(
    ("delay", "setting", "lag", "expected"),
    [
        (0.14, 0.02, 0.0, "later than 'actuators.delay'"),
        (0.02, 0.08, 0.0, "earlier than 'actuators.delay'"),
        (0.02, 0.02, 0.1, "lower 'actuators.time_constant'"),
    ],
)
def test_rows_with_a_bias_of_a_quarter_by_delay_or_lag_are_not_usable(
    delay: float, setting: float, lag: float, expected: str
) -> None:
    identifier, last = flown_with(delay, setting, lag)
    assert identifier.delay == setting
    assert not any(last.usable_rows[:2])
    assert expected in last.reason


def test_infrequent_inputs_are_named_and_linear_interpolation_corrects_them() -> None:
    """The stamps of commands at 10 Hz are right: they are not the reported cause."""
    m = flying.light_measured(36.0, delay=0.02)
    names = ("actuators", "actuator_t_ns", "actuator_log_ns")
    m = replace(m, **{name: getattr(m, name)[::5] for name in names})
    _, (*_, held) = flying.identified(m)
    assert "they come every 100 ms and are held until then: publish" in held.reason
    _, (*_, joined) = flying.identified(m, actuators__interpolation="linear")
    assert "the inputs act" not in joined.reason
    assert (flying.light_errors(joined, "pdot/da", "qdot/de")[0] < 0.15).all()


def test_data_with_another_delay_count_for_a_second() -> None:
    """The value stays until there are new data."""
    m = measure(flying.plant_flight(25.0, delay=0.06), NOISY)
    flown = OnlineIdentifier(
        flying.settings(m, estimator="least_squares", structure="throttle_coupled", **UNKNOWN)
    )
    information, entry = flown.estimator.information, (0, 0, 0, 0)
    kept, stream = 0.0, iter(flying.messages(m))
    while not flown.delay:
        kept = float(information.sums.zz[entry])
        before = [*flying.run(flown, [next(stream)]), flown.coefficient_set().values][-1]
    learned = float(information.time[0])
    assert information.sums.zz[entry] == pytest.approx(kept / learned, rel=0.05)
    damping = flown.structure.index("pdot/p")
    assert flown.coefficient_set().values[damping] == pytest.approx(before[damping], rel=0.02)


def test_the_model_error_by_a_wrong_delay_is_cleared() -> None:
    """A rudder with a delay error of 0.12 s is known within 20 s."""
    identifier, last = flown_with(0.14, 0.02, seconds=52.0, actuators__estimate_delay=True)
    assert identifier.delay == pytest.approx(0.14, abs=0.015)
    assert sigma_of(last, "rdot/dr") < 0.15 * 9.0
    assert flying.light_errors(last, "rdot/dr")[1] < 2.0


def test_a_lag_not_separated_from_the_delay_increases_sigma() -> None:
    """It reduces the aileron's effect more than a delay does; the predictions are alike."""
    (hidden, unsure), (_, last) = (
        flown_with(0.02, 0.02, setting, 0.12, 45.0, actuators__estimate_delay=True)
        for setting in (0.0, 0.12)
    )
    assert hidden.delay_estimate.confidence == "sure"
    share, sigmas = flying.light_errors(unsure, "pdot/da")
    assert share > 0.2 and sigmas < 3.0
    assert "servo lag are not separated" in unsure.reason
    assert "'actuators.time_constant'" in unsure.reason
    assert flying.light_errors(last, "pdot/da")[1] < 2.0
    assert sigma_of(last, "pdot/da") < 0.1 * 45.0
    assert "a servo lag of" not in last.reason


def test_the_delay_survives_a_gap_and_a_new_time_base_but_not_a_reset() -> None:
    m = measure(flying.plant_flight(36.0, delay=0.06), NOISY)
    start = int(m.imu_t_ns[0])
    identifier = OnlineIdentifier(flying.settings(m, **UNKNOWN))
    hour = 3600 * 10**9
    broken = [
        message._replace(t_ns=message.t_ns + hour * (message.t_ns - start > 32e9))
        for message in flying.messages(m)
        if not 19e9 < message.t_ns - start < 19.6e9
    ]
    flying.run(identifier, broken)
    assert identifier.delay == pytest.approx(0.06, abs=0.015)
    identifier.reset()
    unknown = identifier.delay_estimate
    assert (identifier.delay, unknown.confidence, unknown.sigma) == (0.0, "none", math.inf)


def test_quiet_flight_is_left_out_unless_signals_are_injected() -> None:
    """The inputs follow the rates, as feedback does."""
    x = np.repeat(np.random.default_rng(1).normal(size=(301, 3)), 20, axis=0)[:6001]
    u = np.hstack((x[:-1], np.zeros((6000, 1))))

    def blocks_scored(*, excited: bool, injected: float) -> int:
        bank = delay.DelayBank(0.3)
        for block in flying.blocks(x, u, 0.01, cells=50):
            block.excitation = np.full((50, 4), injected)
            bank.add(block, 0.0, excited)
        return len(bank._errors)

    assert blocks_scored(excited=True, injected=0.0) > delay.FEWEST_BLOCKS
    assert blocks_scored(excited=False, injected=0.1) > delay.FEWEST_BLOCKS
    assert blocks_scored(excited=False, injected=0.0) == 0


def test_a_bank_that_begins_anew_keeps_injected_estimates_alone() -> None:
    """The bank's own estimate does not say what of it may be lag: that was infinite."""
    before = delay.DelayBank(0.3)
    before.estimate = delay.DelayEstimate(0.05, 0.01, 0.05, 0.01, rise=5.0)
    assert delay.DelayBank(0.3, 0.0, before).estimate == delay.NO_ESTIMATE
    injected = replace(before.estimate, lag=0.02, lag_sigma=0.01)
    before._injected = injected
    anew = delay.DelayBank(0.3, 0.02, before).estimate
    assert (anew.delay, anew.total, anew.hidden) == pytest.approx((0.03, 0.05, 0.01))


def test_a_vibration_does_not_alias_to_a_delay() -> None:
    """In steps at 40 Hz, 50 Hz would alias to 10 Hz and bias the delay by 20 ms."""
    m = flying.light_measured(36.0, sensors={"rate": 250.0}, delay=0.02)
    t = (m.imu_t_ns - m.imu_t_ns[0]) * 1e-9
    phases = np.cumsum(np.random.default_rng(5).normal(0.0, 0.1, len(t)))
    shake = np.sin((2.0 * np.pi * 50.5 * t + phases)[:, None] + np.arange(3.0))
    identifier, estimates = flying.identified(replace(m, rates=m.rates + 0.3 * shake))
    estimate = identifier.delays.estimate
    assert estimate.sure and estimate.off(0.02) == 0.0
    assert not any("the inputs act" in e.reason for e in estimates)


def test_the_delay_estimate_stays_when_the_excitation_ends() -> None:
    segments = (Segment("multisine", 0.0, 30.0, flying.AMPLITUDES, seed=1),)
    air = ColouredNoise(0.3, 0.3)
    flight = flying.plant_flight(55.0, segments=segments, delay=0.06, gusts=air, autopilot=True)
    m = measure(flight, NOISY)
    identifier = OnlineIdentifier(flying.settings(m, **UNKNOWN))
    start, costs = int(m.imu_t_ns[0]), []
    for after, until in ((0.0, 40.0), (40.0, 55.0)):
        part = [m for m in flying.messages(m) if after <= (m.t_ns - start) * 1e-9 < until]
        flying.run(identifier, part)
        costs.append(identifier.delays.errors)
    np.testing.assert_array_equal(*costs)
    assert identifier.delay == pytest.approx(0.06, abs=0.015)


def curve(
    best: ArrayLike,  # One delay, or one for each lag
    lag_cost: float = 1.0,
    noise: float = 0.01,
    delays: FloatArray = DELAYS,
) -> FloatArray:
    """Squared errors of blocks, (B, L, J, 3), least at `best`; longer lags predict worse."""
    rng, lags = np.random.default_rng(2), len(delay.LAGS)
    bowl = ((delays - np.reshape(best, (-1, 1))) / 0.1) ** 2 + lag_cost * np.arange(lags)[:, None]
    chance = rng.normal(size=(2 * delay.FEWEST_BLOCKS, lags, len(delays), 3))
    return np.asarray(np.exp(bowl[:, :, None] + noise * chance))


def test_the_delay_is_the_minimum_and_unsure_if_flat_or_at_an_end() -> None:
    estimate = delay.judge(curve(0.11), DELAYS)
    assert estimate.total_sure
    assert estimate.delay == pytest.approx(0.11, abs=2.0 * delay.SYSTEMATIC_ERROR)
    assert estimate.total == pytest.approx(estimate.delay, abs=delay.SYSTEMATIC_ERROR)
    near = 2.0 * estimate.sigma  # errors within it count as zero
    assert estimate.off(estimate.delay - 0.9 * near) == 0.0
    assert estimate.off(estimate.delay - 1.1 * near) == pytest.approx(1.1 * near)
    assert delay.judge(curve(0.11), DELAYS, lag=0.05).total == pytest.approx(estimate.total + 0.05)
    assert not delay.judge(curve(0.11, noise=2.0), DELAYS).sure
    for beyond in (-0.1, 0.4):
        assert not delay.judge(curve(beyond), DELAYS).sure


def test_no_delay_is_known_better_than_a_third_of_a_step() -> None:
    """Errors without any scatter; noise in the regressors and held inputs bias them all alike."""
    assert delay.judge(curve(0.11, noise=1e-6), DELAYS).sigma == pytest.approx(0.0075, rel=0.01)
    sigmas = (0.014, 0.016)  # two of these errors lower the fit
    assert [delay.DelayEstimate(sigma=s, rise=10.0).sure for s in sigmas] == [True, False]


def test_a_block_with_huge_errors_counts_as_one_block() -> None:
    blocks = np.concatenate([curve(0.11)] * 4)
    take_off = 1e3 * curve(0.02)[:1]  # larger than all others together, with another minimum
    estimate = delay.judge(np.concatenate((take_off, blocks)), DELAYS)
    assert estimate.sure
    assert estimate.delay == pytest.approx(0.11, abs=estimate.sigma)


def test_rates_that_disagree_on_the_delay_increase_its_sigma() -> None:
    """Bowls are alike: roll and yaw hold 0.1 s, pitch 0.06 s, and sigma is a third of that."""
    pitch = [1]
    errors, other = (curve(best, noise=1e-6) for best in (0.1, 0.06))
    errors[..., pitch] = other[..., pitch]
    estimate = delay.judge(errors, DELAYS)
    assert estimate.delay == pytest.approx(0.1 - 0.04 / 3.0, abs=0.002)
    spread = math.sqrt(estimate.sigma**2 - delay.SYSTEMATIC_ERROR**2)
    assert spread == pytest.approx(0.04 / 3.0, rel=0.15)


def test_feedback_increases_the_delays_sigma_by_the_unexplained_share() -> None:
    errors = curve(0.11)
    share = np.sqrt((1.0 / errors.sum(axis=0)[0].max(axis=0)).mean() * errors[:, 0].shape[0])
    plain, with_feedback = (delay.judge(errors, DELAYS, opposed=o).sigma for o in (False, True))
    assert math.sqrt(with_feedback**2 - plain**2) == pytest.approx(ANSWER_TIMES[0] * share, rel=0.1)


@pytest.mark.parametrize(
    ("best", "opposed", "known"), [(-0.03, False, True), (-0.03, True, False), (0.05, True, True)]
)
def test_a_negative_delay_with_feedback_is_unsure(best: float, opposed: bool, known: bool) -> None:
    early = delay.STEP * np.arange(-6, 13)
    estimate = delay.judge(curve(best, 0.0, delays=early), early, opposed=opposed)
    assert estimate.sure == known
    assert bool(estimate.off(0.2)) == known


@pytest.mark.parametrize(("total", "known"), [(0.015, True), (0.2, False)])
def test_lags_that_need_a_negative_delay_are_excluded(total: float, known: bool) -> None:
    """All lags predict alike, each with the delay for the same sum."""
    delays = delay.STEP * np.arange(-8, 13)
    estimate = delay.judge(curve(total - np.array(delay.LAGS), 0.0, delays=delays), delays)
    assert estimate.total == pytest.approx(total, abs=delay.SYSTEMATIC_ERROR)
    assert (estimate.hidden < 0.5 * delay.SURE_SIGMA) == known


def test_lags_that_predict_alike_leave_the_sum_of_lag_and_delay_unsure() -> None:
    given = delay.judge(curve(0.11, lag_cost=0.3 * delay.ALIKE), DELAYS)
    assert given.sure and not given.total_sure
    assert given.total_sigma > 0.04


def test_a_lag_that_costs_two_points_of_the_fit_has_odds_of_1_to_e() -> None:
    """At a fit of 50 % the squared error is 8 % larger; twice the lag costs as much again."""
    cost = 2.0 * math.log(0.52 / 0.5)
    odds = np.exp(-np.arange(len(delay.LAGS)))
    hidden = math.sqrt(odds @ np.square(delay.LAGS) / odds.sum())
    assert delay.judge(curve(0.11, cost, noise=0.0), DELAYS).hidden == pytest.approx(
        hidden, rel=0.1
    )


@pytest.mark.parametrize(("rise", "sure"), [(3.0, False), (7.0, True)])
def test_the_errors_must_rise_clearly_within_75_ms_of_the_minimum(rise: float, sure: bool) -> None:
    """A single step of the grid changes the errors too little."""
    delays = 0.025 * np.arange(-4, 17)
    distance = delays - 0.15
    blocks = np.zeros((24, len(delay.LAGS), len(delays), 3))
    chance = np.random.default_rng(1).normal(size=(24, 1, 1, 1))
    chance = (chance - chance.mean()) / chance.std() * math.sqrt(23)  # sigma of the mean: 1
    blocks += (rise + chance) * (distance / 0.075)[:, None] ** 2
    blocks += 30.0 * np.arange(len(delay.LAGS))[:, None, None]
    estimate = delay.judge(np.exp(0.1 * blocks), delays)
    assert estimate.rise == pytest.approx(rise, rel=0.1)
    assert estimate.sure == sure


@pytest.mark.parametrize(("flat", "known"), [(0.05, True), (0.1, False)])
def test_the_errors_count_where_they_differ_by_75_ms(flat: float, known: bool) -> None:
    """They rise beyond `flat`, s; up to there by two of their standard deviations."""
    delays = 0.025 * np.arange(-4, 17)
    steps = np.abs(delays - 0.15) / 0.025
    rise = 0.02 * np.minimum(steps, 1.0) ** 2 + np.clip(steps - flat / 0.025, 0.0, 1.0)
    chance = np.random.default_rng(1).normal(size=(24, len(delay.LAGS), len(delays), 3))
    longer = 3.0 * np.arange(len(delay.LAGS))[:, None, None]  # lags predict much worse
    estimate = delay.judge(np.exp(rise[:, None] + 0.06 * chance + longer), delays)
    assert estimate.delay == pytest.approx(0.15, abs=0.01)
    assert bool(estimate.off(0.0)) == known


@pytest.mark.parametrize("lag", [0.0, 0.06, 0.12])
def test_the_bank_has_the_lags_of_servos(lag: float) -> None:
    """A lag that is not in use: the sum with the delay is right, and all of it may be hidden."""
    step, t, rng = 0.01, 0.01 * np.arange(3000), np.random.default_rng(1)
    waves = 2.0 * np.pi * rng.uniform(0.2, 3.0, (3, 12, 1)) * t
    commands = 0.03 * np.sin(waves + rng.uniform(0.0, 2.0 * np.pi, (3, 12, 1))).sum(axis=1).T
    moved = np.vstack((np.zeros((3, 3)), commands[:-3]))  # 30 ms late

    def followed(signal: FloatArray, time: float) -> FloatArray:
        decay = math.exp(-step / time) if time else 0.0
        return np.asarray(lfilter([1.0 - decay], [1.0, -decay], signal, axis=0))

    effect = np.array([[0.0, -5.0, 0.0], [0.0, 0.0, -1.0], [4.0, 0.0, 0.0]])  # de dr da to p q r
    rates = followed(followed(moved, lag), 0.2) @ effect
    x = np.vstack((np.zeros(3), rates)) + 0.01 * rng.normal(size=(3001, 3))
    bank = delay.DelayBank(0.3)
    for block in flying.blocks(x, np.hstack((commands, np.zeros((3000, 1)))), step, cells=50):
        bank.add(block, 0.0)
    assert bank.estimate.total == pytest.approx(0.03 + lag, abs=0.015)
    assert bank.estimate.total_sigma < 0.02
    assert bank.estimate.hidden == pytest.approx(lag, abs=0.01)


def test_the_delay_of_the_recorded_flight_is_80_to_120_ms() -> None:
    identifier, _ = flying.begun(
        "thor75_auto", 60.0, actuators__estimate_delay=True, update_rate=10.0
    )
    assert 0.08 <= identifier.delay <= 0.12
    assert identifier.delay_estimate.confidence == "sure"
