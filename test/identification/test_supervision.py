# SPDX-License-Identifier: Apache-2.0
"""The running fit, the states, and the verdict."""

from copy import deepcopy
from functools import cache
from typing import Any

import flying
import numpy as np
import pytest

from uav_ident_ros.identification import supervision
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.residuals import LARGEST_ODDS
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.inputs import ColouredNoise, Segment
from uav_ident_ros.simulation.noise import Measurements, Sensors, measure


def flown(measurements: Measurements, **changes: Any) -> tuple[OnlineIdentifier, list[Estimate]]:
    return flying.identified(measurements, **{"structure": "throttle_coupled", **changes})


def test_a_good_identification_is_usable_but_not_in_its_first_half_minute() -> None:
    _, estimates = flown(flying.measured(35.0))
    last = estimates[-1]
    assert (last.usable, last.state, last.reason) == (True, "converged", "")
    assert (last.fit > 80.0).all()
    assert not any(e.usable for e in flying.since(estimates, 0.0, 29.0))
    assert {e.state for e in flying.since(estimates, 1.0, 29.0)} == {"learning"}


def test_a_flying_wing_without_a_rudder_is_usable_once_its_mixing_says_so() -> None:
    """Nothing can move a rudder that is not there: the prediction of the yaw rate decides."""
    elevons = {name: peak for name, peak in flying.PEAKS.items() if name != "dr"}
    wing = flying.light_measured(34.0, elevons, yaw_damper=0.0)
    stream, without = flying.messages(wing), {"actuators__mixing__dr": [0.0] * 4}
    identifier, estimates = flying.identified(wing, stream=stream[:-10], **without)
    last, strict = estimates[-1], {**identifier.settings.values(), "supervision.min_fit": 99.9}
    assert (last.usable, last.state, last.reason) == (True, "converged", "")
    identifier.reconfigure(Settings.from_values(strict))
    *_, last = flying.run(identifier, stream[-10:])
    assert "fit of r of late" in last.reason and not any(last.usable_rows)
    _, estimates = flying.identified(wing)  # a rudder that has never moved
    assert estimates[-1].usable_rows == (True, True, False)
    assert "move dr" in estimates[-1].reason


def test_learning_does_not_pause_for_samples_slower_than_ticks() -> None:
    slow = measure(flying.plant_flight(20.0), Sensors(rate=10.0, gyro_noise=0.02), seed=2)
    _, estimates = flown(slow)
    states = [estimate.state for estimate in estimates]
    begun = states.index("learning")
    assert 0 < begun < len(states) // 2
    assert set(states[:begun]) == {"waiting"}
    assert set(states[begun:]) == {"learning"}
    assert all(estimate.adapting for estimate in estimates[begun:])


def test_in_quiet_flight_coefficients_stay_and_the_verdict_expires_at_the_largest_age() -> None:
    """25 s in gusts without excitation; without a largest age it does not expire."""
    segment = Segment("multisine", duration=32.0, amplitudes=flying.AMPLITUDES, seed=1)
    m = flying.measured(57.0, segments=(segment,), gusts=ColouredNoise(0.3, 0.3))
    stream = flying.messages(m)
    pause_ns = stream[0].t_ns + 38e9
    excited = [message for message in stream if message.t_ns < pause_ns]
    before, (*_, at_pause) = flown(m, stream=excited, supervision__max_age=15.0)
    assert (at_pause.state, at_pause.usable) == ("paused", True)
    assert at_pause.reason.startswith("too little excitation")
    for max_age, usable in ((15.0, False), (0.0, True)):
        last = flying.run(with_age(deepcopy(before), max_age), stream[len(excited) :])[-1]
        assert last.usable == usable
        assert ("has moved too little of late" in last.reason) != usable
        # The small weight changes the last digits only.
        moved = np.abs(last.coefficients - at_pause.coefficients)
        assert (moved <= 0.05 * at_pause.sigma).all()


@cache
def learned() -> tuple[OnlineIdentifier, list[flying.SentSample]]:
    """Return an identifier that is usable after 33 s, and the later messages."""
    flight = flying.measured(40.0)
    stream = flying.messages(flight)
    then_ns = stream[0].t_ns + 33_000_000_000
    identifier = OnlineIdentifier(flying.settings(flight, structure="throttle_coupled"))
    assert flying.run(identifier, (m for m in stream if m.t_ns < then_ns))[-1].usable
    return identifier, [m for m in stream if m.t_ns >= then_ns]


def with_age(identifier: OnlineIdentifier, max_age: float) -> OnlineIdentifier:
    """Return the identifier with another largest age of a confirmation, s."""
    values = {**identifier.settings.values(), "supervision.max_age": max_age}
    identifier.reconfigure(Settings.from_values(values))
    return identifier


@pytest.mark.parametrize(
    ("what", "max_age", "usable"),
    [("silent", 5.0, False), ("silent", 0.0, True), ("saturated", 5.0, False), ("off", 5.0, True)],
)
def test_a_usable_model_expires_without_learning(what: str, max_age: float, usable: bool) -> None:
    """The actuators are silent, or the gyro is saturated. With learning off it does not expire."""
    identifier, rest = deepcopy(learned())
    with_age(identifier, max_age).supervisor.adapt = what != "off"
    if what == "silent":
        rest = [m for m in rest if m.stream == "rates"]
    if what == "saturated":
        at_limit = (35.0, *(0.0,) * 5)
        rest = [m._replace(values=at_limit) if m.stream == "rates" else m for m in rest]
    estimates = flying.run(identifier, rest)
    assert estimates[5].usable
    assert estimates[-1].usable == usable


def test_evidence_against_an_unknown_estimate_does_not_count_against_a_known_one() -> None:
    """The estimate of a cold start is noise, which the flight contradicts."""
    identifier, _ = deepcopy(learned())
    supervisor, estimator = identifier.supervisor, identifier.estimator
    supervisor.confirmed._odds[1:, supervisor.confirmed._tested == 0] = -LARGEST_ODDS

    def doubt(sigma: FloatArray) -> str:
        running = identifier.running_fit
        supervisor.judge(35.0, estimator.coefficients, sigma, running, estimator, [""] * 3, np.inf)
        return supervisor.verdict[0]

    assert doubt(estimator.sigma).startswith("pdot/da is contradicted")
    assert doubt(np.abs(estimator.coefficients)).startswith("pdot/da has a t-ratio of 1.0")
    assert doubt(estimator.sigma).startswith("pdot/da is unconfirmed")
    # No part of sigma is a lateness that may be noise.
    estimator.model_error = np.full(3, 0.9)
    assert doubt(np.abs(estimator.coefficients)).startswith("pdot/da has a t-ratio of 1.0")
    assert doubt(estimator.sigma).startswith("pdot follows da badly: 90 %")
    estimator.answers = np.array([0.1, 0.2, 0.45, 0.3])
    assert doubt(np.abs(estimator.coefficients)).endswith(
        "move da by itself, 45 % of its motion answers disturbances (~/excite)"
    )


def test_no_row_is_usable_while_other_axes_are_more_likely() -> None:
    """What else denies a row is named first."""
    identifier, _ = deepcopy(learned())
    supervisor, estimator = identifier.supervisor, identifier.estimator
    values, sigma = estimator.coefficients, estimator.sigma.copy()
    sigma[1] = np.abs(values[1])
    running = identifier.running_fit
    supervisor.judge(35.0, values, sigma, running, estimator, [""] * 3, np.inf, "axes")
    assert [supervisor.verdict[row] for row in (0, 2)] == ["axes"] * 2
    assert supervisor.verdict[1].startswith("qdot/de has a t-ratio of")


def test_without_adaptation_the_fit_is_low_on_the_axis_with_a_wrong_value() -> None:
    flight = flying.plant_flight(12.0)
    measurements = measure(flight, Sensors(gyro_noise=0.0), seed=2)
    assert flight.coefficients is not None
    wrong = flight.coefficients * np.where(np.arange(12) == 10, 0.7, 1.0)
    identifier, estimates = flown(
        measurements, initial_coefficients=tuple(wrong.ravel().tolist()), adapt_on_start=False
    )
    fit, hold = estimates[-1].fit, identifier.running_fit.hold
    assert (fit[1] > 95.0, fit[0] < 80.0) == (True, True)
    assert (hold < fit).all()
    assert (estimates[-1].usable, estimates[-1].state) == (False, "paused")
    np.testing.assert_array_equal(estimates[-1].coefficients, wrong)


@pytest.mark.parametrize(("travel", "misses"), [(0.03, True), (np.inf, False)])
def test_a_limit_of_travel_without_a_setting_is_named(travel: float, misses: bool) -> None:
    m = flying.light_measured(36.0, {"de": 0.15, "dr": 0.2, "da": 0.15}, travel=travel)
    late = flying.since(flying.identified(m)[1], 31.0, 36.0)
    assert all("a limit of travel" in estimate.reason for estimate in late) == misses
    assert any(estimate.usable for estimate in late) != misses


@pytest.mark.parametrize(
    ("row", "share", "t_ratio", "multirotor", "expected"),
    [
        # the limit is 1 / t_ratio
        (0, 0.24, 4.0, False, ""),
        (0, 0.26, 4.0, False, "pdot follows da badly: 26 % of"),
        (0, 0.26, 3.0, False, ""),
        # a model of the wrong sign misses more than the whole effect
        (2, 3.47, 4.0, False, "rdot follows dr badly: 100 % of"),
        *((row, 0.5, 4.0, True, f"{axis}dot follows") for row, axis in enumerate("pqr")),
    ],
)
def test_a_large_model_error_is_named_and_in_yaw_the_inertia_of_rotors(
    row: int, share: float, t_ratio: float, multirotor: bool, expected: str
) -> None:
    reason = supervision._incomplete(row, share, t_ratio, multirotor=multirotor)
    assert reason.startswith(expected) and bool(reason) == bool(expected)
    assert ("the inertia of the rotors" in reason) == (multirotor and row == 2)
