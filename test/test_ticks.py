# SPDX-License-Identifier: Apache-2.0
"""Packed estimates are those that were put in, and the score in pieces is that of the whole."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.offline import run as offline
from uav_ident_ros.offline.run import OfflineRun, choose_inputs
from uav_ident_ros.offline.ticks import Ticks

BAGS = Path(__file__).parent.parent / "bags"


class Watched(Ticks):
    """Keeps the estimates as they come, too."""

    def append(self, estimate: Estimate) -> None:
        self.__dict__.setdefault("given", []).append(estimate)
        super().append(estimate)


@pytest.fixture(scope="module", params=["c172p", "multisine"])
def run(request: pytest.FixtureRequest) -> OfflineRun:
    values = load_parameters(BAGS / request.param / "identifier.yaml", "identifier")
    with Bag(BAGS / request.param) as bag:
        end_ns = bag.start_ns + 9 * 10**9
        result = OfflineRun(choose_inputs(bag, values))
        result.estimates = Watched(result.structure)
        result.run(bag, lambda messages, _: (m for m in messages if m.log_ns < end_ns))
    return result


def same(a: Estimate, b: Estimate) -> bool:
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(Estimate))


def test_what_comes_out_is_what_was_put_in(run: OfflineRun) -> None:
    given, ticks = run.estimates.given, run.estimates
    assert len(ticks) == len(given) > 140
    assert all(same(a, b) for a, b in zip(ticks, given, strict=True))
    assert same(ticks[-1], given[-1])
    part = ticks[40:140][5:]
    assert [e.t_ns for e in part] == part.stamps().tolist() == [e.t_ns for e in given[45:140]]
    index = run.structure.free[-1]
    for history, name in zip(part.history(index), ("coefficients", "sigma"), strict=True):
        assert history.tolist() == [getattr(e, name)[index] for e in given[45:140]]
    with pytest.raises(IndexError):
        ticks[len(given)]


def test_the_score_in_pieces_is_that_of_the_whole(
    run: OfflineRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = run.score()
    monkeypatch.setattr(offline, "PIECE", 61)
    for name, fit in run.score().items():
        np.testing.assert_allclose(fit.free, whole[name].free, rtol=1e-9)
        np.testing.assert_allclose(fit.measured_force, whole[name].measured_force, rtol=1e-9)
        assert (fit.windows, fit.samples) == (whole[name].windows, whole[name].samples)
