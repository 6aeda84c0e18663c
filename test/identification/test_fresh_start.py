# SPDX-License-Identifier: Apache-2.0
"""A flight that follows on time in which the surfaces moved and nothing followed."""

from types import SimpleNamespace
from typing import Any

import flying
import numpy as np
import pytest
from light_aircraft import TRUTH
from verdict_flights import carried

from uav_ident_ros.identification.estimators import Estimator, make_estimator
from uav_ident_ros.identification.fresh_start import FreshStart
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.structure import MAIN_DERIVATIVES, STRUCTURES

CARRIED = 20.0
"""Time in which it is carried, s."""

FLIGHT = STRUCTURES["flight_dynamics"]


def test_a_launch_begins_anew_where_the_newest_half_minute_tells_more() -> None:
    launched = carried(CARRIED, 1, flying.light_measured(80.0))
    identifier, estimates = flying.identified(launched)
    assert not any(any(e.usable_rows) for e in flying.since(estimates, 0.0, CARRIED))
    last, place = estimates[-1], FLIGHT.index("pdot/da")
    assert last.usable
    assert abs(last.coefficients[place] - TRUTH["pdot/da"]) < 3.0 * last.sigma[place]
    assert last.sigma[place] < 0.1 * TRUTH["pdot/da"]
    assert identifier.supervisor.changed == []  # of what was carried nothing is told


def test_what_is_known_is_never_begun_anew() -> None:
    flown = flying.light_measured(80.0)
    identifier = OnlineIdentifier(flying.settings(flown))
    first = identifier.estimator
    flying.run(identifier, flying.messages(flown))
    assert identifier.estimator is first


def test_an_estimator_of_ones_own_that_there_is_once_learns_once() -> None:
    flown = flying.light_measured(10.0)
    usual = flying.identified(flown)[1][-1]
    own: list[Estimator] = []

    def make(settings: Any, start: Any) -> Estimator:
        own.append(own[0] if own else make_estimator(settings, start))
        return own[-1]

    identifier = OnlineIdentifier(flying.settings(flown), estimator=make)
    once = flying.run(identifier, flying.messages(flown))[-1]
    np.testing.assert_array_equal(once.coefficients, usual.coefficients)


def knowing(*t_ratios: float) -> Any:
    """An estimator whose main control derivatives have these t-ratios."""
    coefficients, sigma = np.zeros(FLIGHT.mask.shape), np.ones(FLIGHT.mask.shape)
    coefficients[MAIN_DERIVATIVES] = t_ratios
    return SimpleNamespace(coefficients=coefficients, sigma=sigma, model_error=np.zeros(3))


@pytest.mark.parametrize(
    ("fresh", "used", "more"),
    [
        ((5.0, 5.0, 5.0), (1.0, 1.0, 1.0), True),
        ((5.0, 1.0, 1.0), (1.0, 1.0, 1.0), True),
        ((3.5, 1.0, 1.0), (1.0, 1.0, 1.0), False),  # not known well enough
        ((5.0, 1.0, 1.0), (1.0, 1.0, 3.5), False),  # the rudder would be lost
        ((5.0, 1.0, -5.0), (1.0, 1.0, 3.5), True),
        ((5.0, 5.0, 5.0), (3.5, 3.5, 3.5), False),  # nothing is gained
    ],
)
def test_it_must_know_all_that_was_known_and_more(
    fresh: tuple[float, ...], used: tuple[float, ...], more: bool
) -> None:
    beside = FreshStart.__new__(FreshStart)
    beside.estimator = knowing(*fresh)
    assert beside.tells_more(knowing(*used), 4.0) is more
