# SPDX-License-Identifier: Apache-2.0
"""Impossible flights, sensors and faults: each refusal names the wrong value."""

import sys
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

pytest.importorskip("jsbsim", reason="JSBSim is a development extra")

from light_aircraft import LightFlight
from programs import Capture

from uav_ident_ros.simulation import closed_loop
from uav_ident_ros.simulation.faults import parse_fault
from uav_ident_ros.simulation.flight import SimulationError
from uav_ident_ros.simulation.inputs import Segment
from uav_ident_ros.simulation.jsbsim_flight import AircraftFlight, LiveAircraft
from uav_ident_ros.simulation.noise import Sensors, measure
from uav_ident_ros.simulation.plant import PlantFlight
from uav_ident_ros.simulation.quadrotor_flight import LiveQuadrotor, QuadrotorFlight

LONG_DOUBLET = Segment("doublet", amplitudes={"da": 1.5}, unit=2.0)
FOUR = dict.fromkeys(("de", "dr", "da", "dth"), 0.1)
WILD = Segment("multisine", amplitudes={"da": 0.9})


def flown(**changes: object) -> object:
    values = {"segments": (), "duration": 1.0, **changes}
    return PlantFlight(**values).fly()


def jsbsim(**values: object) -> object:
    return AircraftFlight(**{"aircraft": "c172p", "segments": (), "duration": 1.0, **values}).fly()


def sensed(**values: object) -> object:
    return measure(flown(duration=0.1), Sensors(**values))


def faulty(text: str, kind: Callable[..., object] = LiveQuadrotor) -> object:
    return kind(sensors=Sensors(rate=100.0), faults=[parse_fault(text)])


REFUSED: list[tuple[str, Callable[[], object]]] = [
    ("sweep", lambda: Segment("sweep")),
    ("flap", lambda: Segment("multisine", amplitudes={"flap": 0.1})),
    ("at least 4", lambda: Segment("multisine", period=1.0, amplitudes=FOUR).sample(np.zeros(1))),
    ("unit", lambda: Segment("3211", unit=0.0)),
    ("duration", lambda: Segment("quiet", duration=-1.0)),
    ("delay", lambda: flown(delay=0.0105123)),
    ("duration", lambda: flown(duration=0.0)),
    ("rate", lambda: flown(rate=-1.0)),
    ("diverges", lambda: flown(initial_rates=(1e5, 1e5, 1e5))),
    ("no whole number", lambda: LightFlight((), 1.0, actuator_rate=60.0).fly()),
    ("lost", lambda: LightFlight((LONG_DOUBLET,), 10.0).fly()),
    ("turbulence", lambda: jsbsim(turbulence=9)),
    ("bank", lambda: jsbsim(bank=90.0)),
    ("duration", lambda: jsbsim(duration=float("nan"))),
    ("delay", lambda: jsbsim(delay=0.00123456)),
    ("lost at", lambda: QuadrotorFlight((WILD,), 20.0, delay=0.2).fly()),
    (r"delay 0\.0005 s is no whole number", lambda: QuadrotorFlight((), 1.0, delay=0.0005).fly()),
    ("gyro_noise", lambda: sensed(gyro_noise=-0.1)),
    ("gyro_noise", lambda: sensed(gyro_noise=float("nan"))),
    ("gyro_bias", lambda: sensed(gyro_bias=(float("nan"), 0.0, 0.0))),
    ("lever_arm", lambda: sensed(lever_arm=(0.0, float("inf"), 0.0))),
    ("airspeed_bias", lambda: sensed(airspeed_bias=float("nan"))),
    ("drop", lambda: sensed(drop=1.0)),
    ("rate", lambda: sensed(rate=300.0)),
    ("surfaces are elevator, rudder, ail", lambda: parse_fault("flap effect 0.5")),
    ("not within -2 to 2", lambda: parse_fault("aileron effect 3")),
    ("not within", lambda: parse_fault("aileron effect nan")),
    ("is none of", lambda: parse_fault("yaw inertia 1.3")),
    ("is none of", lambda: parse_fault("")),
    ("'half' is no number", lambda: parse_fault("60: aileron effect half")),
    ("'0,5' is no number: decimals need a point", lambda: parse_fault("aileron effect 0,5")),
    ("'soon' is no number", lambda: parse_fault("soon: repaired")),
    ("is none of", lambda: parse_fault("motor_middle effect 0.5")),
    ("MOTOR effect FACTOR", lambda: faulty("5: elevator jams")),
    ("MOTOR effect FACTOR", lambda: faulty("5: turbulence 4")),
    ("surfaces", lambda: faulty("5: motor_rear_left effect 1", partial(LiveAircraft, "c172p"))),
]  # fmt: skip


@pytest.mark.parametrize(("named", "refused"), REFUSED)
def test_the_error_names_an_impossible_flight_sensor_or_fault(
    named: str, refused: Callable[[], object]
) -> None:
    with pytest.raises(SimulationError, match=f"(?s){named}"):
        refused()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ("--duration 0", "duration is 0.0: it must be positive"),
        ("--seed -1", "seed is -1: it must be 0 or more"),
        ("--fault 5:x", "fault '5:x' is none of"),
        ("--duration 60 --fault 60:repaired", "before the end of the flight, at 60 s: '30: rep"),
        ("--duration 60 --fault repaired", "needs a time before the end of the flight, at 60 s"),
        ("--aircraft ufo", "aircraft 'ufo' is not set up here: use one of A4, c172p, "),
        ("--output /dev/null", "File exists: '/dev/null'"),
    ],
)
def test_impossible_options_are_refused_by_name(options: str, named: str, capsys: Capture) -> None:
    assert closed_loop.main(options.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("closed_loop: ") and named in line


def test_without_jsbsim_the_error_names_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jsbsim", None)
    with pytest.raises(SimulationError, match="pip install jsbsim"):
        jsbsim()
