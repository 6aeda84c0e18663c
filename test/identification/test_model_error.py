# SPDX-License-Identifier: Apache-2.0
"""Model error of an input: saturation, servo lag and wrong lag settings, against feedback."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from flying import identified
from scipy.signal import lfilter
from verdict_flights import fly

from uav_ident_ros.identification.estimators.model_error import LOADING, Losses, ModelError, _solved
from uav_ident_ros.identification.regression import Layout, Regression, RowSamples, layout
from uav_ident_ros.identification.structure import MAIN_DERIVATIVES, STRUCTURES

STRUCTURE = STRUCTURES["augmented"]
LAYOUT = layout(STRUCTURE)
DT, EVERYWHERE, OPEN_LOOP = 0.05, np.ones(3), np.zeros(3)
ROLL_RATE, YAW_RATE, ELEVATOR, RUDDER, AILERON = 5, 7, 8, 9, 10
YAW = 2
DAMPING, EFFECT = -6.0, 40.0
UNDAMPED = np.zeros(3)
KNOWN = np.array([EFFECT, -30.0, -9.0])
KNOWN_ROWS = np.ones(3, dtype=bool)


def by_aileron(
    u: np.ndarray,
    pdot: np.ndarray,
    p: np.ndarray | float = 0.0,
    residual: np.ndarray | None = None,  # Residual, if not `pdot`
    axis: int = 0,  # 1 for a pitching motion by the elevator, 2 for a yawing one by the rudder
) -> RowSamples:
    """Samples of a roll with aileron command u."""
    y, f = np.zeros((len(u), 3)), np.zeros((len(u), STRUCTURE.size))
    y[:, axis], f[:, ROLL_RATE + axis], f[:, (AILERON, ELEVATOR, RUDDER)[axis]] = pdot, p, u
    left = y if residual is None else np.outer(residual, [1.0, 0.0, 0.0])
    return RowSamples.of(Regression.of(y, f, f, DT), left, LAYOUT)


def rolled(
    travel: float = 1.0,
    noise: float = 0.3,
    lag: float = 0.0,
    seconds: float = 60.0,
    seed: int = 1,
    dead: float = 0.0,
    play: float = 0.0,
    speed: float = np.inf,
    effect: float = EFFECT,
    axis: int = 0,
) -> RowSamples:
    """Samples of a roll by an aileron with a travel, rad, for 0.1 commanded, and a servo lag, s.

    Of each command a band `dead` to either side of zero, rad, is missing. The aileron follows
    behind a `play`, rad from stop to stop, and at most at a `speed`, rad/s.
    """
    rng = np.random.default_rng(seed)
    t = DT * np.arange(round(seconds / DT))
    u = 0.05 * (np.sin(1.3 * t) + np.sin(3.1 * t + 1.0))
    p, pdot = np.zeros(len(t) + 1), np.zeros(len(t))
    gusts, reached, behind, slow = noise * rng.normal(size=len(t)), 0.0, 0.0, float(u[0])
    for k, command in enumerate(u):
        behind = float(np.clip(behind, command - 0.5 * play, command + 0.5 * play))
        command = slow = float(np.clip(behind, slow - speed * DT, slow + speed * DT))
        keep = np.exp(-DT / lag) if lag else 0.0
        moved = np.clip(command, -travel, travel) - np.clip(command, -dead, dead)
        reached = keep * reached + (1.0 - keep) * moved
        pdot[k] = DAMPING * p[k] + effect * reached + gusts[k]
        p[k + 1] = p[k] + DT * pdot[k]
    return by_aileron(u, pdot, p[:-1], axis=axis)


def known(effect: np.ndarray = KNOWN, places: Layout = LAYOUT) -> np.ndarray:
    """Return coefficients of the regression problem with these main control derivatives, (3,)."""
    coefficients = np.zeros((places.rows, places.size))
    coefficients[MAIN_DERIVATIVES] = effect
    return coefficients


def shares(
    samples: RowSamples,
    error_model: ModelError,
    ratio: np.ndarray = OPEN_LOOP,
    effect: np.ndarray = KNOWN,
    *,
    weight: np.ndarray = EVERYWHERE,
    roll_ratio: float = 0.0,
    linear: np.ndarray | None = None,  # Coefficients, if not those of `effect`
    force_is_known: bool = False,
    **state: bool,
) -> np.ndarray:
    """Return the model error after each two samples, (m / 2, 3)."""
    found, linear = [], known(effect) if linear is None else linear
    for k in range(0, samples.count, 2):
        part = RowSamples(samples.signals[:, k : k + 2], samples.dt)
        given = {"force_is_known": force_is_known, "restarted": k == 0, **state}
        error_model.add(part, weight, ratio, roll_ratio, linear, **given)
        found.append(error_model.share)
    return np.array(found)


def after(
    samples: RowSamples, ratio: np.ndarray = OPEN_LOOP, places: Layout = LAYOUT, **more: Any
) -> ModelError:
    """Return the model error after the samples."""
    error_model = ModelError(places)
    shares(samples, error_model, ratio, **more)
    return error_model


def test_the_model_error_is_at_most_the_whole_effect() -> None:
    """The effect is unknown, and the prior holds it near zero."""
    assert after(rolled(0.015), effect=1e-30 * KNOWN).share.tolist() == [1.0, 0.0, 0.0]


@pytest.mark.parametrize(
    "flight",
    [
        *({"travel": 0.015}, {"travel": 0.03}, {"travel": 0.05}),
        *({"lag": 0.08}, {"lag": 0.12}),
        *({"dead": 0.02}, {"dead": 0.04}),
    ],
    ids=str,
)
def test_a_saturated_lagging_or_dead_aileron_has_a_model_error(flight: dict[str, float]) -> None:
    """Elevator and rudder do not move and have none."""
    found = after(rolled(**flight)).share
    assert found[0] > 0.1
    assert found[1:].tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("travel", "noise", "seed"), [(0.05, 2.0, 3), (0.05, 3.0, 1), (0.06, 2.0, 2)]
)
def test_a_saturation_counts_from_three_sigma_on(travel: float, noise: float, seed: int) -> None:
    """0.43 to 0.59 of the effect are lost, by 3.3 to 3.6 sigma, of which one is subtracted."""
    assert 0.3 < after(rolled(travel=travel, noise=noise, seed=seed)).share[0] < 0.43


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_saturation_counts_in_full_where_all_others_saturate(seed: int) -> None:
    """Alone, and beside one other, it is not significant. A healthy aileron hardly loses any."""
    elevator, rudder = (
        rolled(travel=0.03, effect=float(KNOWN[axis]), axis=axis).signals for axis in (1, 2)
    )
    saturated, healthy = (
        rolled(travel, noise, seed=seed).signals for travel, noise in ((0.04, 4.0), (1.0, 0.3))
    )
    for flown in (saturated, saturated + elevator, saturated + rudder):
        assert after(RowSamples(flown, DT)).share[0] == 0.0
    for aileron, least, most in ((saturated, 0.1, 1.0), (healthy, 0.0, 0.05)):
        found = after(RowSamples(aileron + elevator + rudder, DT)).share
        assert found[1:].min() > 0.3
        assert least <= found[0] <= most


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_surface_at_rest_has_no_model_error(seed: int) -> None:
    """A minute later the newest blocks contain only the filter's exponential decay of the input.

    The decay, its square and its slopes fit a single block without scatter.
    """
    rng, t = np.random.default_rng(seed), DT * np.arange(3200)
    moves = 0.05 * (np.sin(1.3 * t) + np.sin(3.1 * t + 1.0))
    u = np.where(t < 60.0, moves, 0.05 * np.exp(-15.0 * np.maximum(t - 60.0, 0.0)))
    p = 0.1 * np.convolve(rng.normal(size=len(t)), np.ones(20) / 20.0, "same")
    error_model, noise = ModelError(LAYOUT), 0.1 * rng.normal(size=len(t))
    found = shares(by_aileron(u, DAMPING * p + EFFECT * u + noise, p), error_model)
    assert found.max() < 0.02
    assert error_model.relative_error(KNOWN_ROWS, UNDAMPED).max() < 0.02


def early(seconds: float = 60.0, noise: float = 0.3) -> tuple[RowSamples, float]:
    """Return samples with a configured lag of 0.1 s that the servo does not have, and the lead."""
    samples = rolled(seconds=seconds, noise=noise)
    u = samples.f[0, :, LAYOUT.main[0]]
    lagged, keep = np.zeros_like(u), np.exp(-DT / 0.1)
    for k in range(1, len(u)):
        lagged[k] = keep * lagged[k - 1] + (1.0 - keep) * u[k]
    for regressors in (samples.f, samples.z):
        regressors[0, :, LAYOUT.main[0]] = lagged
    ahead = keep / (1.0 - keep) * np.diff(lagged)  # lead of u on the lagged command, at each sample
    return samples, float(np.std(ahead) / np.std(lagged))


def test_an_early_aileron_is_a_model_error_of_every_row() -> None:
    samples, ahead = early()
    error_model = after(samples)
    assert error_model.share.tolist() == [0.0, 0.0, 0.0]  # no loss of effect
    assert error_model.relative_error(KNOWN_ROWS, UNDAMPED) == pytest.approx([ahead] * 3, rel=0.1)
    # an aileron of unknown effect has no known earliness
    assert not error_model.relative_error(np.array([False, True, True]), UNDAMPED).any()


def test_an_input_acts_at_its_command_at_the_soonest() -> None:
    """A rudder that is not early shows that the stamps are right."""
    (samples, _), healthy = early(noise=0.1), rolled(noise=0.1, seed=2)
    rate, roll_rate = LAYOUT.place[YAW, :, 1] == YAW_RATE, LAYOUT.place[0, :, 1] == ROLL_RATE
    samples.y[YAW], samples.residual[YAW] = healthy.y[0], healthy.residual[0]
    for own, of_aileron in ((samples.f, healthy.f), (samples.z, healthy.z)):
        own[YAW][:, LAYOUT.main[YAW]] = of_aileron[0][:, LAYOUT.main[0]]
        own[YAW][:, rate] = of_aileron[0][:, roll_rate]
    error_model = after(samples, effect=np.array([EFFECT, -30.0, EFFECT]))
    rows = np.array([True, False, True])
    found = float(error_model.relative_error(rows, UNDAMPED, 0.1)[0])
    assert found > 0.15
    # earlier by 0.07 s, of which 0.02 s and the rudder's three sigma are possible
    assert 0.35 < error_model.relative_error(rows, UNDAMPED, 0.02)[0] / found < 0.45
    # without the rudder all stamps may be wrong
    rows[YAW] = False
    assert error_model.relative_error(rows, UNDAMPED, 0.02)[0] == pytest.approx(found, rel=0.01)


@pytest.mark.parametrize(
    ("scale", "wind", "seconds"),
    [
        (0.4, 0, 40.0),  # collinear with its slope, the elevator seemed 41 ms early
        (0.5, 1, 52.0),  # gusts make the aileron early, by more than the delay
    ],
)
def test_healthy_inputs_of_a_quick_aircraft_are_usable_in_weak_excitation(
    scale: float, wind: int, seconds: float
) -> None:
    pytest.importorskip("jsbsim", reason="JSBSim is a development extra")
    measured = fly("ultra_stick_25e", 2, scale=scale, wind=wind, duration=seconds)
    _, estimates = identified(measured)
    assert estimates[-1].usable, estimates[-1].reason


@pytest.mark.parametrize("settled", [True, False])
def test_an_early_input_at_the_start_is_cleared_by_enough_later_samples(settled: bool) -> None:
    samples, ahead = early(30.0, noise=0.03)
    error_model = after(samples, settled=False)
    assert error_model.relative_error(KNOWN_ROWS, UNDAMPED) == pytest.approx([ahead] * 3, rel=0.1)
    shares(rolled(seconds=20.0), error_model, settled=settled)
    assert (error_model.relative_error(KNOWN_ROWS, UNDAMPED).max() < 0.01) == settled


@pytest.mark.parametrize("noise", [0.3, 1.0, 1.5])
def test_an_early_input_is_not_cleared_by_the_first_later_samples(noise: float) -> None:
    """Too few to show it by themselves, they do not refute it either."""
    samples, _ = early(noise=noise)
    start, later = np.split(samples.signals, [round(40.0 / DT)], axis=1)
    error_model = after(RowSamples(start, DT), settled=False)
    lowest = 1.0
    for second in np.split(later, 20, axis=1):
        shares(RowSamples(second, DT), error_model)
        lowest = min(lowest, error_model.relative_error(KNOWN_ROWS, UNDAMPED).min())
    assert lowest > 0.12


def test_the_model_error_stays_while_no_row_is_learned() -> None:
    error_model = after(rolled(0.015, seconds=30.0))
    found = error_model.share
    assert found[0] > 0.1
    shares(rolled(seconds=120.0), error_model, weight=np.zeros(3))
    assert error_model.share == pytest.approx(found)


@pytest.mark.parametrize("noise", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_aileron_without_lag_or_saturation_has_no_model_error(noise: float, seed: int) -> None:
    error_model = after(rolled(noise=noise, seed=seed))
    assert error_model.share[0] < 0.01
    assert error_model.relative_error(KNOWN_ROWS, UNDAMPED)[0] < 0.06 * noise + 0.02


def by_side_force(
    seed: int, travel: float = 1.0, play: float = 0.0, is_known: bool = True
) -> ModelError:
    """Return the model error after a flight whose rudder makes a force, and hardly a moment."""
    places, rng = layout(STRUCTURES["flight_dynamics"]), np.random.default_rng(seed)
    _, entry, _ = places.surfaces[:, 3]
    t = DT * np.arange(round(60.0 / DT))
    u = 0.05 * (np.sin(1.3 * t) + np.sin(3.1 * t + 1.0))
    moved, behind = np.zeros(len(u)), 0.0
    for k, command in enumerate(u):
        moved[k] = behind = float(np.clip(behind, command - 0.5 * play, command + 0.5 * play))
    slopes = np.gradient(u, DT), np.gradient(np.clip(moved, -travel, travel), DT)
    y, f = np.zeros((len(u), places.rows)), np.zeros((len(u), places.size))
    f[:, RUDDER], f[:, places.index[3, entry]] = u, slopes[0]
    y[:, YAW] = 0.1 * rng.normal(size=len(u))
    y[:, 3] = 10.0 * slopes[1] + 0.3 * rng.normal(size=len(u))
    linear = known(np.array([0.0, 0.0, -0.1]), places)
    share = (slopes[0] @ slopes[1]) / (slopes[0] @ slopes[0])
    linear[3, places.index[3, entry]] = 10.0 * share
    samples = Regression.of(y, f, f, DT)
    rows = RowSamples.of(samples, samples.residual(linear), places)
    return after(rows, places=places, linear=linear, force_is_known=is_known)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_side_force_of_a_rudder_shows_its_saturation_and_backlash(seed: int) -> None:
    """Its moment does not: noise is many times as large."""
    assert by_side_force(seed, travel=0.05).share[YAW] > 0.2
    assert by_side_force(seed, play=0.04).lost[YAW] > 0.1
    for flown in (by_side_force(seed), by_side_force(seed, travel=0.05, is_known=False)):
        assert flown.share.tolist() == [0.0, 0.0, 0.0]
    assert by_side_force(seed).lost.tolist() == pytest.approx([0.0, 0.0, 0.0], abs=0.03)


@pytest.mark.parametrize(
    ("servo", "least", "times"),
    [({"play": 0.02}, 0.1, 1.3), ({"play": 0.04}, 0.2, 1.3), ({"speed": 0.08}, 0.3, 3.0)],
    ids=str,
)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_backlash_and_a_slow_servo_are_model_errors_of_their_own(
    servo: dict[str, float], least: float, times: float, seed: int
) -> None:
    """They are found before they are significant; as lateness they would look smaller.

    The servo turns at 0.08 rad/s, its commands at 0.12 rms.
    """
    found, healthy = (after(rolled(noise=1.0, seed=seed, **own)) for own in (servo, {}))
    assert found.lost[0] > max(least, times * float(found._late[0]))
    assert found.lost[1:].tolist() == [0.0, 0.0]
    assert healthy.lost[0] < 0.03


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_late_aileron_counts_before_it_is_significant(seed: int) -> None:
    """The noise hides a lag of 0.12 s for a minute."""
    error_model = after(rolled(lag=0.12, noise=5.0, seed=seed))
    assert not error_model.share.any()
    late = error_model.relative_error(~KNOWN_ROWS, UNDAMPED)
    assert late[0] > 0.1
    assert late[1:].tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("sigma", "roll"),
    [(0.5, 0.4), (0.1, 0.35), (0.02, 0.11)],
    ids=["as late as the others", "as late as it may be", "hardly late"],
)
def test_a_row_that_may_be_late_is_as_late_as_the_others(sigma: float, roll: float) -> None:
    """The others lose 0.8 and 0.4 of the effect of inputs at 2 and 1 rad/s: the lag is 0.4 s."""
    error_model = ModelError(LAYOUT)
    found, errors = np.array([0.05, 0.8, 0.4]), np.array([sigma, 0.001, 0.001])
    error_model._lateness, error_model._rate = np.array([found, errors**-2]), np.array([1, 2, 1])
    late = error_model.relative_error(KNOWN_ROWS, UNDAMPED)
    assert late.tolist() == pytest.approx([roll, 0.8, 0.4], rel=0.01)
    unknown = error_model.relative_error(KNOWN_ROWS & False, UNDAMPED)
    assert unknown.tolist() == [0.05, 0.8, 0.4]


def test_an_infinite_loss_is_that_of_its_row_alone() -> None:
    """As of an effect of zero: its precision is zero."""
    error_model = ModelError(LAYOUT)
    found, precision = np.array([np.inf, 0.1, 0.2]), np.array([0.0, 1e6, 1e6])
    error_model._lateness, error_model._rate = np.array([found, precision]), np.ones(3)
    late = error_model.relative_error(KNOWN_ROWS, UNDAMPED)
    assert late.tolist() == pytest.approx([1.0, 0.103, 0.2], rel=1e-6)


def half(error_model: ModelError, seconds: float, **flight: Any) -> float:
    """Return the model error of roll after flying on with half of the effect."""
    samples = rolled(**flight, effect=0.5 * EFFECT, seconds=seconds)
    shares(samples, error_model, effect=KNOWN * [0.5, 1.0, 1.0])
    return float(error_model.relative_error(KNOWN_ROWS, UNDAMPED)[0])


def test_a_row_that_is_learned_anew_keeps_its_model_error_until_the_flight_shows_it() -> None:
    error_model = after(rolled(0.02))
    before = error_model.share[0]
    error_model.begin_anew(0)
    assert half(error_model, 2.0) == before > 0.3
    half(error_model, 10.0)
    assert error_model.share[0] == 0.0


@pytest.mark.parametrize("seed", range(1, 6))
def test_noise_makes_no_input_late_in_a_row_that_is_learned_anew(seed: int) -> None:
    """Five seconds alone make it late by 5 to 71 % of its effect."""
    error_model = after(rolled(noise=2.0, seed=seed))
    error_model.begin_anew(0)
    assert half(error_model, 5.0, noise=2.0, seed=seed + 10) < 0.06


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_servo_that_slows_down_as_its_surface_fails_is_found(seed: int) -> None:
    error_model = after(rolled(noise=0.3, seed=seed))
    error_model.begin_anew(0)
    assert half(error_model, 30.0, lag=0.15, seed=seed) > 0.1


def correlated(keep: float, noise: np.ndarray) -> np.ndarray:
    """Noise with a memory, 0 at first."""
    return np.asarray(np.append(0.0, lfilter([1.0], [1.0, -keep], noise)))


HALF = np.array([0.5, 0.0, 0.0])
"""Share of the aileron's motion that answers gusts, relative to the rest."""


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_aileron_that_answers_gusts_has_no_model_error(seed: int) -> None:
    """Feedback resembles a late input: the aileron follows the gust that it correlates with."""
    chance = np.random.default_rng(seed).normal(size=(round(60.0 / DT) - 1, 2)).T
    gusts = correlated(0.9, chance[0])
    u = correlated(0.8, 0.01 * (chance[1] - gusts[1:]))
    samples = by_aileron(u, EFFECT * u + gusts, residual=gusts)
    assert after(samples).share[0] > 0.1
    assert not after(samples, HALF).relative_error(KNOWN_ROWS, UNDAMPED).any()


@pytest.mark.parametrize("seed", [1, 3])
def test_small_deflections_that_answer_gusts_are_no_dead_band(seed: int) -> None:
    """Large deflections follow a reference: the effect seems to grow with the deflection."""
    rng = np.random.default_rng(seed)
    gusts = correlated(0.9, rng.normal(size=round(60.0 / DT) - 1))
    steps = np.where(rng.uniform(size=60) < 0.9, 0.0, 1.0) * rng.choice([-0.3, 0.3], 60)
    u = np.repeat(steps, 20) - 0.01 * gusts + 0.002 * rng.normal(size=len(gusts))
    samples = by_aileron(u, EFFECT * u + gusts, residual=gusts)
    assert after(samples).share[0] == 1.0
    assert after(samples, HALF).share[0] == 0.0


def test_gusts_make_no_height_of_the_imu_where_the_inputs_answer_them() -> None:
    """Gusts roll the aircraft and push it sideways, as with an accelerometer 0.5 m up."""
    rng, places = np.random.default_rng(1), layout(STRUCTURES["flight_dynamics"])
    p = np.convolve(rng.normal(size=1200), np.ones(10), "same")
    samples = RowSamples(np.zeros((places.rows, len(p), 2 + 2 * places.width)), DT)
    samples.f[3, :, places.rolling[0]] = samples.z[3, :, places.rolling[0]] = p
    pushed = 0.5 * np.diff(p, prepend=0.0) / DT + 10.0 * rng.normal(size=len(p))
    samples.y[3] = samples.residual[3] = pushed
    own: dict[str, Any] = {"places": places, "linear": known(places=places)}
    assert after(samples, roll_ratio=0.0, **own).height == pytest.approx(0.5, rel=0.2)
    assert after(samples, roll_ratio=0.5, **own).height == 0.0


@pytest.mark.parametrize(
    ("found", "sigma", "kept"),
    [(0.1, 0.08, False), (0.1, 0.1, True), (0.15, 0.08, True), (-0.1, 0.08, False)],
)
def test_blocks_that_would_show_it_refute_earliness(found: float, sigma: float, kept: bool) -> None:
    """Of 0.27 s, in three sigma, they must show less than half."""
    error_model, rows = ModelError(LAYOUT), len(LAYOUT.main) + len(LAYOUT.rolling)
    _make_early(error_model, [0.0, 0.27, 0.0])
    none, every = np.zeros((rows, 1, 2)), np.ones(rows)
    spread = np.full((rows, 1, 2), sigma)
    shown = Losses(none - [0.0, found], none, spread, every, none, none, every > 0)
    error_model._follow_earliness(shown)
    only_pitch = error_model.relative_error(np.array([False, True, False]), UNDAMPED)
    assert only_pitch[1] == 0.27 * kept


def _make_early(
    error_model: ModelError, early: list[float], sigma: Sequence[float] = (0.05, 0.05, 0.05)
) -> None:
    """Set the earliness of the rows, s, of inputs with a rate of 1 rad/s."""
    error_model._early, error_model._early_sigma = np.array(early), np.array(sigma)
    error_model._rate = np.ones(3)


def test_an_early_yaw_of_a_multirotor_counts_for_itself_alone() -> None:
    """The inertia of the rotors makes it early, not a wrong setting."""
    yaw, both = ModelError(LAYOUT), ModelError(LAYOUT)
    _make_early(yaw, [0.0, 0.0, 0.5])
    _make_early(both, [0.5, 0.5, 0.0])
    np.testing.assert_array_equal(
        yaw.relative_error(KNOWN_ROWS, UNDAMPED, rotors=True), [0, 0, 0.5]
    )
    np.testing.assert_allclose(both.relative_error(KNOWN_ROWS, UNDAMPED, rotors=True), [0.5] * 3)


@pytest.mark.parametrize(
    ("yaw", "yaw_sigma", "damping", "shared"),
    [
        (0.2, 0.04, 0.0, True),
        (0.0, 0.04, 0.0, False),
        (-0.2, 0.04, 0.0, False),
        (0.0, 0.15, 0.0, True),  # too uncertain to contradict
        (0.0, 0.04, 5.0, False),  # 0.4 s would show as 0.13, three sigma are 0.12
        (0.0, 0.04, 6.5, True),  # as 0.11
    ],
)
def test_an_earliness_counts_for_all_unless_a_row_shows_none(
    yaw: float, yaw_sigma: float, damping: float, shared: bool
) -> None:
    """A wrong delay or lag makes all inputs early, gusts in the instruments one of them."""
    error_model = ModelError(LAYOUT)
    _make_early(error_model, [0.4, 0.2, yaw], [0.04, 0.04, yaw_sigma])
    dampings = np.array([0.0, 0.0, damping])
    found = error_model.relative_error(KNOWN_ROWS, dampings)
    assert found.tolist() == ([0.4] * 3 if shared else [0.4, 0.2, 0.0])
    without_yaw = error_model.relative_error(np.array([True, True, False]), dampings)
    assert without_yaw.tolist() == [0.4] * 3


def test_a_difference_of_a_ten_thousandth_of_the_power_is_found_by_a_third() -> None:
    """An input and its square, one-sided, are that similar; chance then makes large errors."""
    common, apart = 2.0 - 1e-4, 1e-4  # power of the sum and of the difference
    power = 0.5 * np.array([[common + apart, common - apart], [common - apart, common + apart]])
    effect = np.array([1.5, 0.5])
    *_, found = _solved(power[None], power[None], (power @ effect)[None], np.eye(2)[None], LOADING)
    assert found[0, 0].sum() == pytest.approx(2.0, rel=1e-3)
    assert found[0, 0, 0] - found[0, 0, 1] == pytest.approx(1.0 / 3.0, rel=0.01)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(("travel", "saturates"), [(0.03, True), (1.0, False)])
def test_answers_do_not_hide_a_saturated_aileron(travel: float, saturates: bool, seed: int) -> None:
    """A loop answers gusts with as much as is injected.

    Through this dither the injected signal alone sees a straight line.
    """
    rng, count = np.random.default_rng(seed), round(80.0 / DT)
    t = DT * np.arange(count)
    injected = 0.03 * (np.sin(1.3 * t) + np.sin(3.1 * t + 1.0) + np.sin(5.3 * t + 2.0))
    p, gust, angle, response = (np.zeros(count + 1) for _ in range(4))
    u, pdot = np.zeros(count), np.zeros(count)
    for k in range(count):
        u[k] = injected[k] - 0.3 * angle[k] - 0.03 * p[k]
        gust[k + 1] = 0.85 * gust[k] + 0.5 * rng.normal()
        pdot[k] = DAMPING * p[k] + EFFECT * np.clip(u[k], -travel, travel) + gust[k]
        p[k + 1], angle[k + 1] = p[k] + DT * pdot[k], angle[k] + DT * p[k]
        response[k + 1] = response[k] + DT * (DAMPING * response[k] + EFFECT * injected[k])
    samples = by_aileron(u, pdot, p[:-1], pdot - DAMPING * p[:-1] - EFFECT * u)
    samples.z[0, :, LAYOUT.main[0]] = injected
    samples.z[0, :, LAYOUT.index[0].tolist().index(ROLL_RATE)] = response[:-1]
    error_model = after(samples, effect=KNOWN * np.mean(np.abs(u) < travel), injected=True)
    assert error_model.share[0] < 0.25
    assert (error_model.lost[0] > 0.25) == saturates
