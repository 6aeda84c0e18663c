# SPDX-License-Identifier: Apache-2.0
"""Which stamps of a stream no clock gave."""

import numpy as np
import pytest

from uav_ident_ros.import_logs.stamps import NS_PER_S, plausible

STAMPS = 4_000_000 * np.arange(500) + 20 * NS_PER_S


@pytest.mark.parametrize("places", [[0], [1], [250], [250, 251], [497], [3, 100, 400]])
@pytest.mark.parametrize("value", [0, 5 * NS_PER_S, 9000 * NS_PER_S, 2**31 * NS_PER_S, -1])
def test_single_damaged_stamps_are_found(places: list[int], value: int) -> None:
    t_ns = STAMPS.copy()
    t_ns[places] = value
    early = value < STAMPS[0] and places == [0]  # as of a topic that was published long before
    expected = np.arange(len(t_ns)) if early and value >= 0 else np.delete(np.arange(500), places)
    np.testing.assert_array_equal(np.flatnonzero(plausible(t_ns)), expected)


@pytest.mark.parametrize(
    "t_ns",
    [
        STAMPS,
        STAMPS[:3],
        np.array([1, 200, 201, 202, 900, 901, 2000]) * NS_PER_S,  # changes of a state
        np.array([20.2, 25.83, 25.836, 26.0, 26.2, 26.4, 31.0]) * NS_PER_S,
        np.r_[STAMPS, STAMPS[-1] + 60 * NS_PER_S],  # a straggler
        np.r_[STAMPS[:200], STAMPS[300:] + 60 * NS_PER_S],  # a gap
        np.r_[STAMPS + 60 * NS_PER_S, STAMPS],  # a restart of the autopilot
        STAMPS + np.random.default_rng(1).integers(-(10**8), 10**8, len(STAMPS)),  # disorder
    ],
)
def test_gaps_stragglers_and_restarts_are_no_damage(t_ns: np.ndarray) -> None:
    assert plausible(np.asarray(t_ns, dtype=np.int64)).all()
