# SPDX-License-Identifier: Apache-2.0
"""The fault campaign: recovery times and detection times."""

from typing import Any

import fault_campaign
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
        ([3.0, 1.0, 2.0, 1.0], 3.0),  # a later excursion restarts the recovery
        ([3.0, 3.0, 3.0, 3.0], None),
    ],
)
def test_recovery_follows_the_last_excursion(errors: list[float], expected: float | None) -> None:
    assert fault_campaign.recovered(flight(errors), flight([1.0] * 4)) == expected


def test_a_fault_is_detected_by_later_changes_on_its_own_axis_alone() -> None:
    outcome = Outcome(
        changes=[(3.0, "pdot/da"), (12.0, "qdot/de"), (15.0, "pdot/da")],
        sources=[(0.0, ("nominal",) * 3), (14.0, ("measured", "nominal", "nominal"))],
    )
    assert fault_campaign.noticed(outcome, 10.0, 0) == 4.0
    assert fault_campaign.noticed(outcome, 10.0, 1) == 2.0
    assert fault_campaign.noticed(outcome, 10.0, 2) is None
