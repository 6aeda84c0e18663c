# SPDX-License-Identifier: Apache-2.0
"""The control laws on a linear aircraft: tracking, faults, gaps."""

from dataclasses import replace

import numpy as np
import pytest
from equations import matrix
from pid import PidController, PidGains
from plants import (
    DELAY_STEPS,
    DT_NS,
    FLOW,
    LIMITS,
    START,
    STEP,
    STRUCTURE,
    VALUES,
    a_sample_later,
    coefficients,
    controller,
    flown,
)

from uav_ident_ros.client import AttitudeModel, Coefficients, CoefficientSource, Fallback
from uav_ident_ros.control import LAWS, Gains, IncrementalLaw, InversionLaw, RateController
from uav_ident_ros.control.allocation import authority
from uav_ident_ros.control.controller import Law
from uav_ident_ros.control.laws import Smoother
from uav_ident_ros.control.sideslip import SIDESLIP_RATE, rolls_over, yaw_for_roll
from uav_ident_ros.identification.structure import INPUT_COLUMNS, STRUCTURES, FloatArray

BOTH = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)


@BOTH
def test_the_rates_follow_a_step_with_little_overshoot(law: Law) -> None:
    rates = flown(controller(law)[0])
    np.testing.assert_allclose(rates[-1], STEP, atol=2e-3)
    assert (rates.max(axis=0) < 1.15 * STEP).all()
    after_half_a_second = rates[100]
    assert (after_half_a_second[:2] > 0.85 * STEP[:2]).all()


@BOTH
def test_a_steady_disturbance_leaves_no_error(law: Law) -> None:
    rates = flown(controller(law)[0], reference=np.zeros(3), disturbance=(1.0, -0.5, 0.2))
    assert np.abs(rates).max() > 0.02
    np.testing.assert_allclose(rates[-1], 0.0, atol=2e-3)


@BOTH
@pytest.mark.parametrize("effect", [0.5, 1.6])
def test_the_loop_is_stable_with_another_effect_of_the_surfaces(law: Law, effect: float) -> None:
    """As with the last good set after a fault: wrong, but stable and without steady error."""
    rates = flown(controller(law, adaptive=False)[0], effect, seconds=8.0)
    np.testing.assert_allclose(rates[-1], STEP, atol=5e-3)
    assert (rates.max(axis=0) < 1.6 * STEP).all()


@BOTH
@pytest.mark.parametrize("lost", [0, 1, 2], ids=["elevator", "rudder", "aileron"])
def test_a_dead_surface_does_not_affect_the_other_axes(law: Law, lost: int) -> None:
    effect = np.ones(4)
    effect[lost] = 0.0
    rates = flown(controller(law, adaptive=False)[0], effect, seconds=5.0)
    axis = {0: 1, 1: 2, 2: 0}[lost]
    others = [i for i in range(3) if i != axis]
    np.testing.assert_allclose(rates[-1, others], STEP[others], atol=0.01)


def swaying(t: float) -> FloatArray:
    return STEP * np.sin(2.0 * t)


@pytest.mark.parametrize(("factor", "dead"), [(0.0, True), (0.5, False), (1.0, False)])
def test_a_dead_axis_is_distinguished_from_a_weak_one(factor: float, dead: bool) -> None:
    flying, _ = controller()
    flown(flying, np.array([1.0, 1.0, factor, 1.0]), swaying, seconds=4.0, noise=0.002)
    assert flying.effectiveness.dead.tolist() == [dead, False, False]


def test_a_repaired_surface_is_no_longer_dead() -> None:
    flying, _ = controller()
    found: list[bool] = []
    flown(
        flying, lambda t: np.array([1.0, 1.0, 0.0 if 3.0 <= t < 5.0 else 1.0, 1.0]), swaying,
        seconds=8.0, each=lambda _: found.append(bool(flying.effectiveness.dead[0])),
    )  # fmt: skip
    assert [found[k] for k in (299, 490, 799)] == [False, True, False]


def sideslipped(until: float, usable_from: float, bank: float = 0.1) -> FloatArray:
    """Return yaw rates less the reference, rad/s, with ailerons lost from 3 s to a time, s.

    From another time on, the verdict on the roll row is usable. The bank holds from 3.7 s on.
    """
    values = matrix(STRUCTURE, VALUES | {"pdot/beta": -14.0, "rdot/beta": 4.0})
    nominal = Coefficients(STRUCTURE, values, 0.02 * np.abs(values), t_ns=START)
    source = CoefficientSource(Fallback.LAST_GOOD, nominal)
    flying = RateController(source, nominal, LIMITS, DELAY_STEPS * DT_NS * 1e-9)
    dead: list[bool] = []

    def each(t_ns: int) -> None:
        t = (t_ns - START) * 1e-9
        flow = FLOW._replace(roll=bank if t > 3.7 else 0.1)
        rows = (t >= usable_from, True, True)
        source.add(replace(nominal, usable=False, usable_rows=rows, flow=flow, t_ns=t_ns))
        dead.append(bool(flying.effectiveness.dead[0]))

    def effect(t: float) -> FloatArray:
        return np.array([1.0, 1.0, 0.0 if 3.0 <= t < until else 1.0, 1.0])

    rates = flown(flying, effect, swaying, seconds=5.0, each=each)
    assert any(dead)
    return np.array([x[2] - swaying(k * DT_NS * 1e-9)[2] for k, x in enumerate(rates)])


def test_ailerons_that_answer_again_are_not_replaced_by_sideslip() -> None:
    """Their loss lasts half a second, and the aircraft would roll over at the rate after it."""
    assert np.abs(sideslipped(3.45, np.inf)[300:]).max() < 0.02  # as before


def test_rolling_by_sideslip_goes_on_if_the_roll_row_becomes_usable() -> None:
    """Dead ailerons at a stop look like a constant moment, which leaves their derivative usable."""
    assert np.abs(sideslipped(np.inf, 4.0, bank=0.9)[420:]).max() > 0.1  # rad/s


def test_yaw_for_roll_includes_the_dihedral_and_the_rudder_of_the_sideslip() -> None:
    structure = STRUCTURES["flight_dynamics"]
    assert yaw_for_roll(coefficients()) == 0.0  # sideslip does not roll this aircraft
    given = {"pdot/beta": -14.0, "pdot/dr": 3.0, "rdot/beta": 4.0, "rdot/dr": -4.0}
    values = matrix(structure, given)
    aircraft = Coefficients(structure, values, np.zeros_like(values))
    assert yaw_for_roll(aircraft) == pytest.approx(SIDESLIP_RATE / 11.0)
    values[structure.index("rdot/beta")] = -4.0  # directionally unstable
    assert yaw_for_roll(aircraft) == 0.0


def test_rolling_by_sideslip_keeps_the_rudder_off_its_stops() -> None:
    effect = coefficients().values[:3, INPUT_COLUMNS] * np.array([1.0, 1.0, 0.0, 1.0])
    scale = authority(effect, LIMITS) * np.array([1.0, 1.0, 0.5])  # half of the rudder's authority
    law, wanted = IncrementalLaw(LIMITS, scale), np.array([1.0, 0.0, 0.0])
    law.restart(np.zeros(3), wanted, np.zeros(4))
    u = law.update(0.01, effect, np.zeros(3), wanted, np.zeros(4), yaw_for_roll=-1.0)
    assert u[1] == pytest.approx(0.5 * LIMITS[1, 1], rel=0.1)


@pytest.mark.parametrize(
    ("bank", "p", "acceleration", "damping", "rolls"),
    [
        (0.5, 0.05, 0.0, -6.0, False),
        (0.5, -0.3, 0.0, -6.0, False),
        (0.2, 0.3, 0.0, -6.0, True),
        (0.2, 0.3, -1.8, -6.0, False),  # the damping stops the roll
        (0.0, 0.05, 1.8, -6.0, True),  # a jammed aileron, at its beginning
        (0.2, 0.3, -1.8, 0.0, True),  # the damping is unknown
    ],
)
def test_only_an_aircraft_that_rolls_over_is_rolled_by_sideslip(
    bank: float, p: float, acceleration: float, damping: float, rolls: bool
) -> None:
    assert rolls_over(bank, p, acceleration, damping) is rolls
    assert rolls_over(-bank, -p, -acceleration, damping) is rolls


@BOTH
@pytest.mark.parametrize("adaptive", [False, True])
def test_a_sample_or_reference_that_is_not_finite_moves_no_input(law: Law, adaptive: bool) -> None:
    flying, _ = controller(law, adaptive=adaptive)
    nan, later, excitation = np.array([np.nan, 0.0, 0.0]), START, np.array([0.0, 0.01, 0.0, 0.0])
    first = flying.inject(START - DT_NS, flying.update(START - DT_NS, nan, STEP), excitation)
    assert first.tolist() == excitation.tolist()
    before = flying.update(START, np.zeros(3), STEP)
    for x, wanted in ((nan, STEP), (np.zeros(3), nan), (np.full(3, np.inf), STEP)):
        later += DT_NS
        u = flying.update(later, x, wanted)
        assert u.tolist() == before.tolist()
        flying.inject(later, u, excitation)  # does not add up
    for _ in range(50):
        later += DT_NS
        assert np.isfinite(flying.update(later, np.zeros(3), STEP)).all()


def test_a_gap_keeps_the_inputs_that_hold_a_steady_disturbance() -> None:
    """A wrong trim needs constant inputs, during a gap of the Imu and after it."""
    flying, _ = controller(adaptive=False)
    push, x, u = np.array([3.0, -1.5, 0.4]), np.zeros(3), np.zeros(4)
    plant, held = coefficients().values, np.zeros(3)
    for k in range(500):
        if not 300 <= k < 320:
            u = flying.update(START + k * DT_NS, x, np.zeros(3))
        x = a_sample_later(x, u, plant, push)
        if k == 299:
            np.testing.assert_allclose(x, 0.0, atol=2e-3)
        held = np.maximum(held, np.abs(x)) if k > 300 else held
    assert (held < 0.01).all()


def test_new_coefficients_do_not_cause_a_step_of_the_rates() -> None:
    """Steady rates are held with coefficients of twice the effect, until the right ones arrive."""
    for law in LAWS.values():
        flying, source = controller(law)

        def give(t_ns: int, source: CoefficientSource = source) -> None:
            if t_ns > START + 6 * 10**9:
                source.add(coefficients(0.5, t_ns))

        rates = flown(flying, 0.5, seconds=6.2, each=give)
        assert np.abs(rates[602:612] - STEP).max() < 0.01


def test_pid_follows_and_stops_its_integrator_at_a_limit() -> None:
    gains = PidGains(
        forward=np.array([0.2, -0.2, -0.1]),
        proportional=np.array([0.15, -0.15, -0.5]),
        integral=np.array([0.3, -0.3, -0.5]),
        derivative=np.zeros(3),
    )
    limits = np.array([[-0.4, -0.3, -0.3, 0.0], [0.4, 0.3, 0.3, 0.0]])
    law, times = PidController(limits, gains), iter(range(START, START + 1200 * DT_NS, DT_NS))
    for _ in range(1000):
        u = law.update(next(times), np.zeros(3), np.array([3.0, 0.0, 0.0]))
    assert u[2] == 0.3 and u[0] == u[1] == u[3] == 0.0
    back = [law.update(next(times), np.array([0.3, 0.0, 0.0]), np.zeros(3))[2] for _ in range(200)]
    assert min(back) < 0.0  # it decreased at once, not after ten seconds of unwinding


def test_the_filter_is_exact_at_any_step() -> None:
    fine, coarse = Smoother(20.0, np.zeros(1)), Smoother(20.0, np.zeros(1))
    for _ in range(100):
        fine.update(np.ones(1), 0.001)
    coarse.update(np.ones(1), 0.1)
    np.testing.assert_allclose(fine.value, coarse.value, rtol=1e-9)
    np.testing.assert_allclose(fine.slope, coarse.slope, rtol=1e-9)
    w, d, t = 20.0, 0.8, 0.1
    wd = w * np.sqrt(1.0 - d**2)
    step = 1.0 - np.exp(-d * w * t) * (np.cos(wd * t) + d * w / wd * np.sin(wd * t))
    np.testing.assert_allclose(coarse.value, step, rtol=1e-12)


@pytest.mark.parametrize(("gap", "restarts"), [(0.08, False), (0.15, True)])
def test_only_a_gap_of_more_than_a_tenth_of_a_second_restarts_the_loop(
    gap: float, restarts: bool
) -> None:
    """A restarted loop does not differentiate a step of the reference within the gap."""
    flying, _ = controller(adaptive=False)
    for k in range(20):
        flying.update(START + k * DT_NS, np.zeros(3), np.zeros(3))
    t_ns = START + 19 * DT_NS + round(gap * 1e9)
    late = flying.update(t_ns, np.zeros(3), STEP)
    anew = controller(adaptive=False)[0].update(t_ns, np.zeros(3), STEP)
    assert np.allclose(late, anew, rtol=1e-3) == restarts


@pytest.mark.parametrize(("gap", "held"), [(0.8, True), (1.5, False)])
def test_the_last_inputs_hold_for_a_second_of_a_gap(gap: float, held: bool) -> None:
    """Later another controller may have flown the aircraft, and their trim is unknown."""
    flying, x = controller()[0], np.array([-1e-4, 0.0, 0.0])
    for k in range(50):
        last = flying.update(START + k * DT_NS, np.array([0.1, 0.0, 0.0]), np.zeros(3))
    assert last[2] < -0.05
    t_ns = START + 49 * DT_NS + round(gap * 1e9)
    late, anew = (made.update(t_ns, x, np.zeros(3)) for made in (flying, controller()[0]))
    np.testing.assert_allclose(late, last if held else anew, atol=1e-3 if held else 1e-12)


def test_the_sideslip_stops_a_roll_as_fast_as_the_yaw_loop() -> None:
    """``beta' = -r`` and ``p' = L beta``: the missing roll acceleration decays exponentially."""
    values = matrix(STRUCTURE, VALUES | {"pdot/beta": -14.0, "pdot/dr": 0.0, "rdot/beta": 4.0})
    yaw = yaw_for_roll(Coefficients(STRUCTURE, values, np.zeros_like(values)))
    wanted, beta, dt = 1.0, 0.0, 0.001
    for _ in range(500):
        beta -= dt * yaw * (wanted + 14.0 * beta)
    rate = IncrementalLaw.gains.rate[2]
    assert wanted + 14.0 * beta == pytest.approx(np.exp(-0.5 * rate), rel=0.01)


@pytest.mark.parametrize(("r", "turns_on"), [(-0.25, True), (-0.35, False)])
def test_rolling_by_sideslip_yaws_with_at_most_17_deg_per_second(r: float, turns_on: bool) -> None:
    effect = coefficients().values[:3, INPUT_COLUMNS]
    law, x = IncrementalLaw(LIMITS, authority(effect, LIMITS)), np.array([0.0, 0.0, r])
    law.restart(x, np.zeros(3), np.zeros(4))
    missing = np.array([2.0, 0.0, 0.0])  # a reference of the roll rate, five times in 1/s
    u = law.update(0.01, effect, x, missing, np.zeros(4), yaw_for_roll=-1.0)
    assert ((effect @ u)[2] < 0.0) == turns_on


def test_the_observer_finds_a_disturbance_with_the_bandwidth_and_in_yaw_with_half_of_it() -> None:
    """It is critically damped; the inputs that it asks for are not given to the aircraft here."""
    values = matrix(STRUCTURE, {"pdot/da": 29.5, "qdot/de": -26.0, "rdot/dr": -4.3})
    model = AttitudeModel(STRUCTURE, values, STRUCTURE.mask, FLOW)
    effect, push, dt = values[:3, INPUT_COLUMNS], np.array([1.0, 0.5, 0.2]), 0.001
    law = InversionLaw(LIMITS, authority(effect, LIMITS), Gains((0.0, 0.0, 0.0), bandwidth=8.0))
    law.restart(model, effect, np.zeros(3), np.zeros(3))
    for k in range(201):
        u = law.update(dt, model, effect, push * k * dt, np.zeros(3), np.zeros(4))
    phase = 0.2 * np.array([8.0, 8.0, 4.0])
    np.testing.assert_allclose(
        effect @ u, -push * (1.0 - np.exp(-phase) * (1.0 + phase)), rtol=0.02
    )
