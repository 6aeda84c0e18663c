# SPDX-License-Identifier: Apache-2.0
"""Structures: regressors, masks, names."""

import numpy as np
import pytest

from uav_ident_ros.identification.structure import INPUTS, STRUCTURES


def test_the_masks_are_those_of_the_paper() -> None:
    # Columns of the matrix after (12), with A311 for the misprinted A111.
    mask = STRUCTURES["baseline"].mask
    assert [list(np.flatnonzero(row) + 1) for row in mask] == [
        [1, 2, 6, 8, 10, 11],
        [3, 4, 5, 7, 9, 12],
        [1, 2, 6, 8, 10, 11],
    ]
    coupled = STRUCTURES["throttle_coupled"].mask
    assert [tuple(i) for i in np.argwhere(coupled & ~mask)] == [(0, 11), (2, 11)]


def test_regressors_and_entries_are_those_of_their_names() -> None:
    structure = STRUCTURES["augmented"]
    p, q, r = 0.3, -0.7, 1.1
    u = dict(zip(INPUTS, (0.01, 0.02, 0.03, 0.4), strict=True))
    values = {"p": p, "q": q, "r": r, "1": 1.0, "ay": -0.5, "az": -9.0, **u}
    f = structure.regressor(np.array([p, q, r]), np.array(list(u.values())), np.array([-0.5, -9.0]))
    for label, value in zip(structure.regressors, f, strict=True):
        expected = values.get(label)
        if expected is None:  # a product of two rates, as 'pq' or 'rr'
            expected = values[label[0]] * values[label[1]]
        assert value == expected
    assert structure.index("pdot/da") == (0, 10)
    assert structure.index("qdot/1") == (1, 12)
    with pytest.raises(ValueError, match="no coefficient 'pdot/de'"):
        structure.index("pdot/de")


def test_flow_angles_have_rows_for_their_forces_and_kinematics() -> None:
    structure = STRUCTURES["flight_dynamics"]
    assert structure.row_labels == ("pdot", "qdot", "rdot", "ay", "az", "betadot", "alphadot")
    assert structure.dense_rows == ("pdot", "qdot", "rdot", "ay", "az")
    assert structure.regressors[-3:] == ("1", "beta", "alpha")
    assert (structure.has_flow, structure.has_forces) == (True, False)
    moments, forces = structure.names[:26], structure.names[26:]
    assert {name for name in moments if name.endswith(("/beta", "/alpha"))} == {
        "pdot/beta", "qdot/alpha", "rdot/beta",
    }  # fmt: skip
    assert forces == (
        "ay/p", "ay/r", "ay/dr", "ay/beta", "az/de", "az/alpha",
        "betadot/p", "betadot/1", "alphadot/1",
    )  # fmt: skip
    f = structure.regressor(np.zeros(3), np.zeros(4), np.array([0.1, -0.2]))
    assert f[structure.column("beta")] == 0.1
    assert f[structure.column("alpha")] == -0.2
    for name in ("baseline", "throttle_coupled", "augmented"):
        other = STRUCTURES[name]
        assert other.row_labels == other.dense_rows == ("pdot", "qdot", "rdot")
        assert not other.has_flow
