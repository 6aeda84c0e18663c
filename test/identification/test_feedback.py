# SPDX-License-Identifier: Apache-2.0
"""Feedback: answers to disturbances are detected, and their information is discounted."""

from dataclasses import replace

import numpy as np
import pytest
from flying import identified, light_errors, light_measured, since, stiff_autopilot
from scipy.signal import lfilter

from uav_ident_ros.identification.estimators.information import Information
from uav_ident_ros.identification.prior import Start, start_from
from uav_ident_ros.identification.regression import Regression, RowSamples, layout
from uav_ident_ros.identification.residuals import Feedback
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import INPUT_COLUMNS, STRUCTURES

STRUCTURE = STRUCTURES["flight_dynamics"]
LAYOUT = layout(STRUCTURE)
DT, TRUE, GUST_TIME = 0.05, 40.0, 1.0
P, AILERON = 5, 10
PDOT_DA = STRUCTURE.index("pdot/da")


def fly(
    gain: float, excitation: float, seconds: float = 120.0, seed: int = 1
) -> tuple[Regression, np.ndarray]:
    """Return samples of a roll in gusts that the aileron answers a tick later, and the gusts."""
    rng = np.random.default_rng(seed)
    n = round(seconds / DT)
    f, gusts = np.zeros((n, LAYOUT.size)), np.zeros((n, LAYOUT.rows))
    keep, chance = np.exp(-DT / GUST_TIME), rng.normal(size=(n, 2))
    gusts[:, 0] = lfilter([np.sqrt(1 - keep**2)], [1.0, -keep], chance[:, 0])
    f[:, P] = 0.1 * chance[:, 1]
    waves = np.sin(0.3 * DT * np.outer(np.arange(n), np.arange(1, 9))).sum(axis=1)
    f[:, AILERON] = excitation * waves - gain * np.append(0.0, gusts[:-1, 0])
    y = np.zeros((n, LAYOUT.rows))
    y[:, 0] = -5.0 * f[:, P] + TRUE * f[:, AILERON] + gusts[:, 0]
    return Regression.of(y, f, f, DT), gusts


def detect_feedback(samples: Regression, residual: np.ndarray, effect: float = 0.0) -> Feedback:
    """Return the feedback detected in the samples, for an aileron of known `effect`."""
    detected, known = Feedback(LAYOUT), np.array([effect, 0.0, 0.0])
    for k in range(len(samples.y)):
        part = slice(k, k + 1)
        one = replace(samples, signals=samples.signals[part])
        detected.add(one, residual[part, :3], np.ones(3), known)
    return detected


EXCITED = 0.01**2 * 8 / 2
"""Variance of an excitation of amplitude 0.01."""


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(
    ("gain", "excitation", "share", "tolerance"),
    [
        (0.02, 0.0, 1.0, 0.2),
        (0.0, 0.01, 0.0, 0.0),
        (0.02, 0.01, 0.02**2 / (0.02**2 + EXCITED), 0.15),
    ],
    ids=["answers gusts", "is excited", "both"],
)
def test_the_share_is_that_of_the_answers_in_the_ailerons_variance(
    gain: float, excitation: float, share: float, tolerance: float, seed: int
) -> None:
    """It is zero for inputs that do not move."""
    found = detect_feedback(*fly(gain, excitation, seed=seed)).share
    assert found[2] == pytest.approx(share, abs=tolerance)
    assert found[[0, 1, 3]].tolist() == [0.0, 0.0, 0.0]


def test_a_correlation_by_chance_is_a_possible_answer_without_a_share() -> None:
    """In half a minute the gusts correlate with the excitation."""
    detected = detect_feedback(*fly(0.0, 0.01, seconds=30.0))
    assert detected.answering is not None
    assert detected.answering.max() > 0.01
    assert detected.ratio.max() > 0.01
    assert not detected.share.any()
    assert not detected.answering[:, 2].any()


@pytest.mark.parametrize(
    ("column", "effect", "may_answer"),
    [(AILERON, 10.0, True), (AILERON, 40.0, False), (INPUT_COLUMNS.stop - 1, 0.0, False)],
    ids=["a weak aileron", "an effective one", "the throttle"],
)
def test_steps_of_an_effective_input_or_the_throttle_in_slow_gusts_are_no_answers(
    column: int, effect: float, may_answer: bool
) -> None:
    """Past residuals explain much of a few steps by chance; a weak input may be an answer.

    No rate loop moves the throttle, and no row gives its effect.
    """
    n, keep, found = round(20.0 / DT), np.exp(-DT / 1.5), []
    for seed in range(1, 9):
        rng = np.random.default_rng(seed)
        f, gusts = np.zeros((n, LAYOUT.size)), np.zeros((n, LAYOUT.rows))
        f[:, column] = 0.1 * np.resize(np.repeat([1.0, -1.0, 1.0, -1.0], [60, 40, 20, 20]), n)
        f[140:200, column] = f[350:, column] = 0.0
        chance = rng.normal(size=(n - 1, 3))
        gusts[1:, :3] = lfilter([np.sqrt(1 - keep**2)], [1.0, -keep], chance, axis=0)
        samples = Regression.of(np.zeros((n, LAYOUT.rows)), f, f, DT)
        found.append(detect_feedback(samples, gusts, effect).share[column - INPUT_COLUMNS.start])
    assert any(found) == may_answer


@pytest.mark.parametrize("seed", [1, 2])
def test_an_effective_input_with_excitation_and_answers_has_a_share(seed: int) -> None:
    samples, gusts = fly(0.02, 0.01, seed=seed)
    strong, weak = (detect_feedback(samples, gusts, effect).share[2] for effect in (200.0, 0.0))
    assert strong == weak > 0.2


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_effect_that_the_structure_does_not_have_is_no_answer(seed: int) -> None:
    """With an Imu turned in yaw the aileron pitches: the residual repeats its past."""
    samples, gusts = fly(0.0, 0.01, seed=seed)
    residual, keep, aileron = 0.1 * gusts, np.exp(-DT / 0.3), samples.f[:, AILERON]
    response = lfilter([1.0 - keep], [1.0, -keep], aileron)
    chance = np.random.default_rng(seed).normal(size=len(gusts))
    residual[:, 1] = 0.1 * chance + 10.0 * (aileron - response)
    assert not detect_feedback(samples, residual, effect=TRUE).share.any()


def answers(*by: float) -> np.ndarray:
    """Return the weights of the instruments by `Sums.answers`, where the aileron answers."""
    follows = LAYOUT.index == AILERON
    pairs = follows[:, :, None] * follows[:, None]
    return pairs[:, None] * np.array(by)[:, None, None]


def start_with(**initial: float) -> Start:
    """Return a start with these coefficients, as ``pdot_da``, known within a fifth."""
    start = start_from(Settings())
    values, sigma = start.values.copy(), start.sigma.copy()
    for name, value in initial.items():
        place = STRUCTURE.index(name.replace("_", "/"))
        values[place], sigma[place] = value, 0.2 * abs(value)
    return replace(start, values=values, sigma=sigma)


def learned(
    samples: Regression,
    residual: np.ndarray,
    share: float,
    start: Start | None = None,
    *,
    sure: bool = True,
    instruments: tuple[bool, ...] = (False,),
) -> list[float]:
    """Return pdot/da and its sigma by each set of samples, for a share of the aileron."""
    start = start or start_with()
    information = Information(STRUCTURE, start, 0.1, 0.0, instruments)
    rows, ratio = RowSamples.of(samples, residual, LAYOUT), share / (1.0 - share)
    answering = answers(ratio * sure, share, share * sure) if share else None
    for k in range(0, rows.count, 20):
        block = RowSamples(rows.signals[:, k : k + 20], DT)
        information.add([block] * len(instruments), np.ones(LAYOUT.rows), answering)
    solution = information.solve(start.values)
    _, found = information.spread(solution)
    return [float(a[PDOT_DA]) for a in (solution.values[0], *found)]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("excitation", [0.01, 0.006])
def test_sigma_with_the_share_covers_the_bias_by_feedback(excitation: float, seed: int) -> None:
    """Without the share, sigma is less than a fourth of the error.

    With less excitation most of the gusts is in the estimate, not in the residual.
    """
    samples, gusts = fly(0.02, excitation, seed=seed)
    share = detect_feedback(samples, gusts).share[2]
    error, residual = learned(samples, gusts, 0.0)[0] - TRUE, gusts.copy()
    residual[:, 0] -= error * samples.f[:, AILERON]
    _, without_share = learned(samples, residual, 0.0)
    _, sigma = learned(samples, residual, share)
    assert abs(error) > 4.0 * without_share
    assert abs(error) < 2.0 * sigma


def weak(samples: Regression, noise: float) -> Regression:
    """The samples with noise of `noise`, rad rms, in the aileron's instrument."""
    z = samples.z.copy()
    z[:, AILERON] += noise * np.random.default_rng(9).normal(size=len(z))
    return Regression.of(samples.y, samples.f, z, DT)


@pytest.mark.parametrize("initial", [0.0, 20.0])
def test_with_poor_instruments_of_answers_sigma_is_the_priors_and_the_shift(initial: float) -> None:
    """The estimate may then contain all of the gusts."""
    samples, gusts = fly(0.02, 0.0)
    start = start_with(pdot_da=initial) if initial else start_with()
    poor, sure = weak(samples, 0.02), not initial
    value, sigma = learned(poor, gusts, 0.9, start, sure=sure, instruments=(True,))
    assert sigma == pytest.approx(np.hypot(start.sigma[PDOT_DA], value - initial), rel=0.05)


@pytest.mark.parametrize(("noise", "increases"), [(0.0, False), (0.1, True)])
def test_possible_answers_count_only_with_a_poor_instrument(noise: float, increases: bool) -> None:
    """The poor instrument contains a hundredth of the aileron's power; the share is 10 %."""
    samples, gusts = fly(0.0, 0.005)
    poor, by = weak(samples, noise), (True,)
    _, without_share = learned(poor, gusts, 0.0, instruments=by)
    _, with_possible_share = learned(poor, gusts, 0.1, sure=False, instruments=by)
    assert (with_possible_share > 1.5 * without_share) == increases


def test_under_a_high_gain_autopilot_in_gusts_most_errors_are_within_two_sigma() -> None:
    """Feedback biases pdot/da by half; the errors are within two sigma most of the time."""
    within = []
    for seed in (1, 2):
        _, estimates = identified(stiff_autopilot(45.0, seed))
        within += [light_errors(e, "pdot/da")[1] < 2.0 for e in since(estimates, 20.0, 45.0)]
    assert np.mean(within) > 0.6


def test_the_elevator_is_learned_from_an_excitation_after_feedback() -> None:
    """Feedback in other derivatives does not increase the elevator's sigma."""
    peaks = {"de": 0.06, "da": 0.06, "dr": 0.06}
    imu = {"gyro_noise": 0.02, "accelerometer_noise": 0.1}
    m = light_measured(45.0, peaks, start=20.0, sensors=imu, noise_seed=1, bank=20.0)
    _, (*_, last) = identified(m)
    assert light_errors(last, "qdot/de")[0] < 0.1
    assert last.sigma[STRUCTURE.index("qdot/de")] < 0.25 * 30.0


def test_feedback_does_not_increase_the_whitened_estimates_sigma() -> None:
    """The innovation of a gust precedes its answer, so that the whitened part is unbiased."""
    _, plain, white = learned(*fly(0.02, 0.01), 0.5, instruments=(False, False))
    assert plain > 5.0 * white


def test_the_side_force_does_not_increase_a_priors_sigma() -> None:
    """Before the first samples sigma is that of the prior."""
    start = start_with(rdot_dr=-4.0, rdot_beta=8.0)
    information = Information(STRUCTURE, start, 0.1)
    _, found = information.spread(information.solve(start.values))
    assert found[0][STRUCTURE.index("rdot/dr")] == pytest.approx(0.8)
