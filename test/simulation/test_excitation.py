# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.identification.waveforms import (
    WaveformError,
    disjoint_harmonics,
    multisine,
)
from uav_ident_ros.simulation.errors import SimulationError
from uav_ident_ros.simulation.inputs import Segment, sample_inputs

AMPLITUDES = {"de": 0.08, "dr": 0.12, "da": 0.06, "dth": 0.2}


def test_multisine_starts_at_zero_and_has_only_its_own_harmonics() -> None:
    design = multisine(10.0, (2, 5, 7), 3)
    signal = design.sample(np.arange(0, 10.0, 0.01))
    assert abs(design.sample(np.zeros(1))[0]) < 5e-3
    power = np.abs(np.fft.rfft(signal)) ** 2
    assert set(np.flatnonzero(power > 1e-12 * power.max())) == {2, 5, 7}


def test_harmonics_are_disjoint_and_fill_the_band() -> None:
    dealt = disjoint_harmonics(4, 20.0, (0.1, 2.0))
    assert sorted(h for own in dealt for h in own) == list(range(2, 41))
    with pytest.raises(WaveformError, match="at least 4"):
        disjoint_harmonics(4, 1.0, (0.1, 2.0))
    with pytest.raises(SimulationError, match="at least 4"):
        Segment("multisine", period=1.0, amplitudes=AMPLITUDES).sample(np.zeros(1))


def test_the_same_seed_gives_the_same_phases_and_another_others() -> None:
    multisine.cache_clear()
    first = multisine(20.0, (2, 6, 10), 5).phases
    multisine.cache_clear()
    np.testing.assert_array_equal(first, multisine(20.0, (2, 6, 10), 5).phases)
    assert np.any(first != multisine(20.0, (2, 6, 10), 6).phases)


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


def test_a_doublet_has_no_mean() -> None:
    t = np.arange(0, 0.8, 1e-3)
    u = Segment("doublet", unit=0.4, amplitudes={"dr": 0.1}).sample(t)[:, INPUTS.index("dr")]
    assert abs(u.mean()) < 1e-12
    assert u[0] == pytest.approx(0.1) and u[-1] == pytest.approx(-0.1)


def test_excite_then_quiet() -> None:
    t = np.arange(0, 100.0, 0.01)
    u = sample_inputs([Segment("multisine", start=2.0, duration=60.0, amplitudes=AMPLITUDES)], t)
    assert not np.any(u[t < 2.0]) and not np.any(u[t >= 62.0])
    assert np.all(np.any(u[(t > 2.5) & (t < 61.5)] != 0.0, axis=0))


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"kind": "sweep"}, "sweep"),
        ({"kind": "multisine", "amplitudes": {"flap": 0.1}}, "flap"),
        ({"kind": "3211", "unit": 0.0}, "unit"),
        ({"kind": "quiet", "duration": -1.0}, "duration"),
    ],
)
def test_wrong_segments_are_refused_by_name(values: dict, named: str) -> None:
    with pytest.raises(SimulationError, match=named):
        Segment(**values)
