# SPDX-License-Identifier: Apache-2.0
"""Injected signals on the grid of the inputs: the same delay, the same lag, exact means."""

import random
from copy import deepcopy

import flying
import numpy as np
import pytest
from light_aircraft import TRUTH
from test_sampling import MS, add_inputs, add_rates, blocks, sampler
from verdict_flights import warm_start

from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.estimators.recursive import RecursiveRegression
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.model import ParallelModel
from uav_ident_ros.identification.prior import start_from
from uav_ident_ros.identification.regression import Regression, RowSamples, layout
from uav_ident_ros.identification.samples import EXCITATION, Drop, SampleBuffer
from uav_ident_ros.identification.sampling import Block, Sampler, join
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import (
    INPUT_COLUMNS,
    INPUTS,
    RATE_COLUMNS,
    STRUCTURES,
    FloatArray,
)
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.noise import fed

RATES_NS = np.arange(0, 4000, 10) * MS
INPUTS_NS = np.arange(0, 4000, 20) * MS
TIMEOUT_NS = 250 * MS  # docs/excitation.md, for controllers


def fill(buffer: SampleBuffer, stamps: FloatArray, values: FloatArray) -> None:
    for t, v in zip(stamps, values, strict=True):
        buffer.append(int(t), tuple(v))


def cells(target: Sampler) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Edges (ns), inputs and excitation of all cells."""
    out = []
    for tick in range(0, 4001, 50):
        target.injected.merge(tick * MS)
        out += list(blocks(target, tick * MS, tick * MS))
    whole = join(out)
    return whole.t_ns, whole.u, whole.excitation


@pytest.mark.parametrize("time_constant", [0.0, 0.06])
def test_excitation_is_delayed_lagged_and_averaged_as_the_inputs(time_constant: float) -> None:
    """Inputs that consist of the injected signals alone equal them, cell by cell."""
    values = np.random.default_rng(0).normal(size=(len(INPUTS_NS), 4))
    target = sampler(actuators__delay=0.043, actuators__time_constant=time_constant)
    add_rates(target, RATES_NS)
    for buffer in (target.raw_inputs, target.injected):
        fill(buffer, INPUTS_NS, values)
    _, u, excitation = cells(target)
    assert excitation is not None and len(u) > 300
    np.testing.assert_allclose(excitation, u, atol=1e-12)


def test_excitation_is_none_before_its_first_message_and_zero_after_timeout() -> None:
    target = sampler()
    add_rates(target, RATES_NS)
    add_inputs(target, INPUTS_NS)
    assert cells(deepcopy(target))[2] is None
    known_ns = np.array([1000, 1050, 2000]) * MS
    fill(target.injected, known_ns, np.full((3, 4), 0.1))
    edges, _, excitation = cells(target)
    assert excitation is not None
    begin = edges[:-1]
    on = ((begin >= known_ns[0]) & (begin < known_ns[1] + TIMEOUT_NS)) | (
        (begin >= known_ns[2]) & (begin < known_ns[2] + TIMEOUT_NS)
    )
    np.testing.assert_allclose(excitation, np.where(on, 0.1, 0.0)[:, None] * np.ones(4))


def identifier_over(stream: list[tuple[str, int, tuple[float, ...]]]) -> OnlineIdentifier:
    identifier = OnlineIdentifier(Settings())
    flying.run(identifier, [flying.SentSample(0, *entry) for entry in stream])
    return identifier


def test_a_message_cancels_values_scheduled_after_it() -> None:
    identifier = OnlineIdentifier(Settings())
    buffer = identifier.sampler.injected
    for k in range(4):
        assert identifier.add_excitation((1000 + 50 * k) * MS, (0.1,) * 4) is None
    assert identifier.add_excitation(1060 * MS, (0.0,) * 4) is None
    buffer.merge(3000 * MS)
    assert buffer.t.tolist() == [1000 * MS, 1050 * MS, 1060 * MS]
    assert not buffer.v[-1].any()


def test_a_late_excitation_message_counts_from_the_next_tick_on() -> None:
    stream = [("rates", int(t), (0.0, 0.0, 0.0)) for t in RATES_NS[:200]]
    stream.insert(100, ("excitation", 500 * MS, (0.1,) * 4))
    identifier = identifier_over(stream)
    assert identifier.intake.drops[EXCITATION][Drop.LATE] == 0
    (stamp,) = identifier.sampler.injected.t.tolist()
    assert 900 * MS < stamp <= 1000 * MS


@pytest.mark.parametrize(
    ("t_ns", "values", "drop"),
    [
        (1000 * MS, (0.1, 0.1, 0.1), Drop.WRONG_LENGTH),
        (1000 * MS, (0.1, float("nan"), 0.1, 0.0), Drop.NOT_FINITE),
        (0, (0.1,) * 4, Drop.ZERO_STAMP),
        (9000 * MS, (0.1,) * 4, Drop.CLOCK_MISMATCH),
    ],
)
def test_invalid_excitation_is_dropped(t_ns: int, values: tuple[float, ...], drop: Drop) -> None:
    identifier = OnlineIdentifier(Settings())
    identifier.add_rates(900 * MS, (0.0, 0.0, 0.0))
    assert identifier.add_excitation(t_ns, values) is drop
    assert identifier.intake.drops[EXCITATION] == {drop: 1}


def test_zero_excitation_does_not_change_the_coefficients() -> None:
    rng = random.Random(0)
    plain = [("rates", int(t), (rng.gauss(0, 0.1), 0.0, 0.0)) for t in RATES_NS]
    plain += [("actuators", int(t), (0.0, 0.0, rng.gauss(0, 0.1), 0.0)) for t in INPUTS_NS]
    plain.sort(key=lambda entry: entry[1])
    silent = [*plain]
    silent.insert(50, ("excitation", silent[50][1], (0.0,) * 4))
    first, second = identifier_over(plain), identifier_over(silent)
    np.testing.assert_array_equal(first.coefficient_set().values, second.coefficient_set().values)


def test_a_second_of_a_poor_model_does_not_outweigh_a_minute() -> None:
    """In a gust the instruments are thirty times the aircraft's response to the injection."""
    rng = np.random.default_rng(1)
    estimator = RecursiveRegression(start_from(Settings()), Settings(), instrumental=True)
    structure, dt = STRUCTURES["flight_dynamics"], 0.05
    problem, da = layout(structure), INPUT_COLUMNS.start + INPUTS.index("da")

    def fly(seconds: float, response: float, gust: float) -> None:
        for _ in range(round(seconds / (4 * dt))):
            f, y = np.zeros((4, problem.size)), 0.02 * rng.normal(size=(4, problem.rows))
            f[:, RATE_COLUMNS], f[:, da] = 0.1 * rng.normal(size=(4, 3)), 0.05 * rng.normal(size=4)
            y[:, 0] += -5.0 * f[:, RATE_COLUMNS.start] + 40.0 * f[:, da] + gust
            z = f.copy()
            z[:, RATE_COLUMNS] *= response
            samples = Regression.of(y, f, z, dt, injected=True)
            residual = samples.residual(estimator.linear)
            rows = RowSamples.of(samples, residual, problem)
            estimator.update(samples, rows, rows, np.ones(3))

    fly(12.0, 1.0, 0.0)
    fly(1.0, 30.0, 2.0)
    fly(60.0, 1.0, 0.0)
    assert estimator.coefficients[structure.index("pdot/p")] == pytest.approx(-5.0, rel=0.05)


def test_the_response_to_injected_signals_lasts_two_seconds() -> None:
    """After a few periods of the short modes the instruments follow all inputs again."""
    structure = STRUCTURES["augmented"]
    model, still = ParallelModel(structure, np.zeros(3)), np.zeros((11, 3))
    injected_only = []
    for k in range(100):
        excitation = np.full((10, 4), 0.1 if k < 20 else 0.0)
        t_ns = (10 * k + np.arange(11)) * 5 * MS
        block = Block(t_ns, 0.005, still, excitation, still, k == 0, excitation)
        model.follow(block, np.zeros(structure.mask.shape), 0.0)
        injected_only.append(block.injected)
    assert injected_only[:20] == [True] * 20
    assert sum(injected_only[20:]) * 0.05 == pytest.approx(2.0, abs=0.06)


def excited(gust: float, seed: int, seconds: float, start: float = 10.0) -> list[Estimate]:
    """Estimates of the light aircraft on its autopilot, excited from `start`, s.

    The injected signals are published from the tenth second on.
    """
    peaks = {"de": 0.08, "dr": 0.08, "da": 0.08}
    segment = Segment("multisine", start, 17.0, peaks, 10.0, (0.2, 2.0), seed=seed)
    flight = {"segments": (segment,), "bank": 20.0, "gust": gust, "delay": 0.02, "seed": seed}
    m = flying.light_measured(seconds, noise_seed=seed, **flight)
    stream = flying.with_injected(m, after=10.0)
    return flying.identified(m, stream=stream, update_rate=20.0)[1]


def test_an_excitation_corrects_estimates_from_feedback_within_five_seconds() -> None:
    """Feedback biases the roll damping to zero; instruments of that model leave 40 % after 5 s."""
    place = STRUCTURES["flight_dynamics"].index("pdot/da")
    found = np.array([excited(0.8, seed, 15.0)[-1].coefficients[place] for seed in range(1, 5)])
    assert np.sqrt(np.mean((found / TRUTH["pdot/da"] - 1.0) ** 2)) < 0.25


def test_known_coefficients_stay_when_the_excitation_is_published_late() -> None:
    """Excited from 2 s on: no row begins anew at 10 s."""
    place = STRUCTURES["flight_dynamics"].index("qdot/de")
    estimates = excited(0.3, 1, 12.0, start=2.0)
    before = flying.since(estimates, 9.5, 12.0)[0].sigma[place]
    after = max(e.sigma[place] for e in flying.since(estimates, 10.2, 11.0))
    assert before < 0.3 * abs(TRUTH["qdot/de"])
    assert after < 1.5 * before


def test_injected_signals_show_a_wrong_delay_after_answers_to_gusts() -> None:
    """After a warm start such answers would look late. The injected signals contain none."""
    segment = Segment("multisine", 20.0, 25.0, flying.PEAKS, seed=1)
    m = flying.light_measured(55.0, segments=(segment,), bank=20.0, gust=0.8, delay=0.02)
    known = warm_start(STRUCTURES["flight_dynamics"], TRUTH)
    identifier = OnlineIdentifier(flying.settings(m, actuators__delay=0.08), known)
    answered, reasons = {}, {}
    for estimate in fed(identifier, flying.with_injected(m)):
        second = round((estimate.t_ns - int(m.imu_t_ns[0])) * 1e-9)
        answered[second] = identifier.estimator.answers.any()
        reasons[second] = estimate.reason
    assert answered[19] and not answered[40] and answered[54]
    for second in (44, 54):
        assert "set 'actuators.delay' to 0.02" in reasons[second]


def rolled(seed: int, injected: float, after: float = 0.0) -> tuple[FloatArray, FloatArray, float]:
    """Published and plain estimate of p and da after a flight in gusts, and the injected share.

    The first seconds have injected signals as instruments, those after them the inputs themselves.
    """
    rng = np.random.default_rng(seed)
    estimator = RecursiveRegression(start_from(Settings()), Settings(), instrumental=True)
    structure, dt, gust, p = STRUCTURES["flight_dynamics"], 0.05, 0.0, 0.0
    problem, da = layout(structure), INPUT_COLUMNS.start + INPUTS.index("da")
    for k in range(round((injected + after) / (4 * dt))):
        f, y = np.zeros((4, problem.size)), 0.02 * rng.normal(size=(4, problem.rows))
        f[:, da] = 0.05 * rng.normal(size=4)
        for i in range(4):
            gust = 0.95 * gust + 0.5 * rng.normal()
            f[i, RATE_COLUMNS.start], y[i, 0] = p, -5.0 * p + 40.0 * f[i, da] + gust
            p = 0.8 * p + 0.05 * rng.normal()
        told = k * 4 * dt < injected
        samples = Regression.of(y, f, f, dt, injected=told)
        estimator.update(samples, *estimator.conditioned(samples), np.ones(3))
    plain = estimator.information.solve(estimator.coefficients).values[0]
    places = tuple(zip(*map(structure.index, ("pdot/p", "pdot/da")), strict=True))
    information = estimator.information
    share = float(information.injected_share(information.sums_of())[0])
    return estimator.coefficients[places], plain[places], share


def test_gusts_spoil_an_injected_excitation_less_than_the_plain_estimate() -> None:
    """Of a slow gust of 1.6 rad/s^2 whitening leaves 0.5 rad/s^2."""
    true = np.array([-5.0, 40.0])
    found = [rolled(seed, 30.0) for seed in range(8)]
    published, plain = (
        np.sqrt(np.mean([(one[k] - true) ** 2 for one in found], axis=0)) for k in (0, 1)
    )
    assert (published < 0.6 * plain).all()


def test_the_share_of_the_whitened_estimate_is_that_of_the_injected_information() -> None:
    """Without injected signals, the residual of a real flight is the model's own error as well."""
    published, plain, share = rolled(0, 0.0, after=20.0)
    np.testing.assert_array_equal(published, plain)
    assert share == 0.0
    assert rolled(0, 20.0, after=60.0)[2] == pytest.approx(0.25, rel=0.15)


def test_an_autopilots_answers_do_not_hide_that_an_aileron_saturates() -> None:
    """It was usable with a third of its effect: the injected signal alone sees a straight line."""
    commanded = {name: 2.5 * peak for name, peak in flying.PEAKS.items()}
    m = flying.light_measured(60.0, commanded, bank=20.0, gust=0.5, travel=0.04)
    _, (*_, last) = flying.identified(m, stream=flying.with_injected(m))
    assert not last.usable_rows[0]
    assert "pdot follows da badly" in last.reason
