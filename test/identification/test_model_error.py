# SPDX-License-Identifier: Apache-2.0
"""A surface that is late, or does less the more is asked of it, told from one that is not."""

import numpy as np
import pytest

from uav_ident_ros.identification.estimators.model_error import ModelError
from uav_ident_ros.identification.regression import Regression, RowSamples, layout
from uav_ident_ros.identification.structure import STRUCTURES

STRUCTURE = STRUCTURES["augmented"]
LAYOUT = layout(STRUCTURE)
DT, EVERYWHERE, OPEN_LOOP = 0.05, np.ones(3), np.zeros(3)
ROLL_RATE, AILERON = 5, 10
DAMPING, EFFECT = -6.0, 40.0
KNOWN = np.array([EFFECT, -30.0, -9.0])
KNOWN_ROWS = np.ones(3, dtype=bool)


def by_aileron(
    u: np.ndarray,
    pdot: np.ndarray,
    p: np.ndarray | float = 0.0,
    residual: np.ndarray | None = None,  # If not all of it is left
) -> RowSamples:
    """Samples of a roll in which the aileron is asked for u."""
    y, f = np.zeros((len(u), 3)), np.zeros((len(u), STRUCTURE.size))
    y[:, 0], f[:, ROLL_RATE], f[:, AILERON] = pdot, p, u
    left = y if residual is None else np.outer(residual, [1.0, 0.0, 0.0])
    return RowSamples.of(Regression.of(y, f, f, DT), left, LAYOUT)


def rolled(
    travel: float = 1.0, noise: float = 0.3, lag: float = 0.0, seconds: float = 60.0, seed: int = 1
) -> RowSamples:
    """Samples of a roll by an aileron that travels so far, rad, of the 0.1 asked for, and lags."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(round(seconds / DT))
    u = 0.05 * (np.sin(1.3 * t) + np.sin(3.1 * t + 1.0))
    p, pdot = np.zeros(len(t) + 1), np.zeros(len(t))
    gusts, reached = noise * rng.normal(size=len(t)), 0.0
    for k, command in enumerate(u):
        keep = np.exp(-DT / lag) if lag else 0.0
        reached = keep * reached + (1.0 - keep) * np.clip(command, -travel, travel)
        pdot[k] = DAMPING * p[k] + EFFECT * reached + gusts[k]
        p[k + 1] = p[k] + DT * pdot[k]
    return by_aileron(u, pdot, p[:-1])


def shares(
    samples: RowSamples,
    looked: ModelError,
    ratio: np.ndarray = OPEN_LOOP,
    settled: bool = True,
    effect: np.ndarray = KNOWN,
) -> np.ndarray:
    """What is found after each two samples, (m / 2, 3)."""
    found = []
    for k in range(0, samples.count, 2):
        part = RowSamples(samples.signals[:, k : k + 2], samples.dt)
        looked.add(part, EVERYWHERE, ratio, 0.0, effect, restarted=k == 0, settled=settled)
        found.append(looked.share)
    return np.array(found)


def share(samples: RowSamples, ratio: np.ndarray = OPEN_LOOP) -> np.ndarray:
    """What is found at the end."""
    return np.asarray(shares(samples, ModelError(LAYOUT), ratio)[-1])


def test_no_more_is_missing_than_all_of_an_effect() -> None:
    """Of one that is not known yet, and that a prior holds near zero, it would be many times."""
    found = shares(rolled(0.015), ModelError(LAYOUT), effect=1e-30 * KNOWN)[-1]
    assert found.tolist() == [1.0, 0.0, 0.0]


@pytest.mark.parametrize(
    "flight",
    [{"travel": 0.015}, {"travel": 0.03}, {"travel": 0.05}, {"lag": 0.08}, {"lag": 0.12}],
    ids=str,
)
def test_an_aileron_that_saturates_or_lags_is_found(flight: dict[str, float]) -> None:
    """In roll alone: elevator and rudder do not move."""
    found = share(rolled(**flight))
    assert found[0] > 0.1
    assert found[1:].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_surface_that_rests_while_its_row_learns_is_accused_of_nothing(seed: int) -> None:
    """A minute later the newest blocks hold only what the filter has left of it, down to nothing.

    That is an exponential, its square and its slopes: one block fits it, and leaves no scatter.
    """
    rng, t = np.random.default_rng(seed), DT * np.arange(3200)
    moves = 0.05 * (np.sin(1.3 * t) + np.sin(3.1 * t + 1.0))
    u = np.where(t < 60.0, moves, 0.05 * np.exp(-15.0 * np.maximum(t - 60.0, 0.0)))
    p = 0.1 * np.convolve(rng.normal(size=len(t)), np.ones(20) / 20.0, "same")
    looked, noise = ModelError(LAYOUT), 0.1 * rng.normal(size=len(t))
    found = shares(by_aileron(u, DAMPING * p + EFFECT * u + noise, p), looked)
    assert found.max() < 0.02
    assert looked.relative_error(KNOWN_ROWS).max() < 0.02


def early(seconds: float = 60.0, noise: float = 0.3) -> tuple[RowSamples, float]:
    """A lag of 0.1 s is told that is not there: the command is lagged, what acts is not."""
    samples = rolled(seconds=seconds, noise=noise)
    u = samples.f[0, :, LAYOUT.main[0]]
    lagged, keep = np.zeros_like(u), np.exp(-DT / 0.1)
    for k in range(1, len(u)):
        lagged[k] = keep * lagged[k - 1] + (1.0 - keep) * u[k]
    for regressors in (samples.f, samples.z):
        regressors[0, :, LAYOUT.main[0]] = lagged
    ahead = keep / (1.0 - keep) * np.diff(lagged)  # u is as far ahead of it, sample by sample
    return samples, float(np.std(ahead) / np.std(lagged))


def test_an_aileron_that_acts_early_counts_in_every_row() -> None:
    samples, ahead = early()
    looked = ModelError(LAYOUT)
    assert shares(samples, looked)[-1].tolist() == [0.0, 0.0, 0.0]  # nothing is taken away
    assert looked.relative_error(KNOWN_ROWS) == pytest.approx([ahead] * 3, rel=0.1)
    # nobody knows whether an aileron is early of which nobody knows what it does
    assert looked.relative_error(np.array([False, True, True])).tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("settled", [True, False])
def test_what_seemed_early_at_the_start_goes_as_soon_as_there_is_enough_without(
    settled: bool,
) -> None:
    looked = ModelError(LAYOUT)
    samples, ahead = early(30.0, noise=0.1)
    shares(samples, looked, settled=False)
    assert looked.relative_error(KNOWN_ROWS) == pytest.approx([ahead] * 3, rel=0.1)
    shares(rolled(seconds=20.0), looked, settled=settled)
    assert (looked.relative_error(KNOWN_ROWS).max() < 0.01) == settled


def test_what_was_late_stays_while_nothing_is_learned() -> None:
    looked = ModelError(LAYOUT)
    found = shares(rolled(0.015, seconds=30.0), looked)[-1]
    quiet = rolled(seconds=2.0)
    for _ in range(60):
        looked.add(quiet, np.zeros(3), OPEN_LOOP, 0.0, KNOWN, restarted=False)
    assert looked.share == pytest.approx(found)
    assert looked.share[0] > 0.1


@pytest.mark.parametrize("noise", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_aileron_that_does_as_it_is_told_is_not(noise: float, seed: int) -> None:
    assert share(rolled(noise=noise, seed=seed))[0] < 0.01


def test_a_row_that_is_learned_anew_is_forgotten() -> None:
    looked = ModelError(LAYOUT)
    assert shares(rolled(0.02), looked)[-1, 0] > 0.1
    looked.forget(0)
    assert not looked.share[0]
    assert not shares(rolled(), looked)[-1, 0]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_aileron_that_answers_gusts_is_not_called_late(seed: int) -> None:
    """It looks so: it follows the gust, and takes the gust's first part for its own."""
    rng = np.random.default_rng(seed)
    n = round(60.0 / DT)
    gusts, u = np.zeros(n), np.zeros(n)
    for k in range(1, n):
        gusts[k] = 0.9 * gusts[k - 1] + rng.normal()
        u[k] = 0.8 * u[k - 1] - 0.01 * gusts[k] + 0.01 * rng.normal()
    samples = by_aileron(u, EFFECT * u + gusts, residual=gusts)
    assert share(samples)[0] > 0.1
    answers = np.array([0.5, 0.0, 0.0])
    assert share(samples, answers).tolist() == [0.0, 0.0, 0.0]


def test_gusts_that_roll_and_push_make_no_height_where_they_are_answered() -> None:
    """As if the accelerometer were half a metre up."""
    rng, places = np.random.default_rng(1), layout(STRUCTURES["flight_dynamics"])
    p = np.convolve(rng.normal(size=1200), np.ones(10), "same")
    signals = np.zeros((places.rows, len(p), 2 + 2 * places.width))
    samples = RowSamples(signals, DT)
    samples.f[3, :, places.rolling[0]] = samples.z[3, :, places.rolling[0]] = p
    samples.y[3] = samples.residual[3] = 0.5 * np.diff(p, prepend=0.0) / DT + 10.0 * rng.normal(
        size=len(p)
    )

    def height(roll_ratio: float) -> float:
        looked = ModelError(places)
        for k in range(0, samples.count, 2):
            part = RowSamples(signals[:, k : k + 2], DT)
            looked.add(part, EVERYWHERE, OPEN_LOOP, roll_ratio, KNOWN, restarted=k == 0)
        return looked.height

    assert height(0.0) == pytest.approx(0.5, rel=0.2)
    assert height(0.5) == 0.0
