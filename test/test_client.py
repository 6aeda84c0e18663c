# SPDX-License-Identifier: Apache-2.0
"""The client for controllers: messages as a model, inversion, and refusals."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from equations import AIRCRAFT, flight_equations, flown, matrix, slope
from estimates import as_message, estimate_of
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from uav_ident_ros.client import (
    AttitudeModel,
    Coefficients,
    CoefficientSource,
    Excitation,
    Fallback,
    MessageError,
    Refusal,
)
from uav_ident_ros.files.coefficients_file import save_coefficients
from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.flow import FlowState
from uav_ident_ros.identification.settings import EXCITATION_TIMEOUT, declarations
from uav_ident_ros.identification.structure import INPUTS, STRUCTURES, Structure

AUGMENTED = STRUCTURES["augmented"]
FLIGHT = STRUCTURES["flight_dynamics"]
SECOND = 10**9
START = 1_700_000_000 * SECOND


FLOW = FlowState(
    beta=0.03, alpha=-0.02, beta_sigma=0.003, alpha_sigma=0.002, roll=0.4, pitch=-0.1, airspeed=18.0
)


def message(
    structure: Structure = AUGMENTED, *, usable: bool = True, t_ns: int = START,
    sigma: dict[str, float] | None = None, **values: float
) -> Any:  # fmt: skip
    """Return a message of the identifier, as attributes; `pdot_da` is `pdot/da`."""
    entries = AIRCRAFT | {name.replace("_", "/"): value for name, value in values.items()}
    spread = 0.01 * structure.mask
    for name, value in (sigma or {}).items():
        spread[structure.index(name)] = value
    estimate = estimate_of(
        matrix(structure, entries), spread, t_ns=t_ns, usable=usable,
        usable_rows=(True, usable, True), fit=np.array([90.0, 80.0, 85.0]),
        flow=FLOW if structure.has_flow else None,
    )  # fmt: skip
    return as_message(estimate, structure)


def model(structure: Structure = AUGMENTED, **changes: Any) -> AttitudeModel:
    source = CoefficientSource(Fallback.REFUSE)
    source.take(message(structure, **changes))
    return source.model(START)


# --- the message ------------------------------------------------------------------------------


def test_a_message_becomes_named_values() -> None:
    read = Coefficients.from_message(message(sigma={"pdot/da": 0.5}))
    assert read.structure is AUGMENTED
    assert read.names == AUGMENTED.names
    np.testing.assert_array_equal(read.values, matrix(AUGMENTED, AIRCRAFT))
    assert read.sigma[AUGMENTED.index("pdot/da")] == 0.5
    assert (read.usable, read.usable_rows, read.flow) == (True, (True, True, True), None)
    unusable = Coefficients.from_message(message(usable=False))
    assert (unusable.usable, unusable.usable_rows) == (False, (True, False, True))
    assert read.t_ns == START
    assert read.age(START + SECOND // 2) == 0.5
    assert read.fit is not None and read.fit.tolist() == [90.0, 80.0, 85.0]


def put(field: str, index: int | str, value: Any) -> Any:
    """Return a function that sets an entry of a message's field, by index or name."""

    def spoil(wrong: Any) -> None:
        at = index if isinstance(index, int) else wrong.name.index(index)
        getattr(wrong, field)[at] = value

    return spoil


@pytest.mark.parametrize(
    ("structure", "spoil", "reason"),
    [
        (AUGMENTED, lambda m: m.position.pop(), "33 names, 32 positions"),
        (AUGMENTED, put("name", 0, "pdot/beta"), "no known structure"),
        (AUGMENTED, put("name", -1, "verdict"), "no known structure"),
        (AUGMENTED, lambda m: [f.pop() for f in (m.name, m.position, m.effort)], "usable/rdot"),
        (AUGMENTED, put("position", 3, math.nan), "not finite"),
        (AUGMENTED, put("effort", 3, -1.0), "negative"),
        # impossible states
        (FLIGHT, put("position", "state/airspeed", math.nan), "state"),
        (FLIGHT, put("position", "state/airspeed", -20.0), "state"),
        (FLIGHT, put("position", "state/roll", math.inf), "state"),
    ],
)
def test_an_invalid_message_is_refused_and_the_last_one_stays(
    structure: Structure, spoil: Any, reason: str
) -> None:
    wrong = message(structure)
    spoil(wrong)
    source = CoefficientSource(Fallback.REFUSE)
    source.take(message(t_ns=START - SECOND // 20))
    with pytest.raises(MessageError, match=reason):
        source.take(wrong)
    assert source.model(START).t_ns == START - SECOND // 20  # the earlier message stays


def test_a_coefficient_is_known_by_t_ratio_or_if_surely_small() -> None:
    known = Coefficients.from_message(
        message(sigma={"qdot/de": 9.0, "rdot/da": 0.2, "pdot/pq": 0.5, "pdot/dr": 2.0})
    ).known
    assert not known[AUGMENTED.index("qdot/de")]  # value 26, sigma 9
    assert known[AUGMENTED.index("rdot/da")]  # value 0.2, sigma 0.2, rudder 2.4
    assert not known[AUGMENTED.index("pdot/pq")]
    assert known[AUGMENTED.index("pdot/dr")]  # value 3.1, sigma 2, aileron 29.5
    assert known[~AUGMENTED.mask].all()
    other = Coefficients.from_message(message(sigma={"qdot/de": 8.0, "pdot/dr": 4.0})).known
    assert other[AUGMENTED.index("qdot/de")]  # value 26, sigma 8
    assert not other[AUGMENTED.index("pdot/dr")]  # value 3.1, sigma 4, aileron 29.5


# --- the model --------------------------------------------------------------------------------


def test_prediction_agrees_with_a_fine_integration() -> None:
    x, u = np.array([0.6, -0.3, 0.4]), np.array([0.05, -0.1, 0.08, 0.2])
    force = np.array([0.5, -9.6])
    flying = model()
    fine = solve_ivp(lambda _, v: flying.acceleration(v, u, force), (0.0, 0.5), x, rtol=1e-9)
    np.testing.assert_allclose(flying.predict(x, u, 0.5, force), fine.y[:, -1], atol=1e-6)


def test_prediction_resolves_a_mode_of_30_rad_per_second() -> None:
    fast = model(pdot_p=-30.0, **{name: 0.0 for name in ("pdot_pq", "pdot_r", "pdot_q")})
    p = fast.predict(np.array([1.0, 0.0, 0.0]), np.zeros(4), 0.1)[0]
    assert p == pytest.approx(math.exp(-3.0), rel=2e-3)


def test_without_forces_the_force_terms_and_the_constant_are_omitted() -> None:
    x, u = np.array([0.1, 0.2, 0.0]), np.zeros(4)
    qdot = model().acceleration(x, u)[1]
    assert qdot == pytest.approx(-5.5 * 0.2)
    with_force = model().acceleration(x, u, np.array([0.0, -9.0]))[1]
    assert with_force == pytest.approx(-5.5 * 0.2 + 1.8 - 0.2 * 9.0)


# --- the model with angle of attack and sideslip -------------------------------------------------


FLYING = model(FLIGHT)
STATE = np.array([0.3, -0.2, 0.1, 0.05, -0.04])
CONTROL = np.array([0.05, -0.1, 0.08, 0.2])


def test_acceleration_with_flow_angles_is_that_of_the_rows() -> None:
    expected = flight_equations(FLYING.values, np.array([*STATE, 0.0, 0.0]), CONTROL, 18.0)[:3]
    np.testing.assert_allclose(FLYING.acceleration(STATE, CONTROL), expected, atol=1e-12)
    # by default the flow angles are those of the message
    at_message = np.array([*STATE[:3], FLOW.beta, FLOW.alpha])
    np.testing.assert_array_equal(
        FLYING.acceleration(STATE[:3], CONTROL), FLYING.acceleration(at_message, CONTROL)
    )
    many = np.stack([STATE, 2.0 * STATE])
    np.testing.assert_allclose(
        FLYING.acceleration(many, CONTROL)[1], FLYING.acceleration(many[1], CONTROL)
    )


def test_prediction_with_flow_angles_follows_from_the_message_alone() -> None:
    start = np.array([*STATE, FLOW.roll, FLOW.pitch])
    solution = flown(FLYING.values, start, CONTROL, FLOW.airspeed, 2.0)
    np.testing.assert_allclose(FLYING.predict(STATE, CONTROL, 2.0), solution[:5], atol=1e-6)
    three = FLYING.predict(STATE[:3], CONTROL, 0.5)
    whole = FLYING.predict(np.array([*STATE[:3], FLOW.beta, FLOW.alpha]), CONTROL, 0.5)
    np.testing.assert_array_equal(three, whole[:3])
    many = FLYING.predict(np.stack([STATE, 0.5 * STATE]), CONTROL, 0.5)
    np.testing.assert_allclose(many[0], FLYING.predict(STATE, CONTROL, 0.5), atol=1e-12)


def test_linearisation_with_flow_angles_is_the_derivative() -> None:
    at, a = np.array([*STATE, FLOW.roll, FLOW.pitch, *CONTROL]), FLYING.values
    expected = slope(lambda x: flight_equations(a, x[:7], x[7:], FLOW.airspeed), at)[:6]
    found = np.hstack(FLYING.linearize(STATE, CONTROL))
    np.testing.assert_allclose(found, np.delete(expected, 6, axis=1), atol=1e-6)


def test_a_model_from_a_file_needs_flow_angles_for_prediction(tmp_path: Any) -> None:
    path = tmp_path / "coefficients.yaml"
    values = FLYING.values
    save_coefficients(CoefficientSet("flight_dynamics", values, 0.01 * np.abs(values)), path)
    read = Coefficients.from_file(path)
    assert read.structure is FLIGHT
    np.testing.assert_array_equal(read.values, values)
    from_file = CoefficientSource(Fallback.NOMINAL, read).model(START)
    np.testing.assert_array_equal(
        from_file.acceleration(STATE, CONTROL), FLYING.acceleration(STATE, CONTROL)
    )
    for requested in (
        lambda: from_file.acceleration(STATE[:3], CONTROL),
        lambda: from_file.predict(STATE, CONTROL, 0.1),
        lambda: from_file.linearize(STATE, CONTROL),
    ):
        with pytest.raises(Refusal, match="needs 'flow'"):
            requested()


# --- inversion --------------------------------------------------------------------------------

LIMITS = np.array([[-0.4, -0.3, -0.3, 0.0], [0.4, 0.3, 0.3, 1.0]])
ACCELERATIONS = st.tuples(*[st.floats(-5.0, 5.0)] * 3)


@pytest.mark.parametrize("structure", [AUGMENTED, FLIGHT], ids=lambda s: s.name)
@given(wanted=ACCELERATIONS, x=st.tuples(*[st.floats(-1.0, 1.0)] * 3))
def test_inversion_reaches_the_acceleration_or_names_the_limited_inputs(
    structure: Structure, wanted: tuple[float, ...], x: tuple[float, ...]
) -> None:
    flying = model(structure)
    answer = flying.invert(np.array(wanted), np.array(x), LIMITS)
    assert (answer.u >= LIMITS[0]).all()
    assert (answer.u <= LIMITS[1]).all()
    got = flying.acceleration(np.array(x), answer.u)
    np.testing.assert_allclose(answer.acceleration, got, atol=1e-9)
    if not answer.limited:
        np.testing.assert_allclose(got, wanted, atol=1e-9)


def test_inversion_has_least_inputs_and_compensates_for_a_limited_one() -> None:
    # Throttle and aileron have equal roll effect: half each.
    shared = model(pdot_dth=29.5, pdot_dr=0.0, rdot_da=0.0)
    wanted, inputs = np.array([5.9, 0.0, 0.0]), ("de", "dr", "da", "dth")
    u = shared.invert(wanted, np.zeros(3), inputs=inputs).u
    np.testing.assert_allclose(u, [0.0, 0.0, 0.1, 0.1], atol=1e-12)
    limit = np.array([0.4, 0.3, 0.05, 1.0])
    answer = shared.invert(wanted, np.zeros(3), np.array([-limit, limit]), inputs=inputs)
    assert answer.acceleration[0] == pytest.approx(5.9)
    assert -0.05 <= answer.u[2] <= 0.05
    limit[3] = 0.02
    short = shared.invert(wanted, np.zeros(3), np.array([-limit, limit]), inputs=inputs)
    assert short.limited == ("da", "dth")
    np.testing.assert_allclose(short.u, [0.0, 0.0, 0.05, 0.02], atol=1e-12)


def test_the_force_of_an_input_adds_to_its_control_derivative() -> None:
    forces = np.zeros((2, 4))
    forces[0, 1] = 5.5  # ay of the rudder, m/s^2 per rad
    wanted, inputs = np.array([0.0, 0.0, 1.0]), ("de", "dr", "da")
    flying = model(pdot_dr=0.0, pdot_ay=0.0)
    u = flying.invert(wanted, np.zeros(3), input_forces=forces, inputs=inputs).u
    assert u[1] == pytest.approx(1.0 / (-2.4 - 0.35 * 5.5))


def test_inversion_is_refused_by_input_without_known_effect() -> None:
    unknown = model(sigma={"rdot/dr": 5.0, "pdot/dr": 50.0})
    assert set(unknown.left_out) >= {"rdot/dr", "pdot/dr"}
    with pytest.raises(Refusal, match="dr not identified"):
        unknown.invert(np.ones(3), np.zeros(3))


def test_inversion_needs_a_hundredth_of_the_largest_effect_in_every_direction() -> None:
    weak, weaker = (
        model(pdot_da=29.5, rdot_dr=-29.5 * share, rdot_da=0.0, pdot_dr=0.0)
        for share in (0.015, 0.008)
    )
    assert weak.invert(np.ones(3), np.zeros(3)).acceleration == pytest.approx(np.ones(3))
    with pytest.raises(Refusal, match="nothing moves rdot by itself"):
        weaker.invert(np.ones(3), np.zeros(3))


# --- which coefficients -----------------------------------------------------------------------


def nominal(**values: float) -> Coefficients:
    return Coefficients.from_message(message(**values))


def da(source: CoefficientSource, t_ns: int = START) -> tuple[str, float] | str:
    """Return the source of the model in use and its pdot/da, or the reason of a refusal."""
    try:
        chosen = source.model(t_ns)
    except Refusal as refusal:
        return str(refusal)
    return chosen.source, float(chosen.values[AUGMENTED.index("pdot/da")])


@pytest.mark.parametrize("fallback", Fallback)
def test_absent_unusable_and_old_coefficients_are_replaced_or_refused(fallback: Fallback) -> None:
    """The last good set is the nominal one until a message is usable."""
    source, refused = CoefficientSource(fallback, nominal(pdot_da=25.0)), fallback.value == "refuse"
    first = ("nominal", 25.0)
    kept = ("last good", 29.5) if fallback is Fallback.LAST_GOOD else first
    unusable, old = "the identifier's verdict is 'not usable'", "the coefficients are more than 0.5"
    assert da(source) == ("there are no coefficients yet" if refused else first)
    source.take(message(usable=False))
    assert da(source) == (unusable if refused else first)
    source.take(message(t_ns=START + 1))
    assert da(source, START + 1) == ("identified", 29.5)
    source.take(message(t_ns=START + 2, usable=False, pdot_da=10.0))
    assert da(source, START + 2) == (unusable if refused else kept)
    assert da(source, START + 9 * SECOND) == (f"{old} s old" if refused else kept)


def test_a_nominal_fallback_needs_a_nominal_set() -> None:
    with pytest.raises(ValueError, match="needs the nominal coefficients"):
        CoefficientSource(Fallback.NOMINAL)


def test_the_fallback_has_the_newest_angles_and_the_airspeed_of_its_coefficients() -> None:
    good = Coefficients.from_message(message(FLIGHT))
    source = CoefficientSource(Fallback.LAST_GOOD, replace(good, flow=None))
    turned = FLOW._replace(beta=-0.05, alpha=0.1, roll=-0.6, pitch=0.2, airspeed=25.0)
    source.add(replace(good, usable=False, flow=turned))
    assert source.model(START).flow == turned, "the file of a nominal set has none"
    source.add(good)
    assert source.model(START).flow == FLOW
    source.add(replace(good, usable=False, flow=turned))
    assert source.model(START).source == "last good"
    assert source.model(START).flow == turned._replace(airspeed=FLOW.airspeed)


def test_an_unknown_coefficient_is_zero_or_replaced_by_the_nominal() -> None:
    unknown = {"pdot/da": 20.0, "qdot/pr": 5.0}
    for fallback in Fallback:
        source = CoefficientSource(fallback, nominal(pdot_da=25.0))
        source.take(message(sigma=unknown))
        chosen, refused = source.model(START), fallback is Fallback.REFUSE
        assert da(source) == ("identified", 0.0 if refused else 25.0)
        assert ("pdot/da" in chosen.left_out) == refused
        assert ("pdot/da" in chosen.replaced) != refused


def test_the_last_known_value_is_kept_for_each_coefficient() -> None:
    source = CoefficientSource(Fallback.LAST_GOOD)
    source.take(message())
    assert da(source) == ("identified", 29.5)
    for k in range(1, 4):  # the value stays in use while its sigma remains large
        lost = message(sigma={"pdot/da": 50.0}, t_ns=START + k, qdot_de=-20.0 - k)
        source.take(lost)
        assert da(source, START + k) == ("identified", 29.5)
        assert source.model(START + k).values[AUGMENTED.index("qdot/de")] == -20.0 - k


def test_sigma_and_age_apply_without_the_verdict() -> None:
    source = CoefficientSource(Fallback.LAST_GOOD, nominal(pdot_da=25.0), use_verdict=False)
    source.take(message(usable=False, pdot_da=15.0))
    assert da(source) == ("identified", 15.0)
    source.take(message(usable=False, t_ns=START + 1, sigma={"pdot/da": 20.0}))
    assert da(source, START + 1) == ("identified", 15.0)
    assert da(source, START + 2 * SECOND) == ("last good", 15.0)


def test_a_source_with_delay_returns_only_older_coefficients() -> None:
    source = CoefficientSource(Fallback.REFUSE, delay=0.3)
    for k in range(10):
        source.take(message(t_ns=START + k * SECOND // 20))
    assert source.model(START + 400_000_000).t_ns == START + 100_000_000
    assert source.refusal(START + 290_000_000) == "there are no coefficients yet"
    assert "of a later time" in source.refusal(START - 1), "another clock than the Imu's"


# --- excitation --------------------------------------------------------------------------------

MS = 1_000_000
NAMES = list(INPUTS)
LEAD_AND_RATE = ("update_rate", "excitation.lead")


@pytest.fixture
def excitation() -> Excitation:
    return Excitation(limit=[0.1, 0.1, 0.1, 0.0])


def test_an_excitation_holds_from_its_stamp_until_the_next_or_timeout(
    excitation: Excitation,
) -> None:
    assert not excitation.at(10**9).any(), "there is no excitation yet"
    excitation.add(100 * MS, NAMES, [0.01, 0.0, 0.0, 0.0])
    excitation.add(150 * MS, NAMES, [0.02, 0.0, 0.0, 0.0])
    wanted = {99: 0.0, 100: 0.01, 149: 0.01, 150: 0.02, 200: 0.02}
    assert {t: excitation.at(t * MS)[0] for t in wanted} == wanted
    last = 150 * MS + round(EXCITATION_TIMEOUT * 1e9)
    assert excitation.at(last).any()
    assert not excitation.at(last + 1).any()


def test_the_longest_lead_at_the_highest_rate_is_kept(excitation: Excitation) -> None:
    rate, lead = (setting.high for setting in declarations() if setting.name in LEAD_AND_RATE)
    for k in range(1, round(rate * lead) + 2):
        excitation.add(round(k * 1000 / rate) * MS, NAMES, [0.05] * 4)
    assert excitation.at(round(1000 / rate) * MS).any()


def test_an_abort_cancels_the_scheduled_excitation(excitation: Excitation) -> None:
    for k in range(5):
        excitation.add((100 + 50 * k) * MS, NAMES, [0.05] * 4)
    excitation.add(170 * MS, NAMES, [0.0] * 4)
    assert excitation.at(169 * MS).any()
    assert not any(excitation.at(t * MS).any() for t in range(170, 600))


def test_the_excitation_is_limited_and_zero_on_inputs_without_a_name(
    excitation: Excitation,
) -> None:
    excitation.add(0, NAMES, [5.0, -5.0, 0.05, 5.0])
    assert excitation.at(0).tolist() == [0.1, -0.1, 0.05, 0.0]
    excitation.add(1, ["da", "de"], [0.02, 0.03])
    assert excitation.at(1).tolist() == [0.03, 0.0, 0.02, 0.0]


def test_a_wrong_message_sets_the_excitation_to_zero(excitation: Excitation) -> None:
    for k, (names, values) in enumerate(
        ((["de", "flap"], [0.05, 0.05]), (["de"], [math.nan]), (["de"], [math.inf]),
         (["de", "da"], [0.05]))
    ):  # fmt: skip
        excitation.add((100 + 20 * k) * MS, NAMES, [0.05] * 4)
        excitation.add((110 + 20 * k) * MS, names, values)
        assert not excitation.at((115 + 20 * k) * MS).any(), names
