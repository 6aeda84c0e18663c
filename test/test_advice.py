# SPDX-License-Identifier: Apache-2.0
"""Advice: each piece appears if and only if its threshold is passed."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from estimates import estimate_of
from excerpts import ACTUATORS, SECOND_NS, START_NS, Entry, excerpt, parameters

from uav_ident_ros.files.meanings import AXIS_WORDS, INPUT_WORDS, MEANINGS
from uav_ident_ros.identification.delay import NO_ESTIMATE, DelayEstimate
from uav_ident_ros.identification.prediction import HORIZONS, PredictionFit
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import INPUTS, STRUCTURES
from uav_ident_ros.offline import advice as limits
from uav_ident_ros.offline.advice import ADVICE, advise
from uav_ident_ros.offline.evidence import Evidence, gather, gyro_noise, lost_to
from uav_ident_ros.offline.run import Refusals, run_over

AUGMENTED = STRUCTURES["augmented"]
JUST_ABOVE, JUST_BELOW = 1.01, 0.99


def fit(model: Any = 80.0, hold: Any = -20.0, measured_force: Any = 85.0) -> PredictionFit:
    def axes(value: Any) -> Any:
        return np.broadcast_to(np.asarray(value, dtype=float), 3)

    free, free_hold = (np.tile(axes(value), (len(HORIZONS), 1)) for value in (model, hold))
    return PredictionFit(free, free_hold, axes(measured_force), 100, 20_000)


def good() -> Evidence:
    """Return the evidence of a good flight."""
    values = np.where(AUGMENTED.mask, 5.0, 0.0)
    for name in ("pdot/p", "qdot/q", "rdot/r"):
        values[AUGMENTED.index(name)] = -5.0
    return Evidence(
        settings=Settings.from_values({"structure": "augmented"}),
        structure=AUGMENTED,
        values=values,
        sigma=np.where(AUGMENTED.mask, 0.1, 0.0),
        fit=fit(),
        duration=120.0,
        rate_spread=np.full(3, 0.5),
        gyro_noise=np.full(3, 0.01),
        input_spread=np.full(4, 0.1),
        imu_rate=200.0,
        actuator_rate=50.0,
        delay=DelayEstimate(0.03, 0.003, 0.03, 0.003, 10.0),
        delay_in_use=0.03,
        streams={"rates": Refusals(10_000, {})},
    )


def with_entry(array: Any, name: str, value: float) -> Any:
    changed = array.copy()
    changed[AUGMENTED.index(name)] = value
    return changed


def one_of_three(value: float, otherwise: float) -> Any:
    return np.array([otherwise, value, otherwise])


E = good()
SURE = E.delay
FINDING = Settings.from_values({"structure": "augmented", "actuators.estimate_delay": True})
"""Settings with estimation of the delay, as for an imported log."""
QUAD = Settings.from_values(
    {
        "structure": "augmented",
        "actuators.mixing.de": (0.25, 0.25, -0.25, -0.25),
        "actuators.mixing.dth": (0.25,) * 4,
    }
)
LINEAR = Settings.from_values({"structure": "augmented", "actuators.interpolation": "linear"})
MIN_T_RATIO = E.settings.supervision.min_t_ratio
AT_REST, AT_LIMIT = "at rest: no rate has moved by … rad/s", "channel … is at its limit"
STILL_RUDDER = {"sigma": with_entry(E.sigma, "rdot/dr", 5.0 / (MIN_T_RATIO * JUST_ABOVE))}
WEAK_RUDDER = {"sigma": with_entry(E.sigma, "rdot/dr", 5.0 / (MIN_T_RATIO * JUST_BELOW))}
UNSURE = replace(SURE, rise=1.0)
EARLY = replace(SURE, delay=-0.015, sigma=0.009)
SPLIT = replace(SURE, total=0.062, lag=0.05, lag_sigma=0.009)
OPEN = replace(SURE, total=0.03, lag=0.04, lag_sigma=0.025)

WING = Settings.from_values({"structure": "augmented", "actuators.mixing.dr": [0.0] * 4})


def yaw(damping: float) -> dict[str, Any]:
    return {"values": with_entry(E.values, "rdot/r", damping)}


def off_trim(ratio: float, structure: str = "throttle_coupled") -> dict[str, Any]:
    """Return a median of dr, in standard deviations."""
    median = E.input_spread * [0.0, ratio, 0.0, 0.0]
    return {"input_median": median, "structure": STRUCTURES[structure]}


def moves(*spread: float) -> dict[str, Any]:
    return {"input_spread": np.array(spread)}


CASES: list[tuple[str, dict[str, Any], dict[str, Any], str]] = [
    # advice, evidence just below its threshold, evidence just above, its text
    ("never_flew", {"lost": {AT_REST: limits.GROUNDED_SHARE * JUST_BELOW}},
     {"lost": {AT_REST: 0.5, "not armed": 0.45}},
     "the aircraft hardly flew: 95 % of the time at rest: no rate .*, not armed; take a flight"),
    ("contradiction", {}, {"contradiction": "the gyro looks like deg/s: convert it"}, "deg/s"),
    ("no_excitation", moves(0.0, 0.0, 0.1, 0.1), moves(0.0, 0.0, 0.0, 0.1),
     "no surface moved: .* 'actuators.channels'"),
    ("no_excitation", moves(0.0, 0.0, 0.1, 0.1), moves(0.0, 0.0, 0.0, 0.1) | {"settings": QUAD},
     "no roll, pitch or yaw input moved: "),
    ("no_excitation", {"streams": {"actuators": Refusals(300, {"late": 299})}},
     {"streams": {"actuators": Refusals(300, {"late": 300})}} | moves(0.0, 0.0, 0.0, 0.0),
     "no message of the actuators could be used: .*; look at 'actuators.type'"),
    ("weak_excitation", STILL_RUDDER, WEAK_RUDDER | {"settings": QUAD},
     "not enough yaw input excitation: .*; move the yaw input more"),
    ("gated", {"lost": {AT_LIMIT: limits.LOST_SHARE * JUST_BELOW, "not armed": 0.5}},
     {"lost": {AT_LIMIT: limits.LOST_SHARE * 1.1}, "gate_settings": {AT_LIMIT: "actuators.upper"}},
     r"nothing was learned in 33 % of the flight: channel … is at its limit \(see 'actuators.up"),
    ("weak_excitation", STILL_RUDDER, WEAK_RUDDER,
     r"not enough rudder excitation: rdot/dr is known to 4\.0 sigma only \(4 needed\)"),
    ("weak_excitation", STILL_RUDDER | {"answers": np.full(4, 0.3)},  # still known
     WEAK_RUDDER | {"answers": np.array([0.0, 0.3, 0.0, 0.0])},
     r"\(4 needed\), since 30 % of its motion answers disturbances; move the rudder by itself, .*"
     r": doublets by hand .* not ArduPlane's$"),
    ("weak_excitation", STILL_RUDDER | {"answers": np.full(4, 0.3)},
     WEAK_RUDDER | {"answers": np.full(4, 0.3), "settings": QUAD},
     r"move the yaw input by itself, .* SystemID mode"),
    ("weak_excitation", STILL_RUDDER, WEAK_RUDDER | {"answers": np.array([0.3, 0.0, 0.3, 0.3])},
     r"\(4 needed\); move the rudder more, and by itself$"),
    # sufficient excitation: a setting widens sigma
    ("weak_excitation", WEAK_RUDDER | {"scatter": STILL_RUDDER["sigma"]},
     WEAK_RUDDER | {"scatter": WEAK_RUDDER["sigma"]}, "not enough rudder excitation"),
    ("wrong_setup", {"setup": ("", "", "")}, {"setup": ("", "the position of the Imu", "")},
     "^the position of the Imu$"),
    ("wrong_setup", {"setup": (SURE.contradiction(0.2),) * 3, "delay": SURE, "delay_in_use": 0.2},
     {"setup": (SURE.contradiction(0.2), "28 ms may be lag", "28 ms may be lag"),
      "delay": SURE, "delay_in_use": 0.2}, "^28 ms may be lag$"),
    # below zero by less than two sigma: evidence against the lag in use, and no other advice
    ("wrong_setup", {"setup": ("", "", ""), "delay": EARLY, "delay_in_use": 0.0},
     {"setup": (EARLY.contradiction(0.0),) * 3, "delay": EARLY, "delay_in_use": 0.0},
     "^the inputs act 15 ms earlier than .*, or lower 'actuators.time_constant'$"),
    ("weak_excitation", moves(0.1, 1e-6, 0.1, 0.1), moves(0.1, 0.0, 0.1, 0.1),
     "the rudder never moved"),
    # a flying wing without a rudder
    ("weak_excitation", moves(0.1, 0.0, 0.1, 0.1) | {"settings": WING}, moves(0.1, 0.0, 0.1, 0.1),
     "the rudder never moved"),
    ("wrong_delay", {"delay": SURE, "delay_in_use": SURE.delay - limits.DELAY_OFF * JUST_BELOW},
     {"delay": replace(SURE, delay=0.08), "delay_in_use": 0.0},
     r"act 80 ms later .*: set 'actuators\.delay' to 0\.080, or 'actuators\.estimate_delay' to"),
    ("wrong_delay", {"delay_in_use": SURE.delay + limits.DELAY_OFF * JUST_BELOW},
     {"delay_in_use": SURE.delay + limits.DELAY_OFF * JUST_ABOVE}, "act 20 ms earlier than"),
    ("wrong_delay", {"delay": UNSURE, "delay_in_use": 0.2}, {"delay": SURE, "delay_in_use": 0.2},
     "170 ms earlier"),
    ("wrong_delay",  # delays are not negative
     {"delay": replace(SURE, delay=-limits.DELAY_OFF * JUST_BELOW), "delay_in_use": 0.0},
     {"delay": replace(SURE, delay=-0.042), "delay_in_use": 0.0},
     r"42 ms earlier .* say: correct their stamps, or lower 'actuators\.time_constant'$"),
    ("wrong_delay", {"delay": UNSURE, "actuator_rate": 10.0},
     {"delay": replace(SURE, delay=-0.042), "delay_in_use": 0.0, "actuator_rate": 10.0},
     "they come every 100 ms and are held until then: publish them more often, or .* 'linear'$"),
    ("wrong_delay", {"delay": UNSURE, "settings": LINEAR, "actuator_rate": 10.0},  # not held
     {"delay": replace(SURE, delay=-0.042), "delay_in_use": 0.0, "settings": LINEAR,
      "actuator_rate": 10.0}, "say: correct their stamps"),
    ("unknown_delay", {"settings": FINDING, "delay": SURE}, {"settings": FINDING, "delay": UNSURE},
     r"does not show the delay of the inputs \(30 ms, sigma 3 ms; 30 ms in use\).* 3-2-1-1"),
    ("unknown_delay", {"delay": NO_ESTIMATE},  # configured
     {"settings": FINDING, "delay": NO_ESTIMATE}, r"\(no estimate; 30 ms in use\)"),
    ("unknown_delay", {"settings": FINDING, "delay": SURE},
     {"settings": FINDING, "delay": replace(UNSURE, delay=0.219, sigma=0.019), "delay_in_use": 0.0},
     r"seem to act 219 ms \(sigma 19 ms\) after their stamps, 0 ms are in use: .* 0\.219"),
    ("unknown_delay", {"settings": FINDING, "delay": SURE},
     {"settings": FINDING, "delay": replace(UNSURE, delay=-0.125, sigma=0.008)},
     r"\(-125 ms, sigma 8 ms: they seem to follow the motion, as an autopilot's answers do, or"),
    ("wrong_lag", {"delay": replace(SPLIT, lag=2.0 * JUST_BELOW * SPLIT.lag_sigma)},
     {"delay": replace(SPLIT, lag=2.0 * JUST_ABOVE * SPLIT.lag_sigma)},
     r"a servo lag of 18 ms \(sigma 9 ms\), 0 ms are in use: set 'actuators.time_constant'"),
    # a lag in use beyond the sum, whose split is not known: at most the sum, as it is adopted
    ("wrong_lag", {"delay": OPEN, "lag_in_use": OPEN.total + 2.0 * JUST_BELOW * OPEN.total_sigma},
     {"delay": OPEN, "lag_in_use": OPEN.total + 2.0 * JUST_ABOVE * OPEN.total_sigma},
     r"a servo lag of 30 ms .* 'actuators.time_constant' to 0.030 and 'actuators.delay' to 0.000"),
    ("wrong_lag", {"delay": replace(SPLIT, lag_sigma=0.015)}, {"delay": SPLIT},
     "'actuators.time_constant' to 0.050 and 'actuators.delay' to 0.012"),
    ("wrong_delay", {"delay": replace(SPLIT, delay=0.06)},
     {"delay": replace(SPLIT, delay=0.06, lag=0.0)}, "30 ms later"),
    ("assumed_airspeed", {"settings": Settings.from_values({"airspeed.reference": 20.1})},
     {"settings": Settings()},
     "no airspeed is measured, and 'airspeed.reference' is the default, 20 m/s: set it to"),
    ("row_needs_force", {"force_share": {"pdot": 0.0, "rdot": limits.FORCE_SHARE * JUST_BELOW}},
     {"force_share": {"pdot": 0.0, "rdot": limits.FORCE_SHARE * JUST_ABOVE}},
     "the yaw row needs ay: it explains 15 %"),
    ("leans_on_force", {"fit": fit(measured_force=80.0 + limits.FEW_POINTS * JUST_BELOW)},
     {"fit": fit(measured_force=[80.0, 80.0, 80.0 + limits.FEW_POINTS * JUST_ABOVE])},
     r"lean on specific forces, .*: with the measured ones the fit is higher, .* r: 20 \(ay\)"),
    # a structure without forces
    ("leans_on_force", {"fit": fit(model=0.0, measured_force=np.nan)},
     {"fit": fit(model=0.0, measured_force=80.0)}, r"p: 80 \(ay\), q: 80 \(az\), r: 80 \(ay\)"),
    ("noisy_gyro", {"gyro_noise": one_of_three(limits.LARGEST_NOISE * JUST_BELOW, 0.01)},
     {"gyro_noise": one_of_three(limits.LARGEST_NOISE * JUST_ABOVE, 0.01)},
     r"gyro noise high: 0\.1 rad/s on q"),
    ("noisy_gyro", {"rate_spread": one_of_three(0.01 / limits.NOISE_SHARE * JUST_ABOVE, 0.5)},
     {"rate_spread": one_of_three(0.01 / limits.NOISE_SHARE * JUST_BELOW, 0.5)},
     r"gyro noise high for so gentle a flight: 0\.01 rad/s on q, which moved by 0\.033 rad/s"),
    ("noisy_gyro",  # possibly motion
     {"gyro_noise": one_of_three(0.2, 0.01), "imu_rate": limits.SLOW_IMU * JUST_BELOW},
     {"gyro_noise": one_of_three(0.2, 0.01), "imu_rate": limits.SLOW_IMU * JUST_ABOVE},
     "gyro noise high: 0.2 rad/s on q"),
    ("slow_streams", {"imu_rate": limits.SLOW_IMU * JUST_ABOVE},
     {"imu_rate": limits.SLOW_IMU * JUST_BELOW},
     r"of the Imu come at 49 Hz: 50 Hz are needed \(PX4: SDLOG_PROFILE bit 4, .*; A"),
    ("slow_streams", {"actuator_rate": limits.SLOW_ACTUATORS * JUST_ABOVE},
     {"actuator_rate": limits.SLOW_ACTUATORS * JUST_BELOW},
     "the messages of the actuators come at 24 Hz: 25 Hz"),
    ("slow_streams", {"actuator_rate": 0.0}, {"actuator_rate": 1.0}, "at 1 Hz"),  # 0: no rate
    ("slow_streams", {}, {"imu_rate": 25.0, "actuator_rate": 10.0},  # a single cure for both
     r"of the Imu come at 25 Hz: 50 Hz are needed, those of the actuators come at 10 Hz: 25 Hz"),
    ("many_drops",
     {"streams": {"rates": Refusals(10_000, {"late": round(10_000 * limits.DROPPED_SHARE)})}},
     {"streams": {"rates": Refusals(10_000, {"late": 90, "not finite": 11})}},
     "101 of 10000 messages of the rates were dropped: 90 late, 11 not finite"),
    ("wrong_sign", yaw(0.1 * limits.SIGN_SIGMAS * JUST_BELOW),
     yaw(0.1 * limits.SIGN_SIGMAS * JUST_ABOVE),
     r"yaw damping \(rdot/r\) is positive"),
    ("off_trim", off_trim(limits.OFF_TRIM * JUST_BELOW), off_trim(-limits.OFF_TRIM * JUST_ABOVE),
     r"off their trim \(dr by -0.3 standard deviations\), and throttle_coupled has no constant"),
    ("off_trim", off_trim(2.0, "augmented"), off_trim(2.0), r"\(dr by \+2.0 standard"),
    ("short_flight", {"duration": limits.SHORT_FLIGHT * JUST_ABOVE},
     {"duration": limits.SHORT_FLIGHT * JUST_BELOW}, "the flight is short, 59 s: excite it"),
    ("no_better_than_holding", {"fit": fit(model=[80.0, 20.1, 80.0], hold=20.0)},
     {"fit": fit(model=[80.0, 20.0, 80.0], hold=20.0)},
     r"q is predicted no better \(20 %\) than by holding it \(20 %\): look at the delay"),
    ("no_better_than_holding", {},  # the reason has its own advice
     {"fit": fit(model=[80.0, 20.0, 80.0], hold=20.0), "imu_rate": limits.SLOW_IMU - 1.0},
     r"q is predicted no better \(20 %\) than by holding it \(20 %\)$"),
    ("collinear_groups", {"collinear": (("qdot/1", "qdot/az"),)},
     {"collinear": (("qdot/1", "qdot/az"), ("pdot/p", "pdot/da"))},
     "only a combination is known of pdot/p and pdot/da: move"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "missing", "giving", "words"), CASES)
def test_advice_appears_above_its_threshold_alone(
    name: str, missing: dict[str, Any], giving: dict[str, Any], words: str
) -> None:
    assert name not in {advice.name for advice in advise(replace(E, **missing))}
    texts = [advice.text for advice in advise(replace(E, **giving)) if advice.name == name]
    assert len(texts) == 1
    assert re.search(words, texts[0]), texts[0]


def test_a_cause_suppresses_the_advice_on_its_consequences() -> None:
    bad = replace(
        E,
        lost={"not armed": 1.0},
        fit=fit(model=-900.0),
        delay_in_use=0.2,
        values=-E.values,
        imu_rate=20.0,
    )
    assert [advice.name for advice in advise(bad)] == ["never_flew", "slow_streams"]
    swapped = replace(bad, lost={}, contradiction="elevator and rudder are swapped: exchange them")
    assert [advice.name for advice in advise(swapped)] == ["contradiction", "slow_streams"]
    assert advise(swapped)[0].text == swapped.contradiction
    flying = [advice.name for advice in advise(replace(bad, lost={"too little excitation": 0.9}))]
    assert flying[:4] == ["slow_streams", "gated", "wrong_delay", "wrong_sign"]
    assert "no_better_than_holding" in flying


def test_slow_messages_come_last_if_the_fit_of_the_best_axis_is_good() -> None:
    weak = replace(E, imu_rate=20.0, **WEAK_RUDDER)
    for missing, order in (
        (JUST_BELOW, ["weak_excitation", "slow_streams"]),
        (JUST_ABOVE, ["slow_streams", "weak_excitation"]),
    ):
        model = np.array([100.0 - missing * limits.FEW_POINTS, 10.0, np.nan])
        found = advise(replace(weak, fit=fit(model=model, measured_force=model)))
        assert [advice.name for advice in found] == order


def test_reasons_that_differ_in_measured_numbers_alone_are_merged() -> None:
    def lost(*reasons: str, learned: int = 0) -> dict[str, float]:
        paused = [estimate_of(np.zeros(3), adapting=False, reason=reason) for reason in reasons]
        return lost_to([*paused, *[estimate_of(np.zeros(3), reason="why 1")] * learned])

    reasons = ("p reaches 34.9 rad/s", "p reaches -3e-1 rad/s", "not armed")
    assert lost(*reasons, learned=1) == {"p reaches … rad/s": 0.5, "not armed": 0.25}
    for reason, shown in (
        ("the 1-second fit of p is -58.1 %", "the 1-second fit of p is … %"),
        ("2.9 rad/s: convert to rad/s (REP-103)", "… rad/s: convert to rad/s (REP-103)"),
        ("learned from 16 s, needed are 30.", "learned from … s, needed are …."),
    ):
        assert lost(reason) == {shown: 1.0}


def test_every_piece_of_advice_has_a_case() -> None:
    assert {case[0] for case in CASES} == {find.__name__ for find in ADVICE}


def test_a_good_flight_has_no_advice_with_and_without_fixed_coefficients() -> None:
    assert advise(E) == ()
    fixed = with_entry(with_entry(E.sigma, "rdot/dr", 0.0), "pdot/p", 0.0)
    assert advise(replace(E, sigma=fixed)) == ()
    assert replace(E, sigma=fixed).t_ratio("rdot/dr") is None
    assert E.t_ratio("rdot/xx") is None


def test_every_coefficient_has_a_meaning() -> None:
    assert set(MEANINGS) == {name for s in STRUCTURES.values() for name in s.names}
    assert len(set(MEANINGS.values())) == len(MEANINGS)
    assert set(INPUT_WORDS) == set(INPUTS)
    for name, words in MEANINGS.items():
        row, regressor = name.split("/")
        angles = ("ay", "az", "beta", "alpha")
        if row in AXIS_WORDS and "power" not in words and regressor not in angles:
            assert AXIS_WORDS[row] in words


# --- evidence ----------------------------------------------------------------------------------


def test_gyro_noise_is_separated_from_motion() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 60.0, 1.0 / 200.0)
    motion = 0.8 * np.sin(2.0 * np.pi * 2.0 * t)  # highest frequency of the excitation
    noise = np.array([0.0, 0.005, 0.1])
    rates = motion[:, None] + noise * rng.standard_normal((len(t), 3))
    rates[1000] += 5.0  # one outlier must not count as noise
    found = gyro_noise(rates)
    assert found[0] < 1e-3
    np.testing.assert_allclose(found[1:], noise[1:], rtol=0.05)
    assert not gyro_noise(rates[:3]).any()


def evidence_of(bag: Path, name: str, changes: dict[str, Any], seconds: float) -> Evidence:
    """Return the evidence of the start of an example bag with changed parameters."""
    values = parameters(name, update_rate=10.0) | changes
    run = run_over(excerpt(bag, seconds, name), values)
    return gather(run, run.score())


def test_evidence_of_a_simulated_flight_has_its_true_rates_noise_and_delay(tmp_path: Path) -> None:
    e = evidence_of(tmp_path / "bag", "multisine", {}, seconds=62.0)
    assert e.duration == pytest.approx(62.0, abs=0.1)
    assert e.imu_rate == pytest.approx(200.0)
    assert e.actuator_rate == pytest.approx(50.0)
    np.testing.assert_allclose(e.gyro_noise, 0.02, rtol=0.1)
    assert e.delay.confidence == "sure"
    assert e.delay.delay == pytest.approx(0.0, abs=0.01)
    assert e.force_share == {}
    assert [advice.name for advice in advise(e)] == []


def test_evidence_covers_both_parts_of_a_flight_with_a_gap(tmp_path: Path) -> None:
    """The rudder moves only in the shorter part."""
    gap_ns = START_NS + 6 * SECOND_NS

    def later(topic: str, log_ns: int, message: Any) -> list[Entry]:
        if log_ns > gap_ns:
            message.header.stamp.sec += 30
            log_ns += 30 * SECOND_NS
            if topic == ACTUATORS:
                still = np.array([name != "rudder" for name in message.name])
                message.position = message.position * still
        return [(topic, log_ns, message)]

    run = run_over(excerpt(tmp_path / "bag", 16.0, "multisine", later), parameters())
    e = gather(run, run.score())
    assert e.duration == pytest.approx(16.0, abs=0.1)
    assert e.input_spread[INPUTS.index("dr")] > 0.02
    np.testing.assert_allclose(e.gyro_noise, 0.02, rtol=0.1)
    assert e.imu_rate == pytest.approx(200.0)


def test_an_excessive_delay_and_missing_regressors_are_detected(tmp_path: Path) -> None:
    e = evidence_of(tmp_path / "late", "multisine", {"actuators.delay": 0.08}, seconds=30.0)
    assert e.delay_in_use - e.delay.delay == pytest.approx(0.08, abs=0.01)
    assert "wrong_delay" in {advice.name for advice in advise(e)}

    e = evidence_of(tmp_path / "c172p", "c172p", {"structure": "baseline"}, seconds=8.0)
    assert set(e.force_share) == {"pdot", "qdot", "rdot"}
    assert min(e.force_share.values()) > 0.5
    plant = evidence_of(tmp_path / "plant", "multisine", {"structure": "baseline"}, seconds=8.0)
    assert max(plant.force_share.values()) < 0.05
