# SPDX-License-Identifier: Apache-2.0
"""The picture of a flight: its labels can be read, its truth is the one that compares."""

import pytest

from uav_ident_ros.offline.picture import with_sigma
from uav_ident_ros.report.style import COLORS, REGRESSORS


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (-10.0219, 0.0254, "-10.022 ± 0.025"),
        (59.94, 0.13, "59.94 ± 0.13"),
        (31.2, 12.0, "31 ± 12"),
        (0.5, 0.0, "0.5"),
        (0.5, float("inf"), "0.5"),
    ],
)
def test_a_value_has_the_figures_of_its_sigma(value: float, sigma: float, text: str) -> None:
    assert with_sigma(value, sigma) == text


def test_no_two_things_share_a_colour() -> None:
    colours = [COLORS["measured"], COLORS["ahead"], *REGRESSORS.values()]
    assert len(set(colours)) == len(colours)
