# SPDX-License-Identifier: Apache-2.0
"""The estimators on plants with known coefficients."""

import numpy as np
import pytest
from flying import AMPLITUDES, DOMINANT, identified, linear_names, measured, since, worst_error

from uav_ident_ros.identification.estimators.estimator import SecondEstimator
from uav_ident_ros.identification.estimators.information import Information
from uav_ident_ros.identification.estimators.recursive import RecursiveRegression
from uav_ident_ros.identification.prior import start_from
from uav_ident_ros.identification.regression import Regression, RowSamples, layout
from uav_ident_ros.identification.rigid_body import product_coefficients
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import STRUCTURES, FloatArray
from uav_ident_ros.simulation.inputs import ColouredNoise, Segment
from uav_ident_ros.simulation.plant import SMALL_UAV

STRUCTURE = "throttle_coupled"
BOTH = pytest.mark.parametrize("estimator", ["least_squares", "instrumental_variable"])


def excitation(times: float) -> tuple[Segment, ...]:
    amplitudes = {name: times * peak for name, peak in AMPLITUDES.items()}
    return (Segment("multisine", amplitudes=amplitudes, seed=1),)


def test_the_papers_law_converges_to_the_true_coefficients() -> None:
    # Persistent excitation, strong enough for the rate products, without noise.
    m = measured(40.0, noise=0.0, segments=excitation(3.0))
    own = {"estimator": "gradient", "gradient__gains": (6.0,) * 12}
    found = identified(m, structure=STRUCTURE, **own)[1][-1].coefficients
    assert worst_error(found, m.flight, STRUCTURES[STRUCTURE].names) < 0.02


@BOTH
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_the_coefficients_are_those_of_the_plant(estimator: str, noise: float) -> None:
    """Without noise all linear coefficients are; with noise the dominant ones, within 5 %."""
    m = measured(30.0, noise)
    identifier, (*_, last) = identified(m, structure=STRUCTURE, estimator=estimator)
    names, limit = (DOMINANT, 0.05) if noise else (linear_names(m.flight), 0.005)
    assert worst_error(last.coefficients, m.flight, names) < limit
    if not noise:  # one value holds for a range of speeds, which a linear plant does not show
        places = tuple(zip(*map(identifier.structure.index, DOMINANT), strict=True))
        ratio = last.sigma[places] / np.abs(last.coefficients[places])
        np.testing.assert_allclose(ratio, 0.03, rtol=0.01)


def test_gusts_bias_least_squares_but_not_the_instrumental_variables() -> None:
    m = measured(40.0, 0.03, gusts=ColouredNoise(1.0, 0.3))

    def error(estimator: str) -> float:
        _, estimates = identified(m, structure=STRUCTURE, estimator=estimator)
        found = estimates[-1].coefficients
        return worst_error(found, m.flight, ("pdot/p", "pdot/da", "qdot/de"))

    by_instruments = error("instrumental_variable")
    assert by_instruments < 0.1
    assert error("least_squares") > 2.0 * by_instruments


@BOTH
def test_a_model_error_of_the_input_is_one_of_its_whole_row(estimator: str) -> None:
    """Damping makes up for an input that is late: both are too small, and so is all of the row."""
    identifier, (*_, last) = identified(measured(20.0), structure=STRUCTURE, estimator=estimator)
    regression = identifier.estimator
    assert isinstance(regression, RecursiveRegression)
    regression._error.share = np.array([0.2, 0.0, 0.0])
    regression._since_sigma = np.inf
    regression._solve()
    wider = np.sqrt(np.maximum(regression.sigma**2 - last.sigma**2, 0.0))
    expected = np.abs(last.coefficients) * np.array([[0.2], [0.0], [0.0]])
    np.testing.assert_allclose(wider, expected, rtol=0.01, atol=0.01)


@BOTH
def test_sigma_covers_the_error(estimator: str) -> None:
    """Pooled over a few flights in gusts; the campaign uses hundreds."""
    ratios = []
    for seed in range(3):
        m = measured(20.0, 0.03, gusts=ColouredNoise(0.3, 0.3), seed=seed)
        assert m.flight.coefficients is not None
        identifier, (*_, last) = identified(m, structure=STRUCTURE, estimator=estimator)
        free = identifier.structure.mask
        ratios.append(np.abs(last.coefficients - m.flight.coefficients)[free] / last.sigma[free])
    pooled = np.concatenate(ratios)
    assert 0.5 < (pooled < 1.0).mean() < 0.95
    assert (pooled < 2.0).mean() > 0.85


def test_known_inertias_fix_the_rate_products_and_fixed_ones_have_no_sigma() -> None:
    body, names = SMALL_UAV.inertia, ("pdot/dth", "rdot/dth")
    assert body is not None
    m = measured(8.0)
    known = {"model__inertia": (body.ix, body.iy, body.iz, body.ixz), "fixed_coefficients": names}
    identifier, (*_, last) = identified(m, structure=STRUCTURE, **known)
    np.testing.assert_array_equal(last.coefficients[:, :5], product_coefficients(body))
    for name in names:
        place = identifier.structure.index(name)
        assert (last.coefficients[place], last.sigma[place]) == (0.0, 0.0)


PAPER = {
    "structure": STRUCTURE,
    "estimator": "gradient",
    "filter__method": "backward_difference",
    "gradient__normalisation": "none",
    "gradient__gains": (10776.8,) * 5 + (3.282806,) * 6 + (0.001,),
    "model__leak_time": 0.0,
}


@pytest.mark.parametrize("step", ["euler", "guarded"])
def test_a_diverging_euler_step_is_a_fault_and_stays_finite(step: str) -> None:
    m = measured(12.0, segments=excitation(6.0))
    _, estimates = identified(m, **PAPER, gradient__step=step)
    assert all(np.isfinite(e.coefficients).all() for e in estimates)
    assert (estimates[-1].state == "fault") == (step == "euler")
    assert ("gradient.gains" in estimates[-1].reason) == (step == "euler")


def information_of(f: FloatArray, y: FloatArray) -> Information:
    """Information of samples, 50 ms apart, with a correlation time of 0.1 s."""
    structure, places = STRUCTURES["augmented"], layout(STRUCTURES["augmented"])
    start = start_from(Settings.from_values({"structure": "augmented"}))
    information = Information(structure, start, 0.1)
    samples = RowSamples.of(Regression.of(y, f, f, 0.05), y, places)
    information.add([samples], np.ones(places.rows))
    return information


@pytest.mark.parametrize("dt", [0.02, 0.05, 0.1])
def test_a_second_estimator_learns_every_second(dt: float) -> None:
    """Ten parts of 0.1 s are a second, though their sum rounds below it before Python 3.12."""
    settings, rng = Settings.from_values({"structure": "augmented"}), np.random.default_rng(1)
    own = RecursiveRegression(start_from(settings), settings, instrumental=False)
    second = SecondEstimator(own)
    count, learns = round(0.1 / dt), []
    for _ in range(30):
        y, f = rng.normal(size=(count, 3)), rng.normal(size=(count, 15))
        learns.append(second.add(Regression.of(y, f, f, dt), np.ones(3)))
    assert np.flatnonzero(learns).tolist() == [9, 19, 29]


@pytest.mark.parametrize(("correlation", "named"), [(0.0, False), (0.965, False), (0.975, True)])
def test_inputs_that_correlate_by_97_percent_are_named(correlation: float, named: bool) -> None:
    """As by an interconnect; the smaller eigenvalue of the correlations is 1 minus it."""
    structure, chance = STRUCTURES["augmented"], np.random.default_rng(1)
    f = chance.normal(size=(20_000, structure.size))
    rudder, aileron = structure.column("dr"), structure.column("da")
    f[:, rudder] *= np.sqrt(1.0 - correlation**2)
    f[:, rudder] += correlation * f[:, aileron]
    found = information_of(f, chance.normal(size=(len(f), 3)))
    assert found.collinear() == [(f"{row}/dr", f"{row}/da") for row in ("pdot", "rdot") if named]
    separable = 1.0 - correlation**2
    np.testing.assert_allclose(found.excitation(), [separable, 1.0, separable], rtol=0.05)


def test_the_first_residual_variance_is_that_of_noise_of_0_3_rad_s2() -> None:
    """With as much information as the prior, half of the aileron's effect is estimated."""
    structure, start = STRUCTURES["augmented"], start_from(Settings())
    place, effect = structure.index("pdot/da"), 40.0
    needed = 0.3**2 * 0.1 / start.sigma[STRUCTURES["flight_dynamics"].index("pdot/da")] ** 2
    f, y = np.zeros((4, structure.size)), np.zeros((4, 3))
    f[:, place[1]] = np.sqrt(needed / (4 * 0.05))
    y[:, 0] = effect * f[:, place[1]]
    information = information_of(f, y)
    found = information.solve(information.start.values).values[0][place]
    assert found == pytest.approx(0.5 * effect, rel=0.05)


@pytest.mark.parametrize(("forgetting_time", "low", "high"), [(0.0, 0.8, 1.2), (5.0, 1.3, 3.0)])
def test_the_sigma_of_resting_inputs_grows_only_with_forgetting(
    forgetting_time: float, low: float, high: float
) -> None:
    """Rudder and throttle rest from 20 s on; the other coefficients stay as well known."""
    still = {name: peak for name, peak in AMPLITUDES.items() if name in ("de", "da")}
    segments = (
        Segment("multisine", duration=20.0, amplitudes=AMPLITUDES, seed=1),
        Segment("multisine", start=20.0, amplitudes=still, seed=2),
    )
    m = measured(45.0, segments=segments, gusts=ColouredNoise(0.3, 0.3))
    own = {"structure": STRUCTURE, "forgetting_time": forgetting_time, "update_rate": 20.0}
    identifier, estimates = identified(m, **own)
    at_rest, last = since(estimates, 25.0, 26.0)[0], estimates[-1]
    for name in ("pdot/dr", "rdot/dr", "pdot/dth"):
        place = identifier.structure.index(name)
        assert low < last.sigma[place] / at_rest.sigma[place] < high
        assert abs(last.coefficients[place] - at_rest.coefficients[place]) < at_rest.sigma[place]
        assert abs(last.coefficients[place] - m.flight.coefficients_at(0.0)[place]) < (
            2.0 * last.sigma[place]
        )
    assert not last.usable_rows[2]
    assert worst_error(last.coefficients, m.flight, ("pdot/da", "qdot/de")) < 0.05
