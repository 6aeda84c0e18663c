# SPDX-License-Identifier: Apache-2.0
"""Inputs that act on the axis of another one."""

from itertools import product
from typing import Any

import numpy as np
import pytest

from uav_ident_ros.identification.exchange import ExchangedInputs
from uav_ident_ros.identification.frames import rotation
from uav_ident_ros.identification.plausibility import exchange_finding, turn_finding
from uav_ident_ros.identification.regression import Regression
from uav_ident_ros.identification.scales import SURE
from uav_ident_ros.identification.settings import ImuSettings
from uav_ident_ros.identification.structure import INPUT_COLUMNS, STRUCTURES, FloatArray

DT, TIME = 0.05, 5.0
SIZE = STRUCTURES["augmented"].size
EFFECT = np.array([[0.0, 3.0, 45.0, 0.0], [-30.0, 0.0, 0.0, 0.0], [0.0, -9.0, -1.5, 0.0]])
"""Effects of de, dr, da, dth on roll, pitch, yaw."""


def exchanged(
    order: list[int],  # Input that each channel takes for its own
    *,
    dead: tuple[int, ...] = (),  # Inputs without effect
    still: tuple[int, ...] = (),  # Inputs that do not move
    size: int = SIZE,  # Regressors of the structure
    seed: int = 1,
    effects: FloatArray = EFFECT,
    seconds: float = TIME,
) -> ExchangedInputs:
    """Return the effects in five seconds of excitation with independent disturbances."""
    rng = np.random.default_rng(seed)
    u = 0.05 * rng.standard_normal((round(seconds / DT), 4))
    u[:, list(still)] = 0.0
    effect = effects.copy()
    effect[:, list(dead)] = 0.0
    y = u @ effect.T + 0.05 * rng.standard_normal((len(u), 3))
    f = np.zeros((len(u), size))
    f[:, INPUT_COLUMNS] = u[:, order]
    found = ExchangedInputs()
    for k in range(0, len(u), 4):
        found.add(Regression.of(y[k : k + 4], f[k : k + 4], f[k : k + 4], DT))
    return found


def looked(order: list[int], **given: Any) -> list[tuple[str, str]]:
    """Return what is found."""
    return exchanged(order, **given).found(SURE)


@pytest.mark.parametrize("size", [SIZE, STRUCTURES["baseline"].size])
@pytest.mark.parametrize(
    ("order", "found"),
    [
        ([0, 1, 2, 3], []),
        ([2, 1, 0, 3], [("de", "da"), ("da", "de")]),
        ([1, 0, 2, 3], [("dr", "de"), ("de", "dr")]),
        ([0, 2, 1, 3], [("dr", "da"), ("da", "dr")]),
        ([1, 2, 0, 3], [("dr", "da"), ("da", "de"), ("de", "dr")]),
    ],
)
def test_exchanged_inputs_are_found_in_every_order(
    order: list[int], found: list[tuple[str, str]], size: int
) -> None:
    assert looked(order, size=size) == found


def test_inputs_without_effect_or_motion_are_not_exchanged() -> None:
    for dead in ((0,), (1,), (2,), (0, 1, 2)):
        assert not any(looked([0, 1, 2, 3], dead=dead, seed=seed) for seed in range(20)), dead
    assert looked([2, 1, 0, 3], still=(1,)) == [("de", "da"), ("da", "de")]
    assert looked([2, 1, 0, 3], still=(0,)) == []
    assert looked([0, 1, 2, 3], still=(0, 1, 2, 3)) == []
    assert ExchangedInputs().found(0.0) == []
    assert ExchangedInputs().turned() is None


def test_exchanged_surfaces_or_motors_are_named() -> None:
    effects = exchanged([0, 2, 1, 3])
    found = exchange_finding(effects)
    assert found is not None
    assert found.text.startswith("aileron and rudder are swapped: dr rolls the aircraft more than")
    found = exchange_finding(effects, multirotor=True)
    assert found is not None
    assert found.text.startswith("the motors are in another order: dr rolls")
    assert exchange_finding(exchanged([0, 1, 2, 3])) is None


# --- an Imu that is turned ------------------------------------------------------------------------


MOUNTED = (0.1, -0.2, 0.3)
"""Roll, pitch and yaw of an Imu's mounting, rad."""


def turned(
    roll: float = 0.0, yaw: float = 0.0, effects: FloatArray = EFFECT, **given: Any
) -> ExchangedInputs:
    """Return the effects seen by an Imu that is turned out of place, angles in degrees."""
    out = rotation(np.radians(roll), 0.0, np.radians(yaw))
    return exchanged([0, 1, 2, 3], effects=out @ effects, **{"seconds": 30.0, **given})


def other(place: tuple[int, int], size: float) -> FloatArray:
    """Return the effects with one changed."""
    effects = EFFECT.copy()
    effects[place] = size
    return effects


@pytest.mark.parametrize(("roll", "yaw"), [(5.0, 0.0), (0.0, -5.0), (-8.0, 6.0)])
def test_a_turn_of_the_imu_is_found_from_effects_on_other_axes(roll: float, yaw: float) -> None:
    found = turned(roll, yaw).turned()
    assert found is not None
    assert np.degrees(found) == pytest.approx([-roll, -yaw], abs=1.0)


@pytest.mark.parametrize(
    "flown",
    [
        *({"seed": seed} for seed in range(20)),
        {"roll": 8.0, "seconds": 5.0},  # the scatter of a few seconds is not known
        *({"still": still} for still in ((1, 2), (0, 1, 2, 3))),
        # not symmetric: ailerons or rudder pitch it, or an elevator yaws it, alone
        *({"effects": other(*place)} for place in product([(1, 2), (1, 1), (2, 0)], [1.0, 6.0])),
    ],
)
def test_no_turn_is_found_without_evidence(flown: dict[str, Any]) -> None:
    assert turned(**flown).turned() is None


def test_the_mounting_that_would_fit_is_named() -> None:
    """A turn of -5 deg in roll of an Imu that is mounted with other angles."""
    found = turn_finding(turned(5.0, 0.0), ImuSettings(rpy=MOUNTED))
    assert found is not None
    assert not found.fault
    start = "the Imu seems turned against the aircraft, by -5 deg in roll: the"
    assert found.text.startswith(start)
    named = [float(part) for part in found.text.split("[")[1].rstrip("]").split(", ")]
    right = rotation(np.radians(-5.0), 0.0, 0.0) @ rotation(*MOUNTED)
    np.testing.assert_allclose(rotation(*named), right, atol=0.02)
