# SPDX-License-Identifier: Apache-2.0
"""The aircraft in the loop: times and limits of commands, and effects of faults."""

from dataclasses import replace

import numpy as np
import pytest

from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.airframe import airframe
from uav_ident_ros.simulation.closed_loop import CONFIG
from uav_ident_ros.simulation.faults import parse_fault
from uav_ident_ros.simulation.flight import SimulationError
from uav_ident_ros.simulation.noise import Sensors

pytest.importorskip("jsbsim", reason="JSBSim is a development extra")

from uav_ident_ros.simulation.jsbsim_flight import LiveAircraft
from uav_ident_ros.simulation.live import Sample

PERFECT = Sensors(rate=100.0)
PULSE = {"aileron": (2, 0), "elevator": (0, 1), "rudder": (1, 2)}
"""Index of each surface, and of its main rate."""


def flown(
    *faults: str,
    surface: str = "aileron",
    size: float = 0.05,
    seconds: float = 0.5,
    sensors: Sensors = PERFECT,
    **options: float,
) -> tuple[LiveAircraft, list[Sample]]:
    """Fly with a constant deflection from the first sample on."""
    aircraft = LiveAircraft("c172p", sensors, faults=[parse_fault(f) for f in faults], **options)
    command = aircraft.trim[:3].copy()
    command[PULSE[surface][0]] += size
    samples = []
    for _ in range(round(seconds * PERFECT.rate)):
        samples.append(aircraft.sample())
        aircraft.command(command)
        aircraft.advance()
    return aircraft, samples


def test_the_airspeed_is_measured_ten_times_a_second() -> None:
    sensors = replace(PERFECT, airspeed_noise=0.0, airspeed_bias=0.5)
    with_pitot, without = (flown(seconds=0.3, sensors=kind)[1] for kind in (sensors, PERFECT))
    measured = {k: s.measured_airspeed for k, s in enumerate(with_pitot) if s.measured_airspeed}
    assert [*measured] == [0, 10, 20]
    assert measured[0] == pytest.approx(airframe("c172p").speed + 0.5, abs=0.3)
    assert {sample.measured_airspeed for sample in without} == {None}


def test_a_command_acts_after_the_delay_and_not_before() -> None:
    steady = flown(size=0.0)[1]
    # steps of 1 ms, ten a sample; the rates follow the surfaces a step later
    for delay, first in ((0.0, 1), (0.038, 4), (0.039, 5)):
        samples = flown(delay=delay)[1]
        moved = [abs(a.rates[0] - b.rates[0]) > 1e-9 for a, b in zip(samples, steady, strict=True)]
        assert moved.index(True) == first


def test_commands_are_limited_to_the_range_of_the_surface() -> None:
    aircraft, _ = flown(size=3.0, seconds=0.02)
    assert aircraft.outputs[2] == pytest.approx(0.26175)
    aircraft.command(None)
    assert aircraft.outputs[2] == pytest.approx(0.26175)  # without a command the last one holds


def test_the_same_seed_gives_the_same_samples() -> None:
    noisy = Sensors(rate=100.0, gyro_noise=0.01, gyro_bias=(0.1, 0.0, 0.0), accelerometer_noise=0.1)

    def samples(seed: int) -> list[Sample]:
        aircraft = LiveAircraft("c172p", noisy, seed=seed)
        return [aircraft.sample() for _ in range(400)]

    flights = [samples(k) for k in (1, 1, 2)]
    first, again, other = (np.array([s.measured_rates for s in flight]) for flight in flights)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.0
    error = first - flights[0][0].rates
    np.testing.assert_allclose(error.mean(axis=0), [0.1, 0.0, 0.0], atol=0.002)
    np.testing.assert_allclose(error.std(axis=0), 0.01, rtol=0.15)


@pytest.fixture(scope="module")
def drift() -> FloatArray:
    """Return the change of the rates at the trim, rad/s."""
    _, samples = flown(size=0.0, seconds=0.15)
    return samples[-1].rates - samples[0].rates


@pytest.mark.parametrize(
    ("surface", "share"), [("aileron", -1.0), ("elevator", 0.5), ("rudder", 0.5)]
)
def test_a_fault_changes_the_rate_in_proportion_to_the_effect(
    surface: str, share: float, drift: FloatArray
) -> None:
    def gained(*faults: str) -> float:
        _, samples = flown(*faults, surface=surface, seconds=0.15)
        return float((samples[-1].rates - samples[0].rates - drift)[PULSE[surface][1]])

    changed = gained(f"0.0: {surface} effect {share}") / gained()
    assert changed == pytest.approx(share, abs=0.06 * abs(share))


def test_a_jammed_surface_is_fixed_until_its_repair() -> None:
    aircraft, samples = flown("1e-1: aileron jams", "0.2: elevator jams -0.03", seconds=0.3)
    held = samples[-1].surfaces
    assert held[2] == pytest.approx(samples[9].surfaces[2])
    assert held[0] == pytest.approx(aircraft.trim[0] - 0.03)
    aircraft.apply(parse_fault("repaired"))
    aircraft.command(aircraft.trim[:3])
    aircraft.advance()
    np.testing.assert_allclose(aircraft.sample().surfaces[:3], aircraft.trim[:3], atol=1e-6)


@pytest.mark.parametrize("axis", ["roll", "pitch"])
def test_ballast_raises_the_inertia_of_its_axis_alone(axis: str) -> None:
    aircraft, _ = flown(seconds=0.02)
    fdm = aircraft.aircraft.fdm
    names = {"roll": "inertia/ixx-slugs_ft2", "pitch": "inertia/iyy-slugs_ft2"}
    before = {name: fdm[name] for name in names.values()}
    centre, mass = fdm["inertia/cg-x-in"], fdm["inertia/mass-slugs"]
    aircraft.apply(parse_fault(f"{axis} inertia 1.3"))
    aircraft.advance()
    other = names["pitch" if axis == "roll" else "roll"]
    assert fdm[names[axis]] == pytest.approx(1.3 * before[names[axis]], rel=0.005)
    assert fdm[other] == pytest.approx(before[other], rel=0.001)
    assert fdm["inertia/cg-x-in"] == pytest.approx(centre, abs=0.01)
    assert mass < fdm["inertia/mass-slugs"] < 1.1 * mass


def test_turbulence_begins_at_its_time() -> None:
    _, samples = flown("2.0: turbulence 4", size=0.0, seconds=6.0)
    rates = np.array([sample.rates for sample in samples])
    assert np.abs(rates[:200]).max() < 0.02
    assert rates[300:].std() > 0.01


def test_the_centre_of_gravity_moves_by_a_share_of_the_chord_and_ballast_ends() -> None:
    aircraft = LiveAircraft("T37", PERFECT)  # its model has no point masses
    fdm = aircraft.aircraft.fdm
    before = fdm["inertia/cg-x-in"]
    aircraft.apply(parse_fault("cg aft 0.05"))
    assert fdm["inertia/cg-x-in"] - before == pytest.approx(0.05 * 12 * fdm["metrics/cbarw-ft"])
    for axis in ("roll", "pitch"):
        aircraft.apply(parse_fault(f"{axis} inertia 1.1"))
    with pytest.raises(SimulationError, match="ballasts are in use"):
        aircraft.apply(parse_fault("pitch inertia 1.1"))


@pytest.mark.parametrize(
    ("name", "thrust", "share"),
    [
        ("T37", "propulsion/engine[1]/thrust-lbs", 0.3),
        ("ultra_stick_25e", "fcs/throttle-pos-norm", 0.05),
    ],
)
def test_an_engine_failure_removes_the_thrust(name: str, thrust: str, share: float) -> None:
    aircraft = LiveAircraft(name, PERFECT)
    fdm = aircraft.aircraft.fdm
    before = fdm[thrust]
    aircraft.apply(parse_fault("engine out"))
    for _ in range(200):
        aircraft.command(None)
        aircraft.advance()
    assert fdm[thrust] < share * before


def test_the_configured_trim_is_the_trim_of_the_plant() -> None:
    trim = LiveAircraft("c172p", PERFECT).trim
    path = CONFIG / "c172p.yaml"
    configured = load_parameters(path, "/identifier")["actuators.trim"]
    np.testing.assert_allclose(configured, trim, atol=1e-6)
