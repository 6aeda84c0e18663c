# SPDX-License-Identifier: Apache-2.0
"""The limits of settings are those of docs/parameters.md, and refusals name the setting."""

import pickle
from typing import Any

import pytest

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import Settings, SettingsError
from uav_ident_ros.identification.structure import STRUCTURES


@pytest.mark.parametrize(
    ("name", "allowed", "refused"),
    [
        ("actuators.delay", 0.5, 0.51),
        ("actuators.longest_delay", 0.5, 0.51),
        ("initial_coefficients", (0.0,) * 44 + (-1e6,), (0.0,) * 44 + (-1.1e6,)),
        *(
            (f"actuators.{name}", (0.0, 1e6, 0.0, -1e6), (0.0, 0.0, 0.0, 1e300))
            for name in ("trim", "scale", "mixing.de", "mixing.dr", "mixing.da", "mixing.dth")
        ),
    ],
)
def test_values_beyond_limits_are_refused(name: str, allowed: object, refused: object) -> None:
    assert Settings.from_values({name: allowed, "structure": "augmented"}).values()[name] == allowed
    with pytest.raises(SettingsError, match=name):
        Settings.from_values({name: refused, "structure": "augmented"})


def test_the_initial_coefficients_of_flight_dynamics_are_three_rows_or_five() -> None:
    for rows in (3, 5):
        settings = Settings.from_values({"initial_coefficients": (2.0,) * 15 * rows})
        values = OnlineIdentifier(settings).coefficient_set().values
        assert values[STRUCTURES["flight_dynamics"].index("pdot/da")] == 2.0
    with pytest.raises(SettingsError, match="60 values: 45 or 75 are needed"):
        Settings.from_values({"initial_coefficients": (2.0,) * 60})


DIFFERENCES = {"filter.method": "backward_difference"}
PAPER = DIFFERENCES | {"estimator": "gradient", "structure": "baseline"}


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"filter.method": "wavelet"}, "'filter.method' is 'wavelet': allowed are state_variable"),
        (DIFFERENCES, "'filter.method' .*use 'state_variable'"),
        (PAPER | {"actuators.estimate_delay": True}, "'actuators.estimate_delay' .*state_variable"),
        ({"excitation.amplitude": (0.1, 0.1, 0.1)}, "excitation.amplitude"),
        ({"excitation.amplitude": (0.1, -0.1, 0.1, 0.0)}, "excitation.amplitude"),
        ({"excitation.band": (2.0, 0.2)}, "excitation.band"),
        ({"excitation.band": (20.0, 21.0)}, r"'excitation.band' is \[20.0, 21.0\]: allowed is"),
        ({"imu.rpy": (1.0,)}, "'imu.rpy' has 1 values: 3 are needed$"),
        ({"gradient.gains": (1.0,)}, "15 or 225 are needed .structure 'flight_dynamics'"),
        ({"actuators.trim": (1.0,)}, "4 are needed .'actuators.channels' names 4.$"),
        ({"excitation.lead": 0.4, "time_jump": 0.3}, r"'input_wait' allow 0\.35 s"),
        ({"excitation.form": "sweep"}, "excitation.form"),
        *(
            ({"supervision.expected_signs": (entry,)}, "write \\+ or -")
            for entry in ("pdot/da", "+pdot/dx", "*pdot/da", "")
        ),
    ],
)
def test_impossible_settings_are_refused_by_name(values: dict[str, Any], text: str) -> None:
    with pytest.raises(SettingsError, match=text) as caught:
        Settings.from_values(values)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)  # as by workers


def test_an_empty_value_from_rcl_is_an_empty_list() -> None:
    """rcl reads ``trim: []`` as no value."""
    assert Settings.from_values({"actuators.trim": None}).actuators.trim == ()
