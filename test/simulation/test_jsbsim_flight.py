# SPDX-License-Identifier: Apache-2.0
"""JSBSim flights and their true derivatives, compared with flights and published values."""

import dataclasses

import numpy as np
import pytest
from programs import Capture

from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.simulation.aircraft import STATES, differentiate, linearise_cruise
from uav_ident_ros.simulation.airframe import airframe, airframe_names
from uav_ident_ros.simulation.faults import Fault
from uav_ident_ros.simulation.flight import Flight
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.jsbsim_flight import AircraftFlight, LiveAircraft
from uav_ident_ros.simulation.noise import Sensors

pytest.importorskip("jsbsim", reason="JSBSim is a development extra")

SMALL = 0.4
"""Share of the usual excitation: small, since the derivatives are local."""


def spec_of(name: str, duration: float = 15.0, **changes: object) -> AircraftFlight:
    peaks = {key: SMALL * peak for key, peak in airframe(name).excitation.items()}
    segment = Segment("multisine", start=2.0, amplitudes=peaks)
    return AircraftFlight((segment,), duration, aircraft=name, **changes)


@pytest.fixture(scope="module")
def cessna() -> Flight:
    return spec_of("c172p").fly()


@pytest.mark.parametrize("name", airframe_names())
def test_the_true_derivatives_predict_the_accelerations_of_every_aircraft(name: str) -> None:
    flight = spec_of(name, rate=200.0).fly()
    truth = linearise_cruise(name).derivatives
    matrix = np.array(
        [
            [truth[f"{row}/{name}"] for name in (*STATES, *INPUTS)]
            for row in ("pdot", "qdot", "rdot")
        ]
    )
    u = flight.extra["surfaces"] - flight.trim
    x = np.column_stack([flight.rates, flight.extra["beta"], flight.extra["alpha"]])
    x = x - x[0]
    expected = np.hstack([x, u]) @ matrix.T
    error = flight.angular_acceleration - flight.angular_acceleration[0] - expected
    rows = [1] if name == "A4" else [0, 1, 2]  # its yaw damper saturates
    unexplained = error.std(axis=0) / flight.angular_acceleration.std(axis=0)
    assert (unexplained[rows] < 0.2).all(), unexplained
    assert np.abs(flight.extra["roll"]).max() < np.radians(25.0)
    assert np.abs(flight.extra["altitude"] - airframe(name).altitude).max() < 60.0
    assert np.abs(flight.airspeed / airframe(name).speed - 1.0).max() < 0.15


def test_a_flight_at_another_speed_has_the_derivatives_of_that_speed() -> None:
    slow, usual = (
        spec_of("ultra_stick_25e", 6.0, speed=15.0, rate=200.0).fly(),
        spec_of("ultra_stick_25e", 6.0, rate=200.0).fly(),
    )
    assert slow.airspeed.mean() == pytest.approx(15.0, rel=0.02)
    ratio = slow.local_truth["pdot/da"] / usual.local_truth["pdot/da"]
    assert ratio == pytest.approx((15.0 / 17.0) ** 2, rel=0.02)


def test_specific_force_is_at_the_centre_of_gravity(cessna: Flight) -> None:
    # From the kinematics alone: velocity over the air (calm) turned with the body, minus
    # gravity. Independent of JSBSim's forces and masses.
    v, alpha, beta = cessna.airspeed, cessna.extra["alpha"], cessna.extra["beta"]
    roll, pitch = cessna.extra["roll"], cessna.extra["pitch"]
    body = v[:, None] * np.column_stack(
        [np.cos(alpha) * np.cos(beta), np.sin(beta), np.sin(alpha) * np.cos(beta)]
    )
    gravity = 9.80665 * np.column_stack(
        [-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)]
    )
    slope = np.gradient(body, 1.0 / cessna.rate, axis=0)
    kinematic = slope + np.cross(cessna.rates, body) - gravity
    smooth = np.ones(50) / 50.0
    for axis in range(3):
        error = np.convolve(kinematic[:, axis] - cessna.specific_force[:, axis], smooth, "valid")
        assert np.sqrt(np.mean(error**2)) < 0.05
    # a metre ahead the specific force differs
    away = cessna.force_at((1.0, 0.0, 0.0)) - cessna.specific_force
    assert np.sqrt(np.mean(away[:, 1:] ** 2)) > 0.15


def test_banked_flight_turns_to_both_sides() -> None:
    flight = AircraftFlight((), 40.0, 200.0, aircraft="c172p", bank=25.0).fly()
    roll = np.degrees(flight.extra["roll"])
    assert 20.0 < roll.max() < 30.0 and -30.0 < roll.min() < -20.0


def test_turbulence_is_seeded() -> None:
    spec = AircraftFlight((), 5.0, 200.0, aircraft="c172p", turbulence=3, seed=4)
    first, again = spec.fly(), spec.fly()
    other = dataclasses.replace(spec, seed=5).fly()
    calm = dataclasses.replace(spec, turbulence=0).fly()
    np.testing.assert_array_equal(first.rates, again.rates)
    assert np.abs(first.rates - other.rates).max() > 1e-3
    assert calm.rates.std() < 0.1 * first.rates.std()


def test_nothing_is_printed(capfd: Capture) -> None:
    AircraftFlight((), 0.1, aircraft="c172p").fly()
    assert capfd.readouterr() == ("", "")


# Of the c172p at 175 ft/s and 3000 ft, determined independently.
KNOWN = {
    "pdot/p": -6.81, "pdot/r": 1.38, "pdot/dr": 3.24, "pdot/da": 31.2, "pdot/beta": -15.5,
    "qdot/q": -5.59, "qdot/de": -27.3, "qdot/alpha": -33.4,
    "rdot/p": -0.277, "rdot/r": -0.785, "rdot/dr": -4.33, "rdot/da": -0.230, "rdot/beta": 4.83,
}  # fmt: skip


def test_the_derivatives_of_the_c172p_equal_the_known_ones() -> None:
    found = linearise_cruise("c172p").derivatives
    for key, value in KNOWN.items():
        assert found[key] == pytest.approx(value, rel=0.01), key


def test_the_small_aeroplane_has_its_published_derivatives() -> None:
    """Computed by hand from the published coefficients: q S b / I, and Ixz in roll and yaw."""
    found = linearise_cruise("ultra_stick_25e")
    ix, iy, iz, ixz = 0.07151, 0.08636, 0.15364, 0.014
    density = 1.225 * (1.0 - 2.25577e-5 * 300.0) ** 4.2559  # standard atmosphere at 300 m
    force = 0.5 * density * found.airspeed**2 * 0.3097
    inertia = np.array([[ix, -ixz], [-ixz, iz]])
    per_moment = force * 1.27 * np.linalg.inv(inertia)
    half_span, half_chord = (length / (2.0 * found.airspeed) for length in (1.27, 0.25))
    arm = 0.222 - 0.2175  # from the centre of gravity forward to the forces, m
    for label, side, roll, yaw in (
        ("da", 0.0, 0.1646, -0.0574),
        ("dr", 0.1913, 0.0115, -0.1811),
        ("beta", -0.4889, -0.0545, 0.0723),
        ("p", -0.0375 * half_span, -0.4496 * half_span, 0.118 * half_span),
        ("r", 0.15 * half_span, 0.1086 * half_span, -0.1833 * half_span),
    ):
        pdot, rdot = per_moment @ [roll, yaw + side * arm / 1.27]
        assert found.derivatives[f"pdot/{label}"] == pytest.approx(pdot, rel=0.02, abs=0.05)
        assert found.derivatives[f"rdot/{label}"] == pytest.approx(rdot, rel=0.02, abs=0.05)
    for label, lift, pitch in (
        ("de", 0.0983, -0.8488),
        ("alpha", 4.58, -0.723),
        ("q", 6.1639 * half_chord, -13.5664 * half_chord),
    ):
        qdot = force * 0.25 * (pitch + lift * arm / 0.25) / iy
        assert found.derivatives[f"qdot/{label}"] == pytest.approx(qdot, rel=0.02)


def test_more_pitch_inertia_reduces_every_pitch_derivative() -> None:
    live = LiveAircraft("c172p", Sensors(rate=100.0))
    before = differentiate(live.aircraft).derivatives
    live.apply(Fault("inertia", "pitch", 1.3))
    after = differentiate(live.aircraft).derivatives
    for name in ("qdot/de", "qdot/q", "qdot/alpha"):
        assert after[name] / before[name] == pytest.approx(1.0 / 1.3, rel=0.02), name
    assert after["pdot/da"] == pytest.approx(before["pdot/da"], rel=0.02)
