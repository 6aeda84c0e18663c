# SPDX-License-Identifier: Apache-2.0
"""Whose control derivatives are flown on, axis by axis, and what the inputs are measured to do."""

import dataclasses

import numpy as np
import pytest
from plants import LIMITS, START, STRUCTURE, coefficients, controller, flown

from uav_ident_ros.client import Coefficients, CoefficientSource, Fallback
from uav_ident_ros.control import AxisChoice, Effectiveness
from uav_ident_ros.control.effectiveness import SURE
from uav_ident_ros.identification.structure import FloatArray

LATER = START + 10**8


def choice(**options: bool) -> tuple[AxisChoice, CoefficientSource]:
    source = CoefficientSource(Fallback.LAST_GOOD, coefficients())
    return AxisChoice(source, coefficients(), LIMITS, **options), source


def found(
    axis: int, factor: float, sigma: float = 0.1
) -> tuple[AxisChoice, CoefficientSource, Effectiveness]:
    """Let it be measured on one axis, at `LATER`, that the inputs have so much of their effect."""
    (chosen, source), measured = choice(), Effectiveness()
    chosen.update(START, measured)
    measured.factor[axis], measured.sigma[axis] = factor, sigma
    chosen.update(LATER, measured)
    return chosen, source, measured


def changed(message: Coefficients, name: str, value: float, sigma: float) -> Coefficients:
    values, sigmas = message.values.copy(), message.sigma.copy()
    values[STRUCTURE.index(name)], sigmas[STRUCTURE.index(name)] = value, sigma
    return dataclasses.replace(message, values=values, sigma=sigmas)


@pytest.mark.parametrize(
    ("value", "sigma", "reason"),
    [
        (-20.0, 15.0, "the main derivative of qdot is not known"),
        (0.01, 1e-6, "0.00"),
        (2000.0, 1e-6, "authority"),
        (20.0, 1e-6, "turn its sign"),
    ],
)
def test_axes_that_are_known_and_can_be_flown_are_adopted_and_the_others_stay(
    value: float, sigma: float, reason: str
) -> None:
    chosen, source = choice()
    source.add(changed(coefficients(0.5, LATER), "qdot/de", value, sigma))
    effect = chosen.update(LATER, Effectiveness())
    assert effect.sources == ("identified", "nominal", "identified")
    assert reason in effect.reasons[1]
    assert effect.values[0, 2] == pytest.approx(0.5 * 29.5)
    assert effect.values[1, 0] == -26.0


def test_the_last_good_row_stays_while_the_estimate_is_unusable_or_old() -> None:
    chosen, source = choice()
    source.add(coefficients(0.5, LATER))
    chosen.update(LATER, Effectiveness())
    refused = coefficients(0.2, LATER + 50_000_000)
    source.add(dataclasses.replace(refused, usable=False, usable_rows=(False, False, True)))
    effect = chosen.update(LATER + 50_000_000, Effectiveness())
    assert effect.sources == ("last good", "last good", "identified")
    assert "not usable" in effect.reasons[0] and not effect.reasons[2]
    assert effect.values[0, 2] == pytest.approx(0.5 * 29.5)
    silent = chosen.update(LATER + 10**10, Effectiveness())
    assert "old" in silent.reasons[0] and silent.values[0, 2] == pytest.approx(0.5 * 29.5)


def test_a_lost_aileron_is_adopted_for_the_rudder_still_rolls() -> None:
    chosen, source = choice()
    source.add(changed(coefficients(1.0, LATER), "pdot/da", 0.0, 0.1))
    assert chosen.update(LATER, Effectiveness()).sources[0] == "identified"


def test_the_fixed_mode_never_changes_its_effect() -> None:
    chosen, source = choice(adaptive=False)
    source.add(coefficients(0.5, LATER))
    assert chosen.update(LATER, Effectiveness()).sources == ("nominal",) * 3


def manoeuvre(t: float) -> FloatArray:
    return np.array([0.2 * np.sin(2.0 * t), 0.1 * np.sin(1.3 * t), 0.05 * np.sin(1.7 * t)])


@pytest.mark.parametrize("surface", [0, 1, 2], ids=["elevator", "rudder", "aileron"])
def test_a_reversed_surface_is_turned_before_the_aircraft_is_lost(surface: int) -> None:
    def effect(t: float) -> FloatArray:
        out = np.ones(4)
        out[surface] = 1.0 if t < 5.0 else -1.0
        return out

    axis = {0: 1, 1: 2, 2: 0}[surface]
    flying, _ = controller()
    rates = flown(flying, effect, manoeuvre, seconds=11.0, noise=0.005)
    assert flying.effect.sources[axis] == "measured"
    assert [s for i, s in enumerate(flying.effect.sources) if i != axis] == ["nominal"] * 2
    t = np.arange(len(rates)) * 0.01
    wanted = np.array([manoeuvre(s) for s in t])
    assert np.abs(rates - wanted)[800:].max() < 0.06  # rad/s: as before the fault
    fixed, _ = controller(adaptive=False)
    assert np.abs(flown(fixed, effect, manoeuvre, seconds=11.0, noise=0.005)).max() > 1.0


def turns(t: float) -> FloatArray:
    """Bank to one side and the other, smoothed as by a pilot's hand."""
    side = 1.0 if t % 4.0 < 2.0 else -1.0
    return np.array([0.3 * side * (1.0 - np.exp(-(t % 2.0) / 0.2)), 0.0, 0.0])


def test_a_halved_effect_is_flown_on_before_it_is_learned() -> None:
    def effect(t: float) -> FloatArray:
        return np.array([1.0, 1.0, 1.0 if t < 5.0 else 0.5, 1.0])

    flying, _ = controller()
    flown(flying, effect, turns, seconds=9.5, noise=0.005)
    assert flying.effect.sources == ("measured", "nominal", "nominal")
    assert flying.effect.values[0, 2] == pytest.approx(0.5 * 29.5, rel=0.25)


def lively(t: float) -> FloatArray:
    return turns(t) + 0.3 * manoeuvre(t)


@pytest.mark.parametrize(("steps", "speed"), [(0, 2.3), (6, 1.0), (8, 2.3)])
def test_a_wrongly_configured_delay_is_found_and_not_taken_for_another_effect(
    steps: int, speed: float
) -> None:
    """Told two steps. What is measured never makes the loop worse; what rings is mended."""
    wanted, errors = np.array([lively(0.01 * k) for k in range(1200)]), {}
    for adaptive in (False, True):
        flying, _ = controller(speed=speed, adaptive=adaptive)
        rates = flown(flying, 1.0, lively, 12.0, noise=0.005, delay_steps=steps)
        errors[adaptive] = np.sqrt(np.mean((rates - wanted)[600:] ** 2))
    assert errors[True] < 1.35 * errors[False]
    if steps == 8:
        assert flying.delay.delay == pytest.approx(0.08, abs=0.011)
        assert errors[True] < 0.3 * errors[False]  # which rings
    assert (np.abs(flying.effect.share - 1.0) < 0.35).all()


@pytest.mark.parametrize(("told", "true"), [(6, 2), (5, 2), (6, 6), (2, 2)])
def test_a_delay_told_too_long_is_found_and_a_right_one_stays(told: int, true: int) -> None:
    flying, _ = controller(speed=1.5, told=told)
    flown(flying, 1.0, lively, 12.0, noise=0.005, delay_steps=true)
    assert flying.delay.delay == pytest.approx(0.01 * true, abs=0.011)
    assert (np.abs(flying.effect.share - 1.0) < 0.35).all()


def gusts(seed: int, samples: int, size: FloatArray | float) -> FloatArray:
    """Slow accelerations of an aircraft, rad/s^2, (N, 3)."""
    rng, gust = np.random.default_rng(seed), np.zeros((samples, 3))
    for k in range(1, samples):
        gust[k] = 0.97 * gust[k - 1] + size * rng.standard_normal(3)
    return gust


def test_gusts_and_noise_are_not_taken_for_another_delay() -> None:
    flying, _ = controller(speed=2.3)
    gust = gusts(5, 1200, np.array([0.6, 0.3, 0.2]))
    flown(flying, 1.0, turns, seconds=12.0, disturbance=gust, noise=0.01)
    assert flying.delay.delay == pytest.approx(0.02)


def test_gusts_are_not_taken_for_a_lost_effect() -> None:
    """Least squares would take them for that: the inputs answer them."""
    flying, _ = controller()
    shares: list[float] = []
    flown(
        flying, 1.0, turns, seconds=20.0, disturbance=gusts(3, 2000, 0.25), noise=0.005,
        each=lambda _: shares.append(flying.effect.share[0]),
    )  # fmt: skip
    assert np.mean(np.abs(np.array(shares) - 1.0) < 0.25) > 0.9


def test_an_identified_row_must_not_undo_what_is_measured() -> None:
    chosen, source, measured = found(0, 0.55)
    assert chosen.update(LATER, measured).values[0, 2] == pytest.approx(29.5)  # a gust may be
    later = LATER + 10**9
    assert chosen.update(later, measured).values[0, 2] == pytest.approx(0.55 * 29.5)
    source.add(coefficients(1.0, later))  # it has not noticed anything yet
    effect = chosen.update(later, measured)
    assert effect.sources == ("measured", "identified", "identified")
    assert "0.55 times its effect" in effect.reasons[0]
    source.add(coefficients(0.5, later + 10**8))
    effect = chosen.update(later + 10**8, measured)
    assert effect.sources == ("identified",) * 3
    assert effect.values[0, 2] == pytest.approx(0.5 * 29.5)


def test_what_is_measured_is_followed_as_it_becomes_surer() -> None:
    """The first measurement says that the effect is another, a later one how much it is."""
    chosen, _, measured = found(0, 0.6, 0.13)
    later = LATER + 10**9
    assert chosen.update(later, measured).share[0] == pytest.approx(0.6)
    for since, sigma, seconds, share in [
        (0.55, 0.2, 0.1, 0.6), (0.5, 0.1, 0.1, 0.5), (0.52, 0.1, 0.1, 0.52), (0.9, 1.0, 1.0, 0.52),
        (0.56, 0.2, 2.5, 0.56),  # what was found long ago is less sure by now
    ]:  # fmt: skip
        measured.since[0], measured.since_sigma[0] = since, sigma
        later += round(seconds * 1e9)
        assert chosen.update(later, measured).share[0] == pytest.approx(share)


def test_half_of_the_nominal_effect_may_be_flown_where_more_was_identified() -> None:
    """Not half of what was identified alone, whose sigma may be a fifth."""
    chosen, source = choice()
    measured = Effectiveness()
    source.add(coefficients(1.2, LATER))
    assert chosen.update(LATER, measured).share[0] == pytest.approx(1.2)
    measured.factor[0], measured.sigma[0] = 0.52, 0.1
    chosen.update(LATER + 10**8, measured)
    source.add(coefficients(1.2, LATER + 10**9))
    assert chosen.update(LATER + 10**9, measured).share[0] == pytest.approx(0.52)
    measured.since[0], measured.since_sigma[0] = 0.3, 0.05
    assert chosen.update(LATER + 10**9 + 10**7, measured).share[0] == pytest.approx(0.5)


@pytest.mark.parametrize(("moved", "share"), [(1.2, 1.0), (0.9, 0.5)])
def test_a_loop_that_rings_on_too_little_effect_goes_back_to_the_row(
    moved: float, share: float
) -> None:
    """A gust was taken for half of the effect; gyro noise may add four tenths to what is shown."""
    chosen, _, measured = found(2, 0.5)
    assert chosen.update(LATER + 10**9, measured).share[2] == pytest.approx(0.5)
    measured.moved[2], measured.moved_sigma[2], measured.sigma[2] = moved, 0.1, 1.0
    chosen.update(LATER + 2 * 10**9, measured)
    assert chosen.update(LATER + 3 * 10**9, measured).share[2] == pytest.approx(share)


def test_least_squares_sees_what_the_reference_does_not_ask_for() -> None:
    """A loop rings: nothing was demanded, and the inputs do all of their effect."""
    measured, rng = Effectiveness(), np.random.default_rng(0)
    for k in range(300):
        made = np.full(3, np.sin(0.02 * np.pi * k))
        measured.update(made + 0.1 * rng.standard_normal(3), made, 0.01, np.full(3, 1e-3))
    assert measured.moved == pytest.approx([1.0, 1.0, 1.0], abs=0.1)
    assert (measured.moved_sigma < 0.5 * measured.sigma).all()


def measure(
    measured: Effectiveness, seconds: float, size: float, effect: float, noise: float, seed: int = 0
) -> None:
    """Let it take so many seconds of turns of one size."""
    rng = np.random.default_rng(seed)
    for k in range(round(seconds / 0.01)):
        asked = np.full(3, size * np.sin(0.05 * k))
        made = asked + 0.1 * rng.standard_normal(3)
        measured.update(effect * made + noise * rng.standard_normal(3), made, 0.01, asked)


def test_what_was_measured_before_a_change_does_not_count_after_it() -> None:
    """Lively turns, a surface that loses half of its effect, and gentle turns from then on."""
    measured = Effectiveness()
    measure(measured, 20.0, 3.0, 1.0, 0.05)
    measure(measured, 2.1, 0.5, 0.5, 0.05, 1)
    assert measured.factor == pytest.approx([0.5] * 3, abs=0.1)
    assert (measured.sigma < 0.15).all()


def test_a_change_is_measured_from_its_beginning_on() -> None:
    measured = Effectiveness()
    measure(measured, 20.0, 1.0, 1.0, 2.0)
    measure(measured, 2.1, 1.0, 0.5, 2.0, 1)
    measured.begin(np.array([True, True, False]))
    assert measured.since[:2].tolist() == measured.factor[:2].tolist()
    assert measured.since_sigma[:2].tolist() == measured.sigma[:2].tolist()
    measure(measured, 20.0, 1.0, 0.5, 2.0, 2)
    assert measured.since[:2] == pytest.approx([0.5] * 2, abs=0.15)
    assert measured.since[2] == pytest.approx(0.74, abs=0.15)  # half of its time was before
    assert (measured.since_sigma < 0.6 * measured.sigma)[:2].all()
    measured.changed(0)
    measure(measured, 1.9, 1.0, 1.0, 2.0, 3)
    assert measured.since_sigma[0] > 100.0  # nothing yet
    measure(measured, 20.0, 1.0, 1.0, 2.0, 4)
    assert measured.since[0] == pytest.approx(1.0, abs=0.15)
    assert measured.since[1] < 0.9


def test_a_quiet_moment_is_no_surer_than_what_came_before_allows() -> None:
    """Gusts come and go: two seconds without any say little of the next."""
    found = []
    for noise in (0.05, 5.0):
        measured = Effectiveness()
        measure(measured, 30.0, 1.0, 1.0, noise)
        measure(measured, 2.1, 1.0, 1.0, 0.05, 1)
        found.append(float(measured.sigma[0]))
    assert found[1] > 2.0 * found[0]


@pytest.mark.parametrize("explains", [False, True])
def test_a_delay_excuses_only_what_it_explains(explains: bool) -> None:
    """An input acts the other way, and half a turn later would be the same: or explains nothing."""
    measured = Effectiveness()
    for k in range(300):
        made = np.full(3, np.sin(0.1 * k))
        answered = made if k < 200 else -made
        late = answered if explains else 0.3 * made
        measured.update(answered, made, 0.01, rival=(answered, late))
    assert measured.reversed.all() == (not explains)
    assert (measured.sigma > 100.0).all()  # nothing else is concluded


def test_the_jerk_of_a_jam_does_not_hide_that_nothing_answers() -> None:
    measured, rng = Effectiveness(), np.random.default_rng(0)
    for k in range(400):
        made = np.full(3, 10.0 * np.sin(0.05 * k))
        jams = 300 <= k < 315  # and stands still from then on
        answered = made if k < 300 else np.full(3, 40.0 * jams)
        measured.update(answered + rng.standard_normal(3), made, 0.01)
    assert measured.dead.all()


def test_a_reversed_input_is_turned_on_all_that_it_moves() -> None:
    source = CoefficientSource(Fallback.LAST_GOOD, coefficients())
    chosen = AxisChoice(source, changed(coefficients(), "rdot/da", -2.0, 0.1), LIMITS)
    measured = Effectiveness()
    measured._log_ratio[0, 0] = SURE
    assert chosen.update(LATER, measured).values[:, 2].tolist() == [-29.5, 0.0, 2.0]
    source.add(changed(coefficients(), "rdot/da", -2.0, 0.1))  # has not noticed anything yet
    assert chosen.update(LATER, measured).values[:, 2].tolist() == [-29.5, 0.0, 2.0]
    turned = changed(coefficients(np.array([1.0, 1.0, -1.0, 1.0]), LATER), "rdot/da", 1.5, 0.1)
    source.add(turned)
    assert chosen.update(LATER, measured).values[0, 2] == -29.5
    source.add(dataclasses.replace(turned, t_ns=LATER + 10**8))
    assert chosen.update(LATER + 10**8, measured).values[:, 2].tolist() == [-29.5, 0.0, 1.5]


@pytest.mark.parametrize("reversals", [1, 2])
def test_an_input_that_does_nothing_has_the_sign_of_before(reversals: int) -> None:
    """A surface that jams makes a jerk the wrong way, once or twice, and then none."""
    chosen, measured = choice()[0], Effectiveness()
    before = chosen.update(START, measured).values[:, 2].tolist()
    for _ in range(reversals):
        measured._log_ratio[0, 0] = SURE
        chosen.update(LATER, measured)
    measured.dead[0] = True
    for _ in range(2):
        assert chosen.update(LATER, measured).values[:, 2].tolist() == before


@pytest.mark.parametrize(
    ("factor", "rolls", "share"),
    [
        (0.55, True, 0.55),
        (0.55, False, 1.0),  # what a tumbling aircraft shows of its other axes
        (1.4, True, 1.0),  # more effect than believed needs twice the evidence
        (1.7, True, 1.7),
    ],
)
def test_what_is_measured_is_flown_on_if_it_stands_out(
    factor: float, rolls: bool, share: float
) -> None:
    chosen, _, measured = found(1, factor)
    measured.dead[0] = not rolls
    assert chosen.update(LATER + 10**9, measured).share[1] == pytest.approx(share)
