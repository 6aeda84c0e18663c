# SPDX-License-Identifier: Apache-2.0
"""A warm start from the coefficients of an earlier flight, and settings that change in flight."""

from copy import deepcopy
from dataclasses import replace
from functools import cache
from typing import Any

import flying
import numpy as np
import pytest
from light_aircraft import TRUTH
from verdict_flights import warm_start

from uav_ident_ros.identification.estimate import CoefficientSet
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import Settings, SettingsError
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.simulation.inputs import Segment

STRUCTURE = "throttle_coupled"


@cache
def learned() -> CoefficientSet:
    """Coefficients learned in the first flight."""
    return flying.identified(flying.excited(), structure=STRUCTURE)[0].coefficient_set()


def warm(**changes: Any) -> OnlineIdentifier:
    identifier = flying.fresh(**changes)
    identifier.resume(learned())
    return identifier


def test_a_warm_start_keeps_its_accuracy_and_is_soon_usable() -> None:
    m = flying.measured(5.5, segments=(Segment("multisine", amplitudes=flying.AMPLITUDES, seed=7),))
    before = flying.worst_error(learned().values, m.flight)
    estimates = flying.run(warm(), flying.messages(m))
    last = estimates[-1]
    assert np.array_equal(estimates[0].coefficients, learned().values)
    assert last.usable, last.reason
    for estimate in estimates:
        assert flying.worst_error(estimate.coefficients, m.flight) < before + 0.15
    cold = flying.run(flying.fresh(), flying.messages(m))[-1]
    assert (last.fit > cold.fit + 5.0).all()


def test_a_fixed_coefficient_keeps_its_initial_value() -> None:
    initial = np.zeros((3, STRUCTURES[STRUCTURE].size))
    index = STRUCTURES[STRUCTURE].index("pdot/p")
    initial[index] = -7.0
    own = {"fixed_coefficients": ("pdot/p",), "initial_coefficients": initial.ravel().tolist()}
    identifier = warm(**own)
    values = identifier.coefficient_set().values
    assert values[index] == -7.0
    index = STRUCTURES[STRUCTURE].index("pdot/da")
    assert values[index] == learned().values[index]


def test_a_saved_delay_is_resumed_only_where_the_delay_is_estimated() -> None:
    for estimate, wanted in ((True, 0.06), (False, 0.02)):
        identifier = flying.fresh(actuators__estimate_delay=estimate, actuators__delay=0.02)
        identifier.resume(learned(), delay=0.06)
        assert identifier.delay == wanted


def test_wrong_coefficients_are_refused_and_change_no_value() -> None:
    identifier = flying.fresh()
    huge = replace(learned(), values=learned().values * 1e9)
    other = CoefficientSet("baseline", learned().values, learned().sigma)
    for wrong in (huge, other):
        with pytest.raises(SettingsError):
            identifier.resume(wrong)
        assert not identifier.coefficient_set().values.any()


def test_settings_of_learning_and_signals_may_change_and_coefficients_stay() -> None:
    stream = flying.messages(flying.excited())
    half = 2 * len(stream) // 3
    before = flying.run(flown := flying.fresh(), stream[:half])[-1]
    unchanged = flying.run(deepcopy(flown), stream[half : half + 1000])[-1]
    for name, value in (
        ("actuators.delay", 0.08),
        ("actuators.time_constant", 0.05),
        ("actuators.trim", (0.01, 0.0, 0.0, 0.4)),
        ("filter.cutoff", 25.0),
        ("imu.lever_arm", (0.3, 0.0, 0.0)),
    ):
        identifier = deepcopy(flown)
        sigma = identifier.coefficient_set().sigma
        values = identifier.settings.values()
        identifier.reconfigure(Settings.from_values({**values, name: value}))
        assert np.array_equal(identifier.coefficient_set().values, before.coefficients), name
        free = sigma > 0.0
        assert (identifier.coefficient_set().sigma[free] > sigma[free]).all(), "it is trusted less"
        first, *_, last = flying.run(identifier, stream[half : half + 1000])
        assert np.array_equal(first.coefficients, before.coefficients), name
        assert first.t_ns - before.t_ns < 1_000_000_000
        assert not np.array_equal(last.coefficients, before.coefficients), name
    flown.reconfigure(Settings.from_values({**flown.settings.values(), "forgetting_time": 20.0}))
    last = flying.run(flown, stream[half : half + 1000])[-1]
    assert not np.array_equal(last.coefficients, unchanged.coefficients)


def test_a_delay_corrected_in_flight_corrects_the_coefficients() -> None:
    flight, stream = flying.excited().flight, flying.messages(flying.excited())
    part = len(stream) // 8
    right = flying.settings(flying.excited()).actuators.delay
    wrong = flying.fresh(actuators__delay=right + 0.1)
    first = flying.run(wrong, stream[:part])[-1]
    astray = flying.worst_error(first.coefficients, flight)
    assert astray > 0.3
    values = wrong.settings.values()
    wrong.reconfigure(Settings.from_values({**values, "actuators.delay": right}))
    last = flying.run(wrong, stream[part:])[-1]
    assert flying.worst_error(last.coefficients, flight) < 0.3 * astray
    assert last.usable, last.reason


def test_settings_that_may_not_change_are_refused_by_name() -> None:
    identifier = flying.fresh()
    before = identifier.settings
    values = {**before.values(), "forgetting_time": 50.0, "update_rate": 5.0}
    with pytest.raises(SettingsError, match=r"'update_rate' cannot change in flight"):
        identifier.reconfigure(Settings.from_values(values))
    assert identifier.settings is before


# --- a wrong start --------------------------------------------------------------------------------


def scaled_start(factor: float) -> CoefficientSet:
    """The light aircraft's coefficients, moments times `factor`, with a sigma of 5 %."""
    return warm_start(STRUCTURES["flight_dynamics"], TRUTH, factor)


@pytest.mark.parametrize("factor", [0.4, 1.7])
def test_the_prior_of_another_aircraft_is_replaced_and_its_derivatives_named(factor: float) -> None:
    """The residual by one common factor correlates with the inputs, as feedback does."""
    m = flying.light_measured(36.0, flying.SURFACES, noise_seed=1, bank=20.0, delay=0.02)
    flown, estimates = flying.identified(m, scaled_start(factor), update_rate=20.0)
    wrong, last = {change.name for change in flown.supervisor.changed}, estimates[-1]
    assert wrong == {"pdot/da", "qdot/de", "rdot/dr"}
    assert (flying.light_errors(last, *wrong)[0] < 0.1).all()
    for name in wrong:
        sigma = last.sigma[STRUCTURES["flight_dynamics"].index(name)]
        assert sigma < 0.25 * abs(TRUTH[name])
    rejected = [change.t for change in flown.supervisor.changed if change.prior_rejected]
    assert bool(rejected) == (factor > 1.0)
    for t in rejected[:1]:  # the verdict waits as after a cold start
        first = t - estimates[0].t_ns * 1e-9
        assert first < 20.0
        assert not any(e.usable for e in flying.since(estimates, first + 0.1, 29.0))


def test_a_right_prior_is_kept_under_feedback_to_gusts() -> None:
    """With the weak prior feedback would bias pdot/da by half."""
    flown, (*_, last) = flying.identified(flying.stiff_autopilot(45.0, seed=1), scaled_start(1.0))
    assert flown.supervisor.changed == []
    assert flying.light_errors(last, "pdot/da")[0] < 0.05
