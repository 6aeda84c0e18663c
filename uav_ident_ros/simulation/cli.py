# SPDX-License-Identifier: Apache-2.0
"""`simulate`: record the flight of a plant of the paper's structure or a JSBSim aircraft."""

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

from uav_ident_ros.commandline import USAGE_ERROR, OneLineParser, given_path
from uav_ident_ros.identification.settings import MAX_DELAY
from uav_ident_ros.identification.structure import INPUTS
from uav_ident_ros.messages.types import FRAME_IDS
from uav_ident_ros.simulation.airframe import airframe, airframe_names
from uav_ident_ros.simulation.channels import CHANNEL_SETS
from uav_ident_ros.simulation.flight import SimulationError
from uav_ident_ros.simulation.inputs import INPUT_KINDS, ColouredNoise, Segment
from uav_ident_ros.simulation.jsbsim_flight import AircraftFlight
from uav_ident_ros.simulation.live import SIMULATION_RATE, Plan
from uav_ident_ros.simulation.noise import Sensors, measure
from uav_ident_ros.simulation.plant import VEHICLES, PlantFlight
from uav_ident_ros.simulation.quadrotor_flight import AMPLITUDES, QuadrotorFlight
from uav_ident_ros.simulation.quadrotor_flight import NAME as QUADROTOR

START = 2.0
"""Time before the excitation begins, s."""

PLANT_AMPLITUDES = (0.08, 0.12, 0.06, 0.2)
"""Default excitation peaks of de, dr, da (rad), dth of a plant; an aircraft has its own."""

FORCE_NOISE = ColouredNoise(0.3, 0.5)
"""Noise of a plant's specific force, m/s^2 and s; the plant's structure does not determine it."""

_DESCRIPTION = """\
Fly a simulated aircraft and write an MCAP bag with /imu/data (sensor_msgs/Imu) and /actuators
(sensor_msgs/JointState, or std_msgs/Float64MultiArray with --unstamped). Beside the bag it
writes identifier.yaml, the parameters that describe these topics, and truth.yaml, the true
coefficients."""

_EPILOG = """\
examples:
  simulate --output flight                         90 s of multisines at 200 Hz, stamped
  simulate --output pulses --input 3211 --unstamped --noise 0
  simulate --output quiet --duration 60 --quiet 600 --autopilot --gusts 1.0
  simulate --output quadrotor --plant quadrotor --delay 0.01
  simulate --output cessna --jsbsim c172p --delay 0.06 --airspeed-noise 0.3
"""


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = OneLineParser(
        prog="simulate",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )

    def number(
        name: str, default: float, unit: str, meaning: str, field: str | None = None
    ) -> None:
        help_ = f"{meaning} ({default:g})"
        add(name, dest=field, type=type(default), default=default, metavar=unit, help=help_)

    add = parser.add_argument
    add("--output", required=True, type=given_path, metavar="DIR", help="folder of the new bag")
    add("--compress", action="store_true", help="compress the bag with zstd")

    flight = parser.add_argument_group("flight")
    add, peaks = flight.add_argument, " ".join(f"{v:g}" for v in PLANT_AMPLITUDES)
    add("--plant", choices=(*VEHICLES, QUADROTOR),
        help="plant of the paper's structure (small_uav), or a quadrotor in hover")  # fmt: skip
    add("--jsbsim", metavar="AIRCRAFT",
        help=f"a JSBSim aircraft instead: {', '.join(airframe_names())}, "
             "or a file like theirs")  # fmt: skip
    add("--speed", type=float, metavar="M/S", help="aircraft: true airspeed (its own)")
    add("--input", choices=INPUT_KINDS, default="multisine", help="excitation (multisine)")
    add("--amplitude", nargs=4, type=float, metavar=("DE", "DR", "DA", "DTH"),
        help=f"peaks, rad and throttle 0..1 ({peaks}; others have their own)")  # fmt: skip
    add("--autopilot", action="store_true",
        help="plant: feedback of rates and angles (an aircraft always has one)")  # fmt: skip
    number("--duration", 90.0, "S", "length of the excited flight, s")
    number("--quiet", 0.0, "S", "unexcited flight after it, s")
    number("--gusts", 0.0, "RMS", "plant: coloured angular acceleration, rad/s^2 rms")
    number("--turbulence", 0, "LEVEL", "aircraft: MIL-F-8785C severity 0 (calm) to 7")
    number("--bank", 0.0, "DEG", "aircraft: bank angle of alternating turns, deg")
    number("--delay", 0.0, "S", "from recorded command to surface, s")
    number("--servo-lag", 0.0, "S",
        "plant: time constant of the servos, s; of motors 0.05 by default")  # fmt: skip
    number("--actuator-rate", 100.0, "HZ", "rate of the commands, each held until the next, Hz")
    number("--seed", 0, "N", "seed of all randomness")

    sensors = parser.add_argument_group("sensors and messages")
    add = sensors.add_argument
    add("--bias", dest="gyro_bias", nargs=3, type=float, default=(0.0, 0.0, 0.0),
        metavar=("P", "Q", "R"), help="gyro bias, FRD, rad/s (0 0 0)")  # fmt: skip
    add("--lever-arm", nargs=3, type=float, default=(0.0, 0.0, 0.0), metavar=("X", "Y", "Z"),
        help="accelerometer from the centre of gravity, FRD, m (0 0 0)")  # fmt: skip
    add("--convention", choices=tuple(FRAME_IDS), default="flu", help="axes of the Imu (flu)")
    add("--airspeed-noise", type=float, metavar="RMS",
        help="aircraft: /airspeed is recorded, with this noise, m/s")  # fmt: skip
    add("--unstamped", dest="stamped", action="store_false",
        help="actuators as Float64MultiArray, no stamp")  # fmt: skip
    add("--channels", choices=tuple(CHANNEL_SETS),
        help="what the raw actuator channels are (plain; motors)")  # fmt: skip
    number("--imu-rate", 200.0, "HZ", "Imu rate, Hz", "rate")
    number("--noise", 0.02, "RMS", "gyro noise, rad/s", "gyro_noise")
    number("--accelerometer-noise", 0.1, "RMS", "accelerometer noise, m/s^2")
    number("--jitter", 0.0, "S", "Imu stamps are off by up to this, s", "stamp_jitter")
    number("--drop", 0.0, "FRACTION", "fraction of Imu messages lost at random")
    number("--latency", 0.0, "S", "mean of log time minus sampling time, s")
    return parser


def flight_from(options: argparse.Namespace) -> tuple[Plan, Sensors]:
    """Return the flight of the options, and the sensors that measure it."""
    kind: type[Plan]
    if options.jsbsim:
        kind, peaks = AircraftFlight, airframe(options.jsbsim, options.speed).excitation
        own: dict[str, Any] = {"aircraft": options.jsbsim}
        own |= {name: getattr(options, name) for name in ("speed", "turbulence", "bank")}
    else:
        kind, peaks = QuadrotorFlight, AMPLITUDES
        own = {"gusts": ColouredNoise(options.gusts)}
        own |= {"time_constant": options.servo_lag} if options.servo_lag else {}
        if options.plant != QUADROTOR:
            kind, peaks = PlantFlight, dict(zip(INPUTS, PLANT_AMPLITUDES, strict=True))
            own |= {"vehicle": VEHICLES[options.plant or "small_uav"], "force": FORCE_NOISE}
            own["autopilot"] = options.autopilot
    if options.amplitude:
        peaks = dict(zip(INPUTS, options.amplitude, strict=True))
    excited = max(0.0, options.duration - START)
    plan = kind(
        (Segment(options.input, START, excited, peaks),),
        options.duration + options.quiet,
        # every Imu rate that divides the default rate then measures the same flight
        SIMULATION_RATE if SIMULATION_RATE % options.rate == 0.0 else options.rate,
        actuator_rate=options.actuator_rate,
        delay=options.delay,
        seed=options.seed,
        **own,
    )
    given = {field.name: getattr(options, field.name, None) for field in fields(Sensors)}
    return plan, Sensors(**{name: v for name, v in given.items() if v is not None})


def _check(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    if options.plant and options.jsbsim:
        parser.error("--plant and --jsbsim exclude each other")
    others, owner = (
        (("gusts", "servo_lag", "autopilot"), "a plant")
        if options.jsbsim
        else (("turbulence", "bank", "speed", "airspeed_noise"), "an aircraft (--jsbsim)")
    )
    for name in others:
        if getattr(options, name) != parser.get_default(name):
            parser.error(f"--{name.replace('_', '-')} belongs to {owner}")
    if options.plant == QUADROTOR and options.autopilot:
        parser.error("--autopilot: the quadrotor always has one")
    if not options.rate > 0.0:
        parser.error(f"--imu-rate is {options.rate:g}: it must be positive")
    if not 0.0 <= options.delay <= MAX_DELAY:
        parser.error(f"--delay is {options.delay:g}: 0 to {MAX_DELAY:g} s are identified")
    if not options.quiet >= 0.0:
        parser.error(f"--quiet is {options.quiet:g}: it must be 0 or more")
    if not all(math.isfinite(v) for v in options.amplitude or ()):
        parser.error(f"--amplitude is {options.amplitude}: it must be four finite numbers")
    if options.seed < 0:
        parser.error(f"--seed is {options.seed}: it must be 0 or more")
    if options.output.exists():
        parser.error(f"--output: '{options.output}' exists already: choose another")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the return value is the exit status."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    _check(parser, options)
    from uav_ident_ros.bags.writing import BagWriteError  # help needs none of these
    from uav_ident_ros.simulation.recording import write_bag

    try:
        plan, sensors = flight_from(options)
        flight = plan.fly(options.output.name)
        if options.channels:
            flight = replace(flight, channel_set=CHANNEL_SETS[options.channels])
        measured = measure(flight, sensors, options.seed)
        write_bag(measured, options.output, options.compress)
    except (SimulationError, BagWriteError, OSError) as error:
        print(f"simulate: {error}", file=sys.stderr)
        return USAGE_ERROR
    print(
        f"{options.output}: {len(measured.imu_t_ns)} Imu and {len(measured.actuators)} actuator "
        f"messages, {measured.flight.duration:.1f} s"
    )
    return 0
