# SPDX-License-Identifier: Apache-2.0
"""The limits of settings are those of docs/parameters.md."""

import pytest

from uav_ident_ros.identification.settings import Settings, SettingsError


@pytest.mark.parametrize(
    ("name", "allowed", "refused"),
    [
        ("actuators.delay", 0.5, 0.51),
        ("actuators.longest_delay", 0.5, 0.51),
        ("initial_coefficients", (0.0,) * 44 + (-1e6,), (0.0,) * 44 + (-1.1e6,)),
    ],
)
def test_a_value_beyond_its_documented_limit_is_refused(
    name: str, allowed: object, refused: object
) -> None:
    assert Settings.from_values({name: allowed, "structure": "augmented"}).values()[name] == allowed
    with pytest.raises(SettingsError, match=name):
        Settings.from_values({name: refused, "structure": "augmented"})
