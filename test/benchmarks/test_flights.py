# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import flights
import numpy as np
import pytest


@pytest.mark.parametrize("name", flights.names())
def test_every_definition_can_be_flown(name: str) -> None:
    own = flights.definition(name)
    plan = flights.plan_of(own)
    assert plan.duration > 0.0 and own["description"] and "seed" in own
    assert plan.rate % flights.sensors_of(own).rate == 0.0


def test_a_loaded_flight_is_kept_and_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flights, "CACHE", tmp_path)
    monkeypatch.setattr(flights, "WORTH_KEEPING", 0.0)
    first = flights.load("exact_convergence")
    (kept,) = tmp_path.iterdir()
    modified = kept.stat().st_mtime_ns
    second = flights.load("exact_convergence")
    assert kept.stat().st_mtime_ns == modified
    np.testing.assert_array_equal(first.rates, second.rates)
    other = flights.load("exact_convergence", seed=2)
    assert len(list(tmp_path.iterdir())) == 2
    assert np.any(other.rates != first.rates)


def test_the_key_follows_what_is_flown_and_not_what_measures_it() -> None:
    own = flights.definition("exact_gusts_10")
    assert flights.key_of(own) == flights.key_of({**own, "sensors": {}, "description": "x"})
    assert flights.key_of(own) != flights.key_of({**own, "delay": 0.01})
    assert flights.key_of(own) != flights.key_of(own, 7)
