# SPDX-License-Identifier: Apache-2.0
"""Preparation and flight of the closed loop, in one process."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("jsbsim", reason="JSBSim is a development extra")

from loop import Mission, fly_loop, make_identifier, rate_controller

from uav_ident_ros.client import Coefficients
from uav_ident_ros.files.coefficients_file import load_coefficients
from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.simulation.aircraft import linearise_cruise
from uav_ident_ros.simulation.airframe import airframe
from uav_ident_ros.simulation.preparation import CONFIG, SENSORS, Prepared, prepare, write

NAME = "ultra_stick_25e"


@pytest.fixture(scope="module")
def small() -> Prepared:
    return prepare(NAME, time=30.0)


def test_preparation_identifies_true_derivatives_and_writes_node_parameters(
    small: Prepared, tmp_path: Path
) -> None:
    write(small, tmp_path)
    found = Coefficients.from_file(tmp_path / f"{NAME}_coefficients.yaml")
    truth = linearise_cruise(NAME).derivatives
    for name in ("pdot/da", "qdot/de"):
        value = found.values[found.structure.index(name)]
        assert value == pytest.approx(truth[name], rel=0.15), name
    path = tmp_path / f"{NAME}.yaml"
    plant, controller = (load_parameters(path, f"/{n}") for n in ("simulated_plant", "controller"))
    assert plant["aircraft"] == NAME and plant["speed"] == 17.0
    np.testing.assert_allclose(controller["trim"], small.trim, atol=1e-9)
    assert np.all(np.array(controller["least"]) < small.trim)


def test_the_identified_coefficients_control_the_flight_repeatably(small: Prepared) -> None:
    outcome = fly_loop(small, Mission(duration=6.0), rate_controller(small), make_identifier(small))
    assert outcome.lost is None and len(outcome.time) == 600
    assert outcome.error(3.0, 6.0).max() < 5.0
    assert len(outcome.usable) > 100
    again = fly_loop(small, Mission(duration=2.0), rate_controller(small), make_identifier(small))
    np.testing.assert_array_equal(outcome.rates[:200], again.rates)


def test_surfaces_hold_their_position_without_imu_data(small: Prepared) -> None:
    mission = Mission(duration=1.0, imu=lambda t, x, _: None if t > 0.5 else x)
    outcome = fly_loop(small, mission, rate_controller(small))
    surfaces = np.array([sample.surfaces[:3] for sample in outcome.samples])
    assert np.ptp(surfaces[:50], axis=0).min() > 0.0
    assert np.ptp(surfaces[55:], axis=0).max() == 0.0


def test_a_reversed_aileron_is_fatal_under_a_fixed_law_alone(small: Prepared) -> None:
    mission = Mission(duration=8.0, faults=("3: aileron effect -1",))
    adaptive = fly_loop(small, mission, rate_controller(small))
    fixed = fly_loop(small, mission, rate_controller(small, adaptive=False))
    assert adaptive.lost is None
    assert adaptive.sources[-1][1][0] == "measured"
    assert adaptive.error(6.0, 8.0)[0] < 6.0
    assert fixed.lost is not None and fixed.time[-1] < fixed.lost
    assert np.isnan(fixed.error(7.0, 8.0)).all()


@pytest.fixture(scope="module")
def light() -> Prepared:
    """Return the aircraft of the closed loop's files, which `prepare` has written."""
    own = load_parameters(CONFIG / "c172p.yaml", "/controller")
    coefficients = load_coefficients(CONFIG / "c172p_coefficients.yaml")
    trim, limits = np.array(own["trim"]), np.array([own["least"], own["largest"]])
    return Prepared("c172p", airframe("c172p"), trim, limits, coefficients)


def test_a_jammed_aileron_is_fatal_under_a_fixed_law_alone(light: Prepared) -> None:
    mission = Mission(duration=10.0, faults=("3: aileron jams 0.06",), seed=1)
    adaptive = fly_loop(light, mission, rate_controller(light))
    fixed = fly_loop(light, mission, rate_controller(light, adaptive=False))
    assert adaptive.lost is None and adaptive.error(3.0, 10.0)[1] < 2.0
    assert fixed.lost is not None


def test_a_lost_aileron_leaves_the_errors_of_pitch_and_yaw_small(light: Prepared) -> None:
    healthy, lost = (
        fly_loop(
            light,
            Mission(duration=10.0, faults=faults, seed=1),
            rate_controller(light),
            make_identifier(light),
        )
        for faults in ((), ("3: aileron effect 0",))
    )
    assert (lost.error(5.0, 10.0)[1:] < 1.3 * healthy.error(5.0, 10.0)[1:]).all()


def test_a_healthy_rudder_that_answers_gyro_noise_does_not_count_as_late(light: Prepared) -> None:
    """The law passes the noise on to the rudder, which hardly moves otherwise."""
    noisy = replace(SENSORS, gyro_noise=0.03)
    mission = Mission(duration=16.0, seed=2, sensors=noisy)
    outcome = fly_loop(light, mission, rate_controller(light), make_identifier(light))
    assert not [why for _, why in outcome.denied if "rdot follows dr badly" in why]
    rudder = [rows[2] for t, rows in outcome.usable if t >= 8.0]
    assert np.mean(rudder) > 0.8
