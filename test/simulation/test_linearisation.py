# SPDX-License-Identifier: Apache-2.0
"""The true derivatives: against published ones, the flown response, another step."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("jsbsim", reason="JSBSim is a development extra")

from uav_ident_ros.simulation.aircraft import AIRFRAMES, COLUMN
from uav_ident_ros.simulation.faults import Fault
from uav_ident_ros.simulation.linearisation import linearise, named_modes
from uav_ident_ros.simulation.live_aircraft import LiveAircraft
from uav_ident_ros.simulation.noise import Sensors

SENSORS = Sensors(rate=100.0)


@pytest.mark.parametrize("name", AIRFRAMES)
def test_the_derivatives_are_those_known(name: str) -> None:
    """Those of the table were found by regression or by others."""
    found = linearise(LiveAircraft(name, SENSORS).aircraft).derivatives
    for key, value in AIRFRAMES[name].local_truth.items():
        assert found[key] == pytest.approx(value, rel=0.06, abs=0.02), key


def test_the_linear_model_flies_as_the_aircraft_does() -> None:
    live = LiveAircraft("c172p", SENSORS)
    model, moved = linearise(live.aircraft), np.array([0.02, 0.015, 0.01, 0.0])
    live.aircraft.set_surfaces(live.trim + moved)
    first = live.aircraft.to_si(np.array(live.aircraft.step()))
    x, dt = np.zeros(5), 1e-3
    columns = [COLUMN[name] for name in ("p", "q", "r", "beta", "alpha")]
    for _ in range(250):
        x = x + dt * (model.a @ x + model.b @ moved)
        flown = live.aircraft.to_si(np.array(live.aircraft.step()))
    change = (flown - first)[columns]
    np.testing.assert_allclose(x, change, rtol=0.06, atol=3e-4)


def test_neither_the_step_nor_a_second_call_matters() -> None:
    aircraft = LiveAircraft("c172p", SENSORS).aircraft
    before = np.array(aircraft.step())
    first, finer, again = linearise(aircraft), linearise(aircraft, 1e-4), linearise(aircraft)
    for name, value in first.derivatives.items():
        if name.endswith("/beta") and name[0] not in "pr":
            continue  # longitudinal, by sideslip: even in it, with a corner at zero
        assert finer.derivatives[name] == pytest.approx(value, rel=0.01, abs=0.02), name
    np.testing.assert_allclose(again.a, first.a, atol=1e-6)
    after = np.array(aircraft.step())
    flying = [COLUMN[name] for name in ("p", "q", "r", "alpha", "beta", "roll", "pitch")]
    np.testing.assert_allclose(after[flying], before[flying], atol=1e-4)


def test_more_inertia_is_less_of_every_pitch_derivative() -> None:
    live = LiveAircraft("c172p", SENSORS)
    before = linearise(live.aircraft).derivatives
    live.faults.apply(Fault("inertia", "pitch", 1.3))
    after = linearise(live.aircraft).derivatives
    for name in ("qdot/de", "qdot/q", "qdot/alpha"):
        assert after[name] / before[name] == pytest.approx(1.0 / 1.3, rel=0.02), name
    assert after["pdot/da"] == pytest.approx(before["pdot/da"], rel=0.02)


def test_the_modes_are_found_in_their_blocks() -> None:
    a = np.zeros((5, 5))
    a[0, 0] = -8.0  # roll
    a[np.ix_([2, 3], [2, 3])] = [[-1.0, 9.0], [-1.0, -1.0]]  # -1 +- 3j
    a[np.ix_([1, 4], [1, 4])] = [[-2.0, -16.0], [1.0, -2.0]]  # -2 +- 4j
    modes = named_modes(a)
    np.testing.assert_allclose(modes["roll"], [-8.0])
    np.testing.assert_allclose(modes["dutch roll"], [-1.0 - 3.0j, -1.0 + 3.0j])
    np.testing.assert_allclose(modes["short period"], [-2.0 - 4.0j, -2.0 + 4.0j])
