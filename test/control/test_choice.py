# SPDX-License-Identifier: Apache-2.0
"""The choice of control derivatives, axis by axis, and the measured control effectiveness."""

import dataclasses

import numpy as np
import pytest
from plants import LIMITS, START, STRUCTURE, coefficients, controller, flown

from uav_ident_ros.client import Coefficients, CoefficientSource, Fallback
from uav_ident_ros.control import AxisChoice, Effectiveness
from uav_ident_ros.control.effectiveness import CERTAIN
from uav_ident_ros.identification.structure import INPUT_COLUMNS, FloatArray

LATER = START + 10**8


def choice(**options: bool) -> tuple[AxisChoice, CoefficientSource]:
    source = CoefficientSource(Fallback.LAST_GOOD, coefficients())
    return AxisChoice(source, coefficients(), LIMITS, **options), source


def with_measured_factor(
    axis: int, factor: float, sigma: float = 0.1
) -> tuple[AxisChoice, CoefficientSource, Effectiveness]:
    """Return a choice with a measured factor of the effect on one axis, at `LATER`."""
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
    ("name", "value", "sigma", "reason"),
    [
        ("qdot/de", -20.0, 15.0, "the main derivative of qdot is not known"),
        ("qdot/de", -26.0 * 0.015, 1e-6, "0.01"),  # of the nominal authority
        ("qdot/de", -26.0 * 0.03, 1e-6, ""),
        ("qdot/de", -26.0 * 8.0, 1e-6, ""),
        ("qdot/de", -26.0 * 12.0, 1e-6, "authority"),
        ("qdot/de", 20.0, 1e-6, "turn its sign"),
        ("pdot/da", 0.0, 0.1, ""),  # the rudder rolls
    ],
)
def test_identified_rows_are_adopted_if_known_and_controllable(
    name: str, value: float, sigma: float, reason: str
) -> None:
    chosen, source = choice()
    source.add(changed(coefficients(0.5, LATER), name, value, sigma))
    effect, (row, column) = chosen.update(LATER, Effectiveness()), STRUCTURE.index(name)
    sources = ["identified"] * 3
    sources[row] = "nominal" if reason else "identified"
    assert effect.sources == tuple(sources)
    assert reason in effect.reasons[row]
    assert effect.values[2, 1] == pytest.approx(0.5 * -4.3)
    assert effect.values[row, column - INPUT_COLUMNS.start] == (-26.0 if reason else value)


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


def test_the_fixed_mode_never_changes_its_effect() -> None:
    chosen, source = choice(adaptive=False)
    source.add(coefficients(0.5, LATER))
    assert chosen.update(LATER, Effectiveness()).sources == ("nominal",) * 3


def manoeuvre(t: float) -> FloatArray:
    return np.array([0.2 * np.sin(2.0 * t), 0.1 * np.sin(1.3 * t), 0.05 * np.sin(1.7 * t)])


@pytest.mark.parametrize("surface", [0, 1, 2], ids=["elevator", "rudder", "aileron"])
def test_a_reversed_surface_is_controlled_by_its_measured_effect(surface: int) -> None:
    def effect(t: float) -> FloatArray:
        out = np.ones(4)
        out[surface] = 1.0 if t < 3.0 else -1.0
        return out

    axis = {0: 1, 1: 2, 2: 0}[surface]
    flying, _ = controller()
    rates = flown(flying, effect, manoeuvre, seconds=8.0, noise=0.005)
    assert flying.effect.sources[axis] == "measured"
    assert [s for i, s in enumerate(flying.effect.sources) if i != axis] == ["nominal"] * 2
    t = np.arange(len(rates)) * 0.01
    wanted = np.array([manoeuvre(s) for s in t])
    assert np.abs(rates - wanted)[600:].max() < 0.06  # rad/s, as before the fault
    fixed, _ = controller(adaptive=False)
    assert np.abs(flown(fixed, effect, manoeuvre, seconds=5.0, noise=0.005)).max() > 1.0


def turns(t: float) -> FloatArray:
    """Bank to alternate sides, smoothed like a pilot's inputs."""
    side = 1.0 if t % 4.0 < 2.0 else -1.0
    return np.array([0.3 * side * (1.0 - np.exp(-(t % 2.0) / 0.2)), 0.0, 0.0])


def test_a_halved_effect_is_measured_before_it_is_identified() -> None:
    def effect(t: float) -> FloatArray:
        return np.array([1.0, 1.0, 1.0 if t < 3.0 else 0.5, 1.0])

    flying, _ = controller()
    flown(flying, effect, turns, seconds=7.5, noise=0.005)
    assert flying.effect.sources == ("measured", "nominal", "nominal")
    assert flying.effect.values[0, 2] == pytest.approx(0.5 * 29.5, rel=0.25)


def lively(t: float) -> FloatArray:
    return turns(t) + 0.3 * manoeuvre(t)


@pytest.mark.parametrize(("steps", "speed"), [(0, 2.3), (6, 1.0), (8, 2.3)])
def test_a_wrong_delay_is_estimated_and_does_not_change_the_effect(
    steps: int, speed: float
) -> None:
    """The configured delay is two steps. Adaptation hardly increases the error."""
    wanted, errors = np.array([lively(0.01 * k) for k in range(1000)]), {}
    for adaptive in (False, True):
        flying, _ = controller(speed=speed, adaptive=adaptive)
        rates = flown(flying, 1.0, lively, 10.0, noise=0.005, delay_steps=steps)
        errors[adaptive] = np.sqrt(np.mean((rates - wanted)[600:] ** 2))
    assert errors[True] < 1.35 * errors[False]
    if steps == 8:
        assert flying.delay.delay == pytest.approx(0.08, abs=0.011)
        assert errors[True] < 0.3 * errors[False]  # the fixed loop oscillates
    assert (np.abs(flying.effect.share - 1.0) < 0.35).all()


@pytest.mark.parametrize(("delay_setting", "true"), [(6, 2), (6, 6)])
def test_too_long_a_delay_is_corrected_and_a_right_one_stays(delay_setting: int, true: int) -> None:
    flying, _ = controller(speed=1.5, delay_setting=delay_setting)
    flown(flying, 1.0, lively, 10.0, noise=0.005, delay_steps=true)
    assert flying.delay.delay == pytest.approx(0.01 * true, abs=0.011)
    assert (np.abs(flying.effect.share - 1.0) < 0.35).all()


@pytest.mark.parametrize(
    ("seed", "speed", "size", "noise"),
    [(5, 2.3, np.array([0.6, 0.3, 0.2]), 0.01), (3, 1.0, np.full(3, 0.25), 0.005)],
)
def test_gusts_and_noise_change_neither_the_delay_nor_the_measured_effect(
    seed: int, speed: float, size: FloatArray, noise: float
) -> None:
    """The inputs answer the gusts, which biases least squares."""
    rng, gust = np.random.default_rng(seed), np.zeros((1200, 3))
    for k in range(1, len(gust)):
        gust[k] = 0.97 * gust[k - 1] + size * rng.standard_normal(3)
    flying, _ = controller(speed=speed)
    shares: list[float] = []
    flown(
        flying, 1.0, turns, seconds=12.0, disturbance=gust, noise=noise,
        each=lambda _: shares.append(flying.effect.share[0]),
    )  # fmt: skip
    assert np.mean(np.abs(np.array(shares) - 1.0) < 0.25) > 0.9
    assert flying.delay.delay == pytest.approx(0.02)


def test_an_identified_row_that_contradicts_the_measured_effect_is_not_used() -> None:
    chosen, source, measured = with_measured_factor(0, 0.55)
    for seconds, share in ((0.0, 1.0), (0.2, 1.0), (0.4, 0.55)):  # a gust looks like it as long
        later = LATER + round(seconds * 1e9)
        assert chosen.update(later, measured).values[0, 2] == pytest.approx(share * 29.5)
    later = LATER + 10**9
    assert chosen.update(later, measured).values[0, 2] == pytest.approx(0.55 * 29.5)
    source.add(coefficients(1.0, later))  # identified before the fault
    effect = chosen.update(later, measured)
    assert effect.sources == ("measured", "identified", "identified")
    assert "0.55 times its effect" in effect.reasons[0]
    source.add(coefficients(0.5, later + 10**8))
    effect = chosen.update(later + 10**8, measured)
    assert effect.sources == ("identified",) * 3
    assert effect.values[0, 2] == pytest.approx(0.5 * 29.5)


def test_the_measured_effect_is_updated_as_its_sigma_falls() -> None:
    """The first measurement detects the change; later ones determine its size."""
    chosen, _, measured = with_measured_factor(0, 0.6, 0.13)
    later = LATER + 10**9
    assert chosen.update(later, measured).share[0] == pytest.approx(0.6)
    for since, sigma, seconds, share in [
        (0.55, 0.2, 0.1, 0.6), (0.5, 0.1, 0.1, 0.5), (0.52, 0.1, 0.1, 0.52), (0.9, 1.0, 1.0, 0.52),
        (0.56, 0.15, 0.2, 0.52), (0.56, 0.15, 0.6, 0.56),  # that in use has doubled after 3 s
    ]:  # fmt: skip
        measured.since[0], measured.since_sigma[0] = since, sigma
        later += round(seconds * 1e9)
        assert chosen.update(later, measured).share[0] == pytest.approx(share)


def test_the_lower_limit_of_the_effect_is_half_the_nominal_one() -> None:
    """The identified effect is no reference for the limit: its sigma may be a fifth."""
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
def test_an_oscillating_loop_with_too_small_an_effect_returns_to_the_row(
    moved: float, share: float
) -> None:
    """A gust had halved the effect; gyro noise may add 0.4 to the one measured on the motion."""
    chosen, _, measured = with_measured_factor(2, 0.5)
    assert chosen.update(LATER + 10**9, measured).share[2] == pytest.approx(0.5)
    measured.moved[2], measured.moved_sigma[2], measured.sigma[2] = moved, 0.1, 1.0
    chosen.update(LATER + 2 * 10**9, measured)
    assert chosen.update(LATER + 3 * 10**9, measured).share[2] == pytest.approx(share)


def test_least_squares_measures_the_effect_without_a_changing_reference() -> None:
    """The loop oscillates at a constant reference; the inputs have their full effect."""
    measured, rng = Effectiveness(), np.random.default_rng(0)
    for k in range(300):
        made = np.full(3, np.sin(0.02 * np.pi * k))
        measured.update(made + 0.1 * rng.standard_normal(3), made, 0.01, np.full(3, 1e-3))
    assert measured.moved == pytest.approx([1.0, 1.0, 1.0], abs=0.1)
    assert (measured.moved_sigma < 0.5 * measured.sigma).all()


def measure(
    measured: Effectiveness, seconds: float, size: float, effect: float, noise: float, seed: int = 0
) -> None:
    """Update the measured effect with turns of one size."""
    rng = np.random.default_rng(seed)
    for k in range(round(seconds / 0.01)):
        demanded = np.full(3, size * np.sin(0.05 * k))
        made = demanded + 0.1 * rng.standard_normal(3)
        measured.update(effect * made + noise * rng.standard_normal(3), made, 0.01, demanded)


def test_the_effect_since_a_change_is_measured_from_its_beginning_on() -> None:
    measured = Effectiveness()
    measure(measured, 20.0, 1.0, 1.0, 2.0)
    measure(measured, 2.1, 1.0, 0.5, 2.0, 1)
    measured.begin(np.array([True, True, False]))
    assert measured.since[:2].tolist() == measured.factor[:2].tolist()
    assert measured.since_sigma[:2].tolist() == measured.sigma[:2].tolist()
    measure(measured, 20.0, 1.0, 0.5, 2.0, 2)
    assert measured.since[:2] == pytest.approx([0.5] * 2, abs=0.15)
    assert measured.since[2] == pytest.approx(0.74, abs=0.15)  # half before it
    assert (measured.since_sigma < 0.6 * measured.sigma)[:2].all()
    measured.changed(0)
    measure(measured, 1.9, 1.0, 1.0, 2.0, 3)
    assert measured.since_sigma[0] > 100.0  # not measured yet
    measure(measured, 20.0, 1.0, 1.0, 2.0, 4)
    assert measured.since[0] == pytest.approx(1.0, abs=0.15)
    assert measured.since[1] < 0.9


def test_inputs_that_move_across_the_demand_do_not_spoil_the_next_measurement() -> None:
    """Their product with the demand is zero by chance: no size of the effect follows from it."""
    measured, rng = Effectiveness(), np.random.default_rng(0)
    for k in range(500):
        demanded, made = (np.full(3, f(0.02 * np.pi * k)) for f in (np.sin, np.cos))
        measured.update(made + 0.1 * rng.standard_normal(3), made, 0.01, demanded)
    measure(measured, 4.0, 1.0, 0.5, 0.05)
    assert measured.factor == pytest.approx([0.5] * 3, abs=0.1)
    assert (measured.sigma < 0.3).all()


@pytest.mark.parametrize("explains", [False, True])
def test_a_delay_replaces_a_reversal_only_if_it_explains_the_response(explains: bool) -> None:
    """The input is reversed; a delay of half a period explains the same response, or none."""
    measured = Effectiveness()
    for k in range(300):
        made = np.full(3, np.sin(0.1 * k))
        answered = made if k < 200 else -made
        late = answered if explains else 0.3 * made
        measured.update(answered, made, 0.01, rival=(answered, late))
    assert measured.reversed.all() == (not explains)
    assert (measured.sigma > 100.0).all()  # no other conclusion


def test_a_jerk_beyond_the_inputs_effect_does_not_reverse_it() -> None:
    """As of a breaking surface: it counts as the answer of a reversed input, small beside noise."""
    measured, rng = Effectiveness(), np.random.default_rng(0)
    made = np.full(3, 0.3)
    for k in range(330):
        answered = made + rng.standard_normal(3) if k < 300 else np.full(3, -20.0)
        measured.update(answered, made, 0.01)
    assert not measured.reversed.any()
    assert not measured.dead.any()


def test_the_sign_of_a_reversed_input_is_changed_on_all_axes() -> None:
    source = CoefficientSource(Fallback.LAST_GOOD, coefficients())
    chosen = AxisChoice(source, changed(coefficients(), "rdot/da", -2.0, 0.1), LIMITS)
    measured = Effectiveness()
    measured._log_ratio[0, 0] = CERTAIN
    assert chosen.update(LATER, measured).values[:, 2].tolist() == [-29.5, 0.0, 2.0]
    source.add(changed(coefficients(), "rdot/da", -2.0, 0.1))  # identified before the fault
    assert chosen.update(LATER, measured).values[:, 2].tolist() == [-29.5, 0.0, 2.0]
    turned = changed(coefficients(np.array([1.0, 1.0, -1.0, 1.0]), LATER), "rdot/da", 1.5, 0.1)
    source.add(turned)
    assert chosen.update(LATER, measured).values[0, 2] == -29.5
    source.add(dataclasses.replace(turned, t_ns=LATER + 10**8))
    assert chosen.update(LATER + 10**8, measured).values[:, 2].tolist() == [-29.5, 0.0, 1.5]


@pytest.mark.parametrize("reversals", [1, 2])
def test_a_dead_input_has_its_former_sign(reversals: int) -> None:
    """A jamming surface causes a jerk of the opposite sign, once or twice, and then none."""
    chosen, measured = choice()[0], Effectiveness()
    before = chosen.update(START, measured).values[:, 2].tolist()
    for _ in range(reversals):
        measured._log_ratio[0, 0] = CERTAIN
        chosen.update(LATER, measured)
    measured.dead[0] = True
    for _ in range(2):
        assert chosen.update(LATER, measured).values[:, 2].tolist() == before


@pytest.mark.parametrize(
    ("factor", "sigma", "rolls", "share", "source"),
    [
        (0.55, 0.1, True, 0.55, "measured"),
        (0.55, 0.1, False, 1.0, "nominal"),  # other axes of a tumbling aircraft
        (1.4, 0.1, True, 1.0, "nominal"),  # more effect needs twice the evidence
        (1.7, 0.1, True, 1.7, "measured"),
        (3.0, 0.1, True, 2.0, "measured"),
        (0.85, 0.02, True, 0.85, "nominal"),  # a change of less than a fifth is not reported
        (0.75, 0.02, True, 0.75, "measured"),
    ],
)
def test_a_significant_measured_effect_is_used_unless_the_aircraft_tumbles(
    factor: float, sigma: float, rolls: bool, share: float, source: str
) -> None:
    chosen, _, measured = with_measured_factor(1, factor, sigma)
    measured.dead[0] = not rolls
    effect = chosen.update(LATER + 10**9, measured)
    assert (effect.share[1], effect.sources[1]) == (pytest.approx(share), source)


# --- times and thresholds of the measured effect -----------------------------------------------


def test_the_effect_is_measured_over_two_seconds_20_times_a_second() -> None:
    """A second after the effect has halved, the mean of both is measured."""
    measured, seen = Effectiveness(), set()
    for k in range(1100):
        made = np.full(3, np.sin(0.02 * np.pi * k))
        measured.update(made * (1.0 if k < 1000 else 0.5), made, 0.01)
        seen |= {float(measured.factor[0])} if k >= 1000 else set()
    assert measured.factor == pytest.approx([0.75] * 3, abs=0.03)
    assert 16 <= len(seen) <= 21


def test_sigma_keeps_the_gusts_of_the_last_forty_seconds() -> None:
    measured, sigmas = Effectiveness(), []
    measured._age = 60.0  # or longer
    for k, (seconds, noise) in enumerate([(4.0, 20.0), (2.1, 0.0), (10.0, 0.0)]):
        measure(measured, seconds, 1.0, 1.0, noise, k)
        sigmas.append(float(measured.sigma[0]))
    assert sigmas[2] / sigmas[1] == pytest.approx(np.exp(-0.5 * 10.0 / 40.0), rel=0.03)


def test_without_noise_sigma_is_a_tenth() -> None:
    """The effect depends on the airspeed and on the deflection."""
    measured = Effectiveness()
    measure(measured, 5.0, 1.0, 1.0, 0.0)
    assert measured.sigma == pytest.approx([0.1] * 3)


def fault_time(answer: float, *, noise: float = 0.0, jolt: float = 0.0, calm: float = 0.0) -> float:
    """Return the time in which the steady answer to inputs of 1 rad/s^3 counts as a fault, s.

    With `noise`, that jerk is usual at the beginning. A `jolt` adds to it for a tenth of a second.
    Then the air is `calm`, s.
    """
    measured, made = Effectiveness(), np.ones(3)
    for k in range(1500 if noise else 0):
        measured.update(np.full(3, noise + jolt * (k >= 1490)), np.zeros(3), 0.01)
    for _ in range(round(calm / 0.01)):
        measured.update(np.zeros(3), np.zeros(3), 0.01)
    for k in range(500):
        measured.update(answer * made, made, 0.01)
        if measured.dead.all() or measured.reversed.all():
            return 0.01 * (k + 1)
    return np.inf


def test_a_fault_is_found_in_a_tenth_of_a_second_once_the_noise_is_known() -> None:
    """The noise is known after 0.7 s; a reversal takes 0.15 s."""
    assert fault_time(0.0) == pytest.approx(0.8, abs=0.025)
    assert fault_time(-1.0) == pytest.approx(0.85, abs=0.025)


def test_a_fault_in_noise_is_found_at_a_log_likelihood_ratio_of_22() -> None:
    """Independent samples come at half the filter's bandwidth; noise is forgotten in 3 s."""
    ratio = 15.0 / 2.0 * 2.0**2 / 2.0  # 1/s, of a reversed and the right effect
    for calm in (0.0, 3.0):
        expected = 3.0 * np.log(1.0 + 22.0 * np.exp(-calm / 3.0) / (3.0 * ratio))
        assert fault_time(-1.0, noise=1.0, calm=calm) == pytest.approx(expected, rel=0.05)


def test_a_sample_beyond_three_sigma_counts_as_three() -> None:
    """The jerk of a jamming aileron would hide for seconds that its effect is lost."""
    longer = fault_time(-1.0, noise=0.5, jolt=20.0) / fault_time(-1.0, noise=0.5)
    assert longer == pytest.approx(np.exp(0.1 * (3.0**2 - 1.0) / 3.0), rel=0.1)
