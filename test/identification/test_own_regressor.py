# SPDX-License-Identifier: Apache-2.0
"""Regressors of the author's own, in identification, prediction, scaling and linearisation."""

from functools import cache

import numpy as np
import pytest
from equations import matrix, slope
from flying import identified, integrated, light_errors, light_measured, run, sent
from hypothesis import given
from hypothesis import strategies as st

from uav_ident_ros.client import AttitudeModel
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.flow import FlowState
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.prediction import (
    Flown,
    InputSignal,
    Published,
    score_windows,
    window_errors,
)
from uav_ident_ros.identification.settings import Settings, SettingsError
from uav_ident_ros.identification.speed import SpeedScaling
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray, Regressor, Structure
from uav_ident_ros.identification.waveforms import multisines

SOFT = Regressor("da|da|", lambda p, q, r, de, dr, da, dth: da * abs(da), 900.0)
DRAG = Regressor("q|q|", lambda p, q, r, de, dr, da, dth: q * abs(q), 30.0, power=0.0)
OWN = STRUCTURES["augmented"].extended("own", {"pdot": [SOFT], "qdot": [DRAG]})
FLIGHT = STRUCTURES["flight_dynamics"].extended("own_flight", {"qdot": [DRAG]})
TRUE = {
    "pdot/p": -6.0, "pdot/da": 40.0, "pdot/da|da|": -120.0, "rdot/r": -1.5, "rdot/dr": -8.0,
    "qdot/q": -3.0, "qdot/de": -25.0, "qdot/q|q|": -6.0,
}  # fmt: skip
DT, SECONDS = 0.01, 40.0


@pytest.fixture(autouse=True)
def named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(STRUCTURES, OWN.name, OWN)
    monkeypatch.setitem(STRUCTURES, FLIGHT.name, FLIGHT)


@cache
def flight() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times, s, inputs held from each on, and noise-free rates, of the true equations."""
    t = 10.0 + DT * np.arange(round(SECONDS / DT))
    u = multisines(t, 4, 20.0, (0.1, 2.0)) * (0.12, 0.15, 0.15, 0.0)
    return t, u, integrated(OWN, t, u, lambda _: matrix(OWN, TRUE))


@cache
def flown(structure: str) -> tuple[Estimate, ...]:
    t, u, x = flight()
    t_ns = np.round(t * 1e9).astype(np.int64).tolist()
    x = x + 0.005 * np.random.default_rng(1).standard_normal(x.shape)
    stream = [*sent("actuators", t_ns, u), *sent("rates", t_ns, x)]
    values = {"structure": structure, "imu.convention": "frd", "update_rate": 10.0}
    identifier = OnlineIdentifier(Settings.from_values(values))
    return tuple(run(identifier, sorted(stream, key=lambda sample: sample.t_ns)))


def test_own_regressors_are_identified_with_their_sigma() -> None:
    last = flown("own")[-1]
    for name, true in TRUE.items():
        value, sigma = (a[OWN.index(name)] for a in (last.coefficients, last.sigma))
        assert abs(value - true) < min(3.0 * sigma, 0.12 * abs(true)), name
    assert last.usable


def test_the_free_prediction_includes_own_regressors() -> None:
    t, u, x = flight()
    t_ns = np.round(t * 1e9).astype(np.int64)
    measured = Flown(t_ns, x, InputSignal(t_ns, u), np.zeros((len(t), 2)), np.zeros(3))
    fits = []
    for structure in (OWN, STRUCTURES["augmented"]):
        errors = window_errors(measured, Published.of(flown(structure.name), structure))
        scores = score_windows(errors, int(t_ns[0]), int(t_ns[-1]))
        fits.append(scores["last_40_percent"].model)
    with_own, without = fits
    assert (with_own > 95.0).all()
    assert (with_own - without)[:2].min() > 2.0


def test_own_regressors_leave_the_flow_angles_as_they_were() -> None:
    """On an aircraft without them they are zero, within three sigma."""
    measured = light_measured(40.0, rate=200.0)
    (_, (*_, last)), (_, (*_, before)) = (
        identified(measured, structure=name, update_rate=20.0)
        for name in (FLIGHT.name, "flight_dynamics")
    )
    where = FLIGHT.index("qdot/q|q|")
    assert abs(last.coefficients[where]) < 3.0 * last.sigma[where] < 3.0 * DRAG.sigma
    moved = np.abs(last.coefficients[:, :-1] - before.coefficients)[[0, 2, 3, 4]]
    assert (moved <= 0.1 * before.sigma[[0, 2, 3, 4]]).all()
    errors, sigmas = light_errors(last, "pdot/da", "qdot/de", "rdot/dr", "qdot/q", "qdot/alpha")
    assert errors.max() < 0.15
    assert sigmas.max() < 3.0


@given(seed=st.integers(0, 1000), structure=st.sampled_from((OWN, FLIGHT)))
def test_the_client_predicts_and_linearises_own_regressors(seed: int, structure: Structure) -> None:
    rng = np.random.default_rng(seed)
    a = structure.mask * rng.normal(0.0, 1.0, structure.mask.shape)
    flow = FlowState(0.03, 0.05, 0.0, 0.0, 0.2, 0.1, 20.0) if structure.has_flow else None
    model = AttitudeModel(structure, a, structure.mask, flow)
    x, u, dt = rng.normal(0.0, 0.5, 3), rng.normal(0.0, 0.3, 4), 1e-6
    ahead = (model.predict(x, u, dt) - x) / dt
    np.testing.assert_allclose(ahead, model.acceleration(x, u), atol=1e-4)
    by_x, by_u = model.linearize(x, u)
    slopes = slope(lambda at: model.acceleration(at[:3], at[3:]), np.array([*x, *u]))
    np.testing.assert_allclose(np.hstack((by_x[:3, :3], by_u[:3])), slopes, atol=1e-5)


def test_own_regressors_grow_with_their_power_of_the_airspeed() -> None:
    chosen = Settings.from_values({"airspeed.type": "std_msgs/msg/Float64", "structure": OWN.name})
    scaling = SpeedScaling(chosen.airspeed, OWN)
    scaling.samples.append(1, (2.0 * chosen.airspeed.reference,))
    scaling.samples.merge(1)
    scaling.update(1)
    assert scaling.scale[OWN.index("pdot/da|da|")] == 4.0
    assert scaling.scale[OWN.index("qdot/q|q|")] == 1.0


def test_a_structure_is_a_choice_once_it_has_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Settings.from_values({"structure": "own"}).structure == "own"
    monkeypatch.delitem(STRUCTURES, "own")
    with pytest.raises(SettingsError, match="'structure' is 'own': allowed are baseline"):
        Settings.from_values({"structure": "own"})


@pytest.mark.parametrize(
    ("base", "rows", "words"),
    [
        ("baseline", {"pdot": [SOFT]}, "'baseline' has no place for more regressors: take"),
        ("own", {"pdot": [SOFT]}, "'own' has no place for more"),
        ("augmented", {"ay": [SOFT]}, "'ay' is no moment row: pdot, qdot, rdot are"),
        ("augmented", {"pdot": [SOFT._replace(label="da")]}, "label of da is taken in 'augmented'"),
    ],
)
def test_an_extension_without_meaning_is_refused(
    base: str, rows: dict[str, list[Regressor]], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        STRUCTURES[base].extended("new", rows)
