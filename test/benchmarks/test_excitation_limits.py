# SPDX-License-Identifier: Apache-2.0
"""An excited flight stays within its limits: benchmarks/excitation.py in short.

That a run ends at the first tick beyond a limit is held by test_excitation_run.py and, over DDS,
by test_excite.py.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("jsbsim", reason="JSBSim is a development extra")
pytest.importorskip("rclpy", reason="the example controller is a ROS node")

from excitation import SEVERITIES, Flight

from uav_ident_ros.identification.excitation_run import Phase
from uav_ident_ros.identification.settings import ExcitationSettings
from uav_ident_ros.identification.structure import FloatArray

pytestmark = pytest.mark.campaign
WARM_UP, EXCITED = 4.0, 14.0


def flown(seed: int, **limits: float) -> tuple[Flight, ExcitationSettings, FloatArray, FloatArray]:
    """Fly in heavy turbulence; return rates, attitude (k, 5) and what was added (k, 4)."""
    flight = Flight(SEVERITIES["heavy"], seed)
    while flight.aircraft.time < WARM_UP:
        flight.step()
    settings = replace(flight.settings.excitation, duration=EXCITED - 4.0, **limits)
    assert flight.run.start(settings, flight.identifier.flying(), flight.estimate) == ""
    rows, added = [], []
    while flight.aircraft.time < WARM_UP + EXCITED:
        added.append(flight.excitation.at(flight.now_ns))
        rows.append(flight.step()[:5])
    return flight, settings, np.array(rows), np.array(added)


def test_an_excited_flight_stays_within_the_limits() -> None:
    flight, limits, seen, added = flown(1)
    assert flight.run.phase is Phase.IDLE and flight.run.why.startswith("complete")
    assert np.abs(added).max() > 0.03
    assert np.abs(seen[:, :3]).max() < limits.max_rate
    assert np.abs(seen[:, 3:]).max() < limits.max_attitude


def test_a_rate_beyond_the_limit_ends_it_within_a_tick() -> None:
    flight, limits, seen, added = flown(0, max_rate=0.25)
    assert flight.run.why.startswith("aborted: ") and "the limit is 0.25" in flight.run.why
    beyond = int(np.argmax(np.abs(seen[:, :3]).max(axis=1) > limits.max_rate))
    last = int(np.flatnonzero(added.any(axis=1))[-1])
    # the tick that sees it, its wait for late messages, the sample that answers: 10 ms each
    assert 0 < last <= beyond + 5 + 5 + 1
