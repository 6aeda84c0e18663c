# SPDX-License-Identifier: Apache-2.0
"""Rates and inputs on one grid: exact pairing, gaps, stale inputs, trim, bounded memory."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from flying import messages, plant_flight, settings

from uav_ident_ros.identification.regression import StateVariableFilter
from uav_ident_ros.identification.sampling import (
    RATE_SAMPLES,
    Block,
    InputMap,
    Sampler,
    ServoLag,
    cell_means,
)
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray
from uav_ident_ros.simulation.inputs import ColouredNoise
from uav_ident_ros.simulation.noise import Measurements, Sensors, measure

MS = 1_000_000
TICK_NS = 50 * MS


def sampler(**values: Any) -> Sampler:
    return Sampler(Settings.from_values({k.replace("__", "."): v for k, v in values.items()}))


def add_rates(target: Sampler, stamps: Any, values: FloatArray | None = None) -> None:
    for k, t in enumerate(stamps):
        x = (0.0, 0.0, 0.0) if values is None else tuple(values[k])
        target.rates.append(int(t), (*x, 0.0, 0.0, 0.0))


def add_inputs(target: Sampler, stamps: Any, value: float = 0.0) -> None:
    for t in stamps:
        target.raw_inputs.append(int(t), (value,) * 4)


def blocks(target: Sampler, until_ns: int, start_ns: int = 0) -> Iterator[Block]:
    """All blocks up to a time, tick by tick."""
    for tick in range(start_ns, until_ns + 1, TICK_NS):
        target.rates.merge(tick)
        target.raw_inputs.merge(tick)
        yield from target.blocks()


def gridded(rates_ms: Any, inputs_ms: Any, until_ms: int, **values: Any) -> list[Block]:
    """All blocks up to a time from constant rates and inputs with these stamps."""
    target = sampler(**values)
    add_rates(target, np.rint(np.array(rates_ms) * MS))
    add_inputs(target, np.array(inputs_ms) * MS)
    return list(blocks(target, until_ms * MS))


def filtered(
    m: Measurements, structure: str, arm: Sequence[float] = (0.0, 0.0, 0.0), **changes: Any
) -> tuple[FloatArray, FloatArray]:
    """Filtered accelerations and regressors of a whole flight."""
    target, svf, out = Sampler(settings(m, **changes)), None, []
    for message in messages(m):
        stream = target.rates if message.stream == "rates" else target.raw_inputs
        stream.append(message.t_ns, message.values)
    for block in blocks(target, int(m.imu_t_ns[-1]) + TICK_NS, int(m.imu_t_ns[0])):
        svf = svf or StateVariableFilter(STRUCTURES[structure], 15.0, block.h, np.array(arm))
        data = svf.apply(block)
        out.append((data.y.copy(), data.f.copy()))
    y, f = (np.concatenate(part) for part in zip(*out, strict=True))
    return y, f


def misfit(m: Measurements, **changes: Any) -> FloatArray:
    """Largest ``|y - A f|`` of the filtered equation, relative to the largest |y|; per row."""
    assert m.flight.coefficients is not None
    y, f = filtered(m, m.flight.structure, **changes)
    return np.abs(y - f @ m.flight.coefficients.T).max(axis=0) / np.abs(y).max(axis=0)


# -- the filtered equation holds ---------------------------------------------------------------


@pytest.mark.parametrize(("rate", "limit"), [(1000.0, 2e-5), (200.0, 5e-4), (50.0, 1e-2)])
def test_the_filtered_equation_holds_without_noise(rate: float, limit: float) -> None:
    """The limit is of second order in the interval: samples are interpolated linearly."""
    flight = plant_flight(6.0, rate=1000.0, max_step=1e-3)
    assert misfit(measure(flight, Sensors(rate=rate))).max() < limit


@pytest.mark.parametrize(("delay", "lag"), [(0.06, 0.0), (0.0, 0.05), (0.04, 0.05)])
def test_the_filtered_equation_holds_with_delay_and_lag(delay: float, lag: float) -> None:
    flight = plant_flight(6.0, delay=delay, time_constant=lag)
    assert misfit(measure(flight)).max() < 1e-3
    wrong = misfit(measure(flight), actuators__delay=0.0, actuators__time_constant=0.0)
    assert wrong.max() > 0.1


def test_the_lever_arm_corrects_an_offset_accelerometer() -> None:
    flight = plant_flight(5.0, rate=1000.0, max_step=1e-3, force=ColouredNoise(0.3, 0.5))
    arms = ((0.0, 0.0, 0.0), (1.0, -0.3, 0.2))
    measured = (measure(flight, Sensors(1000.0, lever_arm=arm)) for arm in arms)
    forces = [
        filtered(m, "augmented", arm)[1][:, 13:] for m, arm in zip(measured, arms, strict=True)
    ]
    uncorrected = flight.force_at(arms[1])[:, 1:] - flight.force_at(arms[0])[:, 1:]
    # The rest is half a cell: held inputs make the accelerations jump between two samples.
    assert np.abs(forces[1] - forces[0]).max() < 0.01 * np.abs(uncorrected).max()


# -- the grid ----------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [20, 50, 200, 333, 1000])
def test_the_grid_has_the_imus_rate_and_contains_every_sample(rate: int) -> None:
    target = sampler()
    stamps = 7 * MS + np.rint(np.arange(int(2 * rate)) * 1e9 / rate).astype(np.int64)
    rates = np.random.default_rng(6).normal(size=(len(stamps), 3))
    add_rates(target, stamps, rates)
    add_inputs(target, range(0, 2000 * MS, 20 * MS))
    got = list(blocks(target, 2000 * MS))
    assert got[0].restarted and not any(block.restarted for block in got[1:])
    assert got[0].h == pytest.approx(1.0 / rate, rel=1e-6)
    assert got[0].t_ns[-1] <= 1100 * MS
    edges = np.concatenate([block.t_ns[:-1] for block in got])
    assert np.all(np.diff(edges) == edges[1] - edges[0])
    assert len(edges) > (len(stamps) - 2 * RATE_SAMPLES if rate < 100 else len(stamps) - 60)
    on_grid = np.concatenate([block.x[:-1] for block in got])[:, 0]
    first = int(np.searchsorted(stamps, edges[0]))
    np.testing.assert_allclose(on_grid, rates[first : first + len(on_grid), 0], atol=1e-4)


@pytest.mark.parametrize(
    ("stamps_ms", "h"),
    [
        ([*range(0, 160, 20), *range(160, 1000, 10)], 0.01),
        (np.arange(0, 2000, 5)[np.random.default_rng(7).random(400) >= 0.2], 0.005),
        (np.arange(0, 1000, 0.5), 0.001),
    ],
    ids=["a link loses every other sample at first", "samples are dropped", "1 kHz at most"],
)
def test_the_grid_has_the_rate_of_the_imu_despite_lost_samples(stamps_ms: Any, h: float) -> None:
    assert gridded(stamps_ms, range(0, 2000, 20), 2000)[0].h == pytest.approx(h)


# -- gaps and stale inputs ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rates_lost", "inputs_lost", "restarts"),
    [(150, 0, 0), (250, 0, 1), (0, 90, 0), (0, 150, 1)],  # ms
)
def test_long_gaps_begin_a_new_stretch(rates_lost: int, inputs_lost: int, restarts: int) -> None:
    """Frequent inputs are held for 0.1 s: five intervals of 10 ms would be less."""
    rates_ms = [*range(0, 1000, 5), *range(1000 + rates_lost, 2500, 5)]
    inputs_ms = [*range(0, 1010, 10), *range(1000 + inputs_lost, 2500, 10)]
    got = gridded(rates_ms, inputs_ms, 2500)
    assert sum(block.restarted for block in got) == 1 + restarts
    if rates_lost:
        covered = sum(int(block.t_ns[-1] - block.t_ns[0]) for block in got)
        assert covered == (2495 - restarts * (rates_lost + 5)) * MS


def test_inputs_at_an_irregular_rate_are_held_until_the_timeout() -> None:
    """Messages are sent on change only."""
    sent = np.cumsum(np.tile([10, 10, 250, 30, 300, 10, 380], 8))
    sent = sent[sent < 4000]
    got = gridded(range(0, 6000, 5), [0, *sent], 6000, actuators__timeout=0.4)
    assert [block.restarted for block in got] == [True] + [False] * (len(got) - 1)
    assert got[-1].t_ns[-1] == (int(sent[-1]) + 400) * MS


@pytest.mark.parametrize("interpolation", ["hold", "linear"])
def test_stale_inputs_pause_and_new_ones_begin_a_new_stretch(interpolation: str) -> None:
    sent_ms = [*range(0, 1000, 20), *range(2500, 4000, 20)]
    got = gridded(range(0, 4000, 5), sent_ms, 4000, actuators__interpolation=interpolation)
    assert [int(b.t_ns[0]) // MS for b in got if b.restarted] == [0, 2500]
    last = 980 + (100 if interpolation == "hold" else 0)  # five intervals of 20 ms
    paused = [b for b in got if b.t_ns[0] < 2500 * MS]
    assert int(paused[-1].t_ns[-1]) == last * MS


def test_linear_interpolation_waits_for_the_next_input_sample() -> None:
    """The ticks between two samples do not change the cells."""
    stamps = np.arange(0, 2000, 70) * MS
    ramp = stamps * 1e-9
    target = sampler(actuators__interpolation="linear")
    add_rates(target, range(0, 2000 * MS, 5 * MS))
    for t, value in zip(stamps, ramp, strict=True):
        target.raw_inputs.append(int(t), (float(value),) * 4)
    for block in blocks(target, 2000 * MS):
        middle = (block.t_ns[:-1] + block.t_ns[1:]) * 0.5e-9
        np.testing.assert_allclose(block.u[:, 0], middle, atol=1e-12)


# -- trim --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("trim_time", "inputs", "missing"), [(0.0, [], "actuators"), (1.0, [0], "trim")]
)
def test_blocks_need_inputs_and_trim(trim_time: float, inputs: list[int], missing: str) -> None:
    target = sampler(actuators__learn_trim_time=trim_time)
    add_rates(target, range(0, 3000 * MS, 5 * MS))
    add_inputs(target, inputs)
    assert list(blocks(target, 3000 * MS)) == []
    assert missing in target.waiting_for


@pytest.mark.parametrize(
    ("turning", "sway", "steady"),
    [(0.08, 0.0, True), (0.0, 0.08, True), (-0.12, 0.0, False), (0.0, 0.12, False)],
)
def test_the_trim_is_learned_in_quiet_flight(turning: float, sway: float, steady: bool) -> None:
    target = sampler(actuators__learn_trim_time=2.0)
    t = np.arange(0, 3000, 5)
    rates = turning + sway * np.sqrt(2.0) * np.sin(2.0 * np.pi * 2e-3 * t)
    add_rates(target, t * MS, rates[:, None] * np.ones(3))
    add_inputs(target, range(0, 3000 * MS, 20 * MS), 0.3)
    assert any(blocks(target, 3000 * MS)) == steady


def test_a_learned_trim_is_an_average_over_time() -> None:
    """A value that lasts most of the window has most of the weight."""
    target = sampler(actuators__learn_trim_time=1.0, actuators__timeout=2.0)
    add_rates(target, range(0, 1100 * MS, 5 * MS))
    add_inputs(target, [0], 1.0)
    add_inputs(target, range(900 * MS, 1000 * MS, 5 * MS), 0.0)
    list(blocks(target, 1000 * MS))
    assert target.input_map.trim[0] == pytest.approx(0.9, abs=0.01)


# -- channels to inputs ------------------------------------------------------------------------


@pytest.mark.parametrize("interpolation", ["hold", "linear"])
def test_cell_means_of_irregular_samples_equal_those_on_a_fine_grid(interpolation: str) -> None:
    rng = np.random.default_rng(1)
    t_ns = np.sort(rng.choice(np.arange(200), 40, replace=False)).astype(np.int64) * MS
    u = rng.normal(size=(40, 4))
    edges = np.arange(t_ns[0], t_ns[-1], 7 * MS)
    fine = edges[:-1, None] + (np.arange(20_000) + 0.5) * 7 * MS / 20_000
    lines = np.stack([np.interp(fine, t_ns, channel) for channel in u.T], axis=2)
    held = u[np.searchsorted(t_ns, fine, side="right") - 1]
    expected = (held if interpolation == "hold" else lines).mean(axis=1)
    np.testing.assert_allclose(cell_means(t_ns, u, edges, interpolation), expected, atol=2e-3)


def test_servo_lag_is_exact_for_inputs_held_over_the_cells() -> None:
    tau, h = 0.08, 0.005
    u = np.repeat(np.random.default_rng(2).normal(size=(12, 4)), 6, axis=0)
    lag = ServoLag(tau, h)
    lag.apply(np.zeros((1, 4)), restarted=True)
    means = np.concatenate([lag.apply(part, restarted=False) for part in (u[:31], u[31:])])
    state = np.zeros(4)
    for k, command in enumerate(u):
        # mean of command + (state - command) exp(-t / tau) over the cell
        share = tau / h * -np.expm1(-h / tau)
        np.testing.assert_allclose(means[k], command + (state - command) * share, atol=1e-13)
        state = command + (state - command) * np.exp(-h / tau)


def test_a_change_of_lag_begins_a_stretch_at_the_current_inputs() -> None:
    """The lagged inputs do not start at zero. The lag may change between blocks."""
    target, found = sampler(), []
    add_rates(target, range(0, 2000 * MS, 10 * MS))
    add_inputs(target, range(0, 2000 * MS, 10 * MS), 0.2)
    for block in blocks(target, 2000 * MS):
        found.append(block)
        if block.t_ns[-1] >= 1000 * MS:
            target.time_constant = 0.1
    assert [block.t_ns[0] >= 1000 * MS for block in found if block.restarted] == [False, True]
    assert all(block.u == pytest.approx(0.2) for block in found)


def test_a_motors_thrust_follows_its_curve() -> None:
    """PX4's model: thrust = f s^2 + (1 - f) s of the scaled command."""
    values = {
        "actuators.scale": [0.001, 1.0, 1.0, 1.0],
        "actuators.trim": [500.0, 0.5, 0.5, 0.5],
        "actuators.thrust_curve": [1.0, 0.3, 0.0, 1.0],
    }
    mapping = InputMap(Settings.from_values(values).actuators)
    u = mapping.apply(np.array([600.0, 0.6, 0.6, 0.5]))
    mixed = 0.3 * (0.36 - 0.25) + 0.7 * 0.1
    np.testing.assert_allclose(u, [0.36 - 0.25, mixed, 0.1, 0.0], atol=1e-12)
    # the mean over a cell is that of the thrust, not of the command
    t = np.arange(4, dtype=np.int64) * 10_000_000
    raw = np.array([[400.0, 0.4, 0.4, 0.4], [600.0, 0.6, 0.6, 0.6]] * 2)
    edges = np.array([0, 40_000_000], dtype=np.int64)
    mean = mapping.mix(cell_means(t, mapping.curved(raw), edges, "hold"))
    np.testing.assert_allclose(mean[0], mapping.apply(raw).mean(axis=0), atol=1e-12)
