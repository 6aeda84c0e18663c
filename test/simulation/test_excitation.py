# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.identification.waveforms import WaveformError, disjoint_harmonics
from uav_ident_ros.simulation.flight import SimulationError
from uav_ident_ros.simulation.inputs import Segment

AMPLITUDES = {"de": 0.08, "dr": 0.12, "da": 0.06, "dth": 0.2}


def test_harmonics_are_disjoint_and_fill_the_band() -> None:
    dealt = disjoint_harmonics(4, 20.0, (0.1, 2.0))
    assert sorted(h for own in dealt for h in own) == list(range(2, 41))
    with pytest.raises(WaveformError, match="at least 4"):
        disjoint_harmonics(4, 1.0, (0.1, 2.0))
    with pytest.raises(SimulationError, match="at least 4"):
        Segment("multisine", period=1.0, amplitudes=AMPLITUDES).sample(np.zeros(1))


def test_3211_has_its_shape_and_the_inputs_take_turns() -> None:
    segment = Segment("3211", start=1.0, unit=0.5, pause=1.5, amplitudes={"de": 0.1, "da": 0.2})
    at = 1.0 + np.array([0.1, 1.4, 1.6, 2.4, 2.6, 2.9, 3.1, 3.4, 3.6, 4.9])
    de = segment.sample(at)[:, INPUTS.index("de")]
    signs = [1, 1, -1, -1, 1, 1, -1, -1, 0, 0]
    np.testing.assert_allclose(de, 0.1 * np.array(signs))
    turn = 3.5 + 1.5
    da = segment.sample(at + turn)[:, INPUTS.index("da")]
    np.testing.assert_allclose(da, 0.2 * np.array(signs))
    np.testing.assert_allclose(segment.sample(at + 2 * turn)[:, 0], de)
