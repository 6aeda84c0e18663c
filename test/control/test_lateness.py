# SPDX-License-Identifier: Apache-2.0
"""The measured delay: its bank, its evidence, and what a rival needs to replace it."""

import numpy as np
import pytest

from uav_ident_ros.control.lateness import DelayMeter
from uav_ident_ros.identification.structure import FloatArray


def fed(meter: DelayMeter, seconds: float, seed: int = 0) -> float:
    """Add responses that the third delay explains half of; return its log-likelihood ratio."""
    rng, count = np.random.default_rng(seed), len(meter.delays)
    for _ in range(round(seconds / 0.01)):
        made = rng.normal(size=(count, 3))
        answered = np.broadcast_to(made[2] + rng.normal(size=3), made.shape)
        meter.update(answered, made, np.zeros(3), 0.01)
    likely = meter.likelihood()
    return float(likely[2] - np.median(likely))


def test_the_bank_reaches_from_20_ms_to_80_ms_beyond_the_configured_delay() -> None:
    """In steps of 10 ms, two percent of the effect at the filter's bandwidth."""
    assert DelayMeter(0.04).delays == pytest.approx(0.01 * np.arange(2, 13))
    assert DelayMeter(0.01).delays == pytest.approx(0.01 * np.arange(1, 10))  # as configured


def test_evidence_fades_within_five_seconds() -> None:
    """A steady flow of it makes 1 / (1 - 1/e) of what the first five seconds have made."""
    early, late = (fed(DelayMeter(0.04), seconds) for seconds in (5.0, 40.0))
    assert late / early == pytest.approx(1.0 / (1.0 - np.exp(-1.0)), rel=0.15)


@pytest.mark.parametrize(
    ("lead", "rival", "replaced"),
    [(1.5, False, False), (2.5, True, False), (9.0, True, False), (11.0, False, True)],
)
def test_a_rival_has_odds_of_7_to_1_and_replaces_the_delay_at_22000_to_1(
    lead: float, rival: bool, replaced: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are compared 20 times a second."""
    meter, compared = DelayMeter(0.02), []
    likely = np.zeros(len(meter.delays))
    likely[3] = lead

    def likelihood() -> FloatArray:
        compared.append(meter.in_use)
        return likely

    monkeypatch.setattr(meter, "likelihood", likelihood)
    none = np.zeros((len(likely), 3))
    for _ in range(6):
        meter.update(none, none, np.zeros(3), 0.01)
    assert (meter.rival == 3, meter.in_use == 3) == (rival, replaced)
    for _ in range(94):
        meter.update(none, none, np.zeros(3), 0.01)
    assert 16 <= len(compared) <= 20
