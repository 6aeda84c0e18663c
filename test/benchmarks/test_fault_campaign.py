# SPDX-License-Identifier: Apache-2.0
"""The campaign of faults: what it counts, and a short form of it."""

from typing import Any

import fault_campaign
import numpy as np
import pytest
from loop import Outcome


def flight(errors: list[float], lost: float | None = None, **values: Any) -> dict[str, Any]:
    spans = [[e, 1.0, 1.0] for e in errors]
    return {
        "aircraft": "kite", "controller": "PID", "fault": "aileron lost", "k": 0, "seed": 0,
        "axis": 0, "lost": lost, "errors": [spans[:4]], "in spans": [spans], "noticed": None,
        **values,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        ([1.0, 1.1, 1.0, 1.2], 0.0),
        ([3.0, 2.0, 1.1, 1.0], 2.0),
        ([3.0, 1.0, 2.0, 1.0], 3.0),  # for good: once back is not enough
        ([3.0, 3.0, 3.0, 3.0], None),
    ],
)
def test_recovered_is_for_good(errors: list[float], expected: float | None) -> None:
    assert fault_campaign.recovered(flight(errors), flight([1.0] * 4)) == expected


def test_only_the_axis_concerned_and_what_comes_after_counts_as_noticed() -> None:
    outcome = Outcome(*(np.empty(0) for _ in range(4)))
    outcome.changes = [(3.0, "pdot/da"), (12.0, "qdot/de"), (15.0, "pdot/da")]
    outcome.sources = [(0.0, ("nominal",) * 3), (14.0, ("measured", "nominal", "nominal"))]
    assert fault_campaign.noticed(outcome, 10.0, 0) == 4.0
    assert fault_campaign.noticed(outcome, 10.0, 1) == 2.0
    assert fault_campaign.noticed(outcome, 10.0, 2) is None


def test_the_table_counts_the_lost() -> None:
    healthy = [
        flight([1.0] * 4, controller=name, fault="healthy") for name in fault_campaign.CONTROLLERS
    ]
    faulty = [
        flight([1.0, 5.0, 2.0, 1.0], 20.0 if name == "PID" else None, controller=name)
        for name in fault_campaign.CONTROLLERS
    ]
    lines = list(fault_campaign.lines([*healthy, *faulty]))
    row = next(line for line in lines if line.startswith("| aileron lost | PID"))
    assert "| 1 | 1.00 | 5.00 | 2.00 | 1.00 | 1.00x | 1 |" in row


def test_every_beginning_of_the_design_is_a_fair_sample() -> None:
    names, faults = ["kite", "glider"], ["aileron lost", "rudder jams", "engine out"]
    cells = fault_campaign.design(names, faults)
    assert len(set(cells)) == len(cells) == 6 * fault_campaign.TIMES * fault_campaign.SEEDS
    assert len({cell[:2] for cell in cells[:6]}) == 6
    assert fault_campaign.design(names, faults) == cells
    times = {fault_campaign.fault_time(k, 0) for k in range(fault_campaign.TIMES)}
    assert len(times) == 5
    assert all(15.0 <= t <= 25.0 for t in times)
