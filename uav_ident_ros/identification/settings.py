# SPDX-License-Identifier: Apache-2.0
"""Declaration of every setting.

The ROS parameters and their descriptors, the validation, the replay's options and the table
in the documentation are all generated from the dataclasses below.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import typing
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from operator import attrgetter
from typing import Any

from uav_ident_ros.identification.scales import IN_A_ROW
from uav_ident_ros.identification.structure import INPUTS, ROWS, STRUCTURES

Value = bool | int | float | str | tuple[float, ...] | tuple[int, ...] | tuple[str, ...]


class SettingsError(ValueError):
    """A setting is unknown, of the wrong type or outside what is allowed; the message names it."""


@dataclass(frozen=True)
class Setting:
    """Declaration of one setting."""

    name: str  # Dotted, as in the parameter file
    type: str  # ``bool``, ``int``, ``float``, ``str``, ``float[]``, ``str[]`` or ``int[]|str[]``
    default: Value
    unit: str  # Physical; empty for a pure number or a word
    description: str  # One or two sentences: its meaning, and when to change it
    # Inclusive range of a number or of every entry of an array
    low: float = -math.inf
    high: float = math.inf
    choices: Collection[str] = ()  # Allowed words; empty if any is
    optional: bool = False  # Whether it may be empty as well
    read_only: bool = True  # Whether it cannot change while the identifier runs
    # Whether a change restarts the filters and increases sigma as at a warm start, because the
    # signals were conditioned differently before
    restarts: bool = False

    @property
    def bounded(self) -> bool:
        """Whether there is a lowest or a highest value."""
        return math.isfinite(self.low) or math.isfinite(self.high)

    def check(self, value: object) -> Value:
        """Return `value` in its canonical type.

        Raises
        ------
        SettingsError
            If it is of the wrong type, not finite, out of range or not among the choices.
        """
        if isinstance(value, (list, tuple)) or hasattr(value, "tolist"):
            value = tuple(value)  # type: ignore[arg-type]
        given = list(value) if isinstance(value, tuple) else value  # As the user writes it
        fits, wanted = _KINDS[self.type]
        if not fits(value):
            if self.type == "float" and _is(int, value):
                wanted = f"that is an integer: write {float(typing.cast(int, value))}"
            raise SettingsError(f"'{self.name}' is {given!r}: {wanted}")
        for entry in value if isinstance(value, tuple) else (value,):
            if not isinstance(entry, str):
                number = float(typing.cast(float, entry))
                if not self.low <= number <= self.high:  # NaN fails too
                    raise SettingsError(f"'{self.name}' is {given!r}: allowed is {self.allowed()}")
            elif self.choices and entry not in self.words:
                hint = f"; {meant}" if (meant := nearest(entry, self.words)) else ""
                allowed = f"allowed are {self.allowed()}{hint}"
                raise SettingsError(f"'{self.name}' is '{entry}': {allowed}")
        return typing.cast(Value, value)

    @property
    def words(self) -> tuple[str, ...]:
        """The choices, and an empty one first if it is optional."""
        return ("", *self.choices) if self.optional else tuple(self.choices)

    def allowed(self) -> str:
        """Return a text of the allowed values, with the unit."""
        if self.choices:
            return ", ".join(word or '""' for word in self.words)
        if "str" in self.type or self.type == "bool":
            return "any"
        unit = f" {self.unit}" if self.unit else ""
        low, high = (f"{bound:g}" for bound in (self.low, self.high))
        if not self.bounded:
            return f"any finite value{unit}"
        if math.isinf(self.high):
            return f"{low}{unit} or more"
        return f"{low} to {high}{unit}"


def _is(kind: type, value: object) -> bool:
    """Whether a value is of a type: a bool is not an int, and a float must be finite."""
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        return False
    return not isinstance(value, float) or math.isfinite(value)


def _are(kind: type, value: object) -> bool:
    return isinstance(value, tuple) and all(_is(kind, entry) for entry in value)


def _are_channels(value: object) -> bool:
    """Whether a value is a tuple of names, or of indices from 0 on."""
    indices = _are(int, value) and min(typing.cast(tuple[int, ...], value), default=-1) >= 0
    return bool(value) and (_are(str, value) or indices)


_KINDS: dict[str, tuple[Callable[[object], bool], str]] = {
    "bool": (partial(_is, bool), "write true or false"),
    "int": (partial(_is, int), "write a whole number, without a decimal point"),
    "float": (partial(_is, float), "write a finite number with a decimal point, like 0.5"),
    "str": (partial(_is, str), "write a word, in quotes if it looks like a number"),
    "float[]": (
        partial(_are, float),
        "write a list of finite numbers, each with a decimal point, like [1.0, 0.5]",
    ),
    "str[]": (partial(_are, str), "write a list of words"),
    "int[]|str[]": (_are_channels, "write a list of indices from 0, or a list of names"),
}
"""For each type of a setting: its test, and the advice if a value fails it."""

_ARRAYS = {
    "tuple[float, ...]": "float[]",
    "tuple[str, ...]": "str[]",
    "tuple[int, ...] | tuple[str, ...]": "int[]|str[]",
}
"""Types of arrays by their annotations; those of single values are alike."""


def _setting(
    default: Any,
    unit: str = "",
    within: tuple[float, float] = (-math.inf, math.inf),
    *,
    text: str,
    choices: Collection[str] = (),
    optional: bool = False,
    read_only: bool = True,
    restarts: bool = False,
) -> Any:
    """Declare one setting as a dataclass field; the field supplies name and type."""
    fixed = read_only and not restarts
    own = Setting("", "", default, unit, text, *within, choices, optional, fixed, restarts)
    return dataclasses.field(default=default, metadata={"setting": own})


LARGEST_NUMBER = 1e6
"""Largest plausible magnitude of a coefficient in SI units, and of a channel, its trim, scale and
weights: radians, fractions, PWM microseconds and motor speeds are all smaller."""

PLAUSIBLE = (-LARGEST_NUMBER, LARGEST_NUMBER)
"""Range of these values."""

MAX_DELAY = 0.5
"""Longest transport delay that the sample buffers cover, s."""

RATE_TYPES: dict[str, Any] = {}
ACTUATOR_TYPES: dict[str, Any] = {}
AIRSPEED_TYPES: dict[str, Any] = {}
ARMED_TYPES: dict[str, Any] = {}
"""Message types of the inputs, by name: `messages/types.py` has them, and enters their readers.
Without it, in a program that reads no messages, any name is allowed."""

ESTIMATORS = ("gradient", "least_squares", "instrumental_variable")

NO_FILE = "none"
"""Value of ``state_file`` that switches it off."""


# fmt: off
# One table: default, unit, range; meaning, and when to change it.


@dataclass(frozen=True)
class ImuSettings:
    """Type, axes and position of the Imu."""

    type: str = _setting("sensor_msgs/msg/Imu", choices=RATE_TYPES, text=
        "Message type of the rates topic. Set it to what the topic carries.")
    convention: str = _setting("flu", choices=("flu", "frd"), text=
        "Axes of the rates: 'flu' (forward-left-up, REP-103) or 'frd' (forward-right-down). A "
        "frame_id ending in _frd or _ned contradicts 'flu' and is a fault. PX4's own topics are "
        "'frd', MAVROS and most drivers 'flu'.")
    rpy: tuple[float, ...] = _setting((0.0, 0.0, 0.0), "rad", (-math.pi, math.pi), text=
        "Roll, pitch, yaw of the sensor in the body, after the convention is applied (FRD). Set "
        "them if the sensor is not mounted along the body's axes.")
    lever_arm: tuple[float, ...] = _setting(
        (0.0, 0.0, 0.0), "m", (-100.0, 100.0), restarts=True, text=
        "Position of the sensor from the centre of gravity, FRD. It removes the rotation's own "
        "accelerations from ay and az. Set it if the sensor is more than some centimetres away.")


@dataclass(frozen=True)
class MixingSettings:
    """Rows of the mixing matrix M in u = M (raw - trim)."""

    de: tuple[float, ...] = _setting((1.0, 0.0, 0.0, 0.0), "", PLAUSIBLE, text=
        "Elevator from the channels: one weight per channel. Change it for elevons and V-tails.")
    dr: tuple[float, ...] = _setting((0.0, 1.0, 0.0, 0.0), "", PLAUSIBLE, text=
        "Rudder from the channels: one weight per channel. Change it for V-tails.")
    da: tuple[float, ...] = _setting((0.0, 0.0, 1.0, 0.0), "", PLAUSIBLE, text=
        "Aileron from the channels: one weight per channel. Change it for elevons and flaperons.")
    dth: tuple[float, ...] = _setting((0.0, 0.0, 0.0, 1.0), "", PLAUSIBLE, text=
        "Throttle from the channels: one weight per channel. Change it for several motors, which "
        "share it.")


@dataclass(frozen=True)
class ActuatorSettings:
    """Actuator channels: meaning, units, limits and timing."""

    type: str = _setting("std_msgs/msg/Float64MultiArray", choices=ACTUATOR_TYPES, text=
        "Message type of the actuator topic. Set it to what the topic carries.")
    field: str = _setting("", text=
        "Array field of the message that holds the channels; empty for the type's usual one. Set "
        "it for a message with several arrays.")
    channels: tuple[int, ...] | tuple[str, ...] = _setting((0, 1, 2, 3), text=
        "Indices (from 0) or, where the message names them, names of the N channels in use. Set "
        "them to the aircraft's surfaces and throttle.")
    mixing: MixingSettings = dataclasses.field(default_factory=MixingSettings)
    scale: tuple[float, ...] = _setting((), "", PLAUSIBLE, text=
        "Factor of each channel before the mixing, N values; negative reverses. Empty: ones. Set "
        "it to bring raw values to radians or fractions.")
    thrust_curve: tuple[float, ...] = _setting((), "", (0.0, 1.0), text=
        "Quadratic share f of each channel's thrust, N values: thrust = f s^2 + (1 - f) s, for "
        "scaled commands s from 0 to 1. Empty: zeros. Set 1.0 where a command is a motor's speed,"
        " 0.0 for a surface and where the autopilot sends thrust (PX4 with THR_MDL_FAC).")
    trim: tuple[float, ...] = _setting((), "", PLAUSIBLE, restarts=True, text=
        "Raw value of each channel in trimmed flight, N values. Empty: zeros. Set it to the "
        "values of steady level flight.")
    learn_trim_time: float = _setting(0.0, "s", (0.0, 60.0), text=
        "Learn the trim from the first steady stretch of flight of this length; 0 uses "
        "'actuators.trim'. Use it if the trim is not known and the flight begins steady.")
    delay: float = _setting(0.0, "s", (0.0, MAX_DELAY), restarts=True, text=
        "Transport delay from the channel's stamp to the surface. A delay error of 50 ms costs "
        "more accuracy than any choice of estimator. Set it if it is known from a bench test or "
        "from replay.")
    estimate_delay: bool = _setting(False, text=
        "Estimate the delay in flight, starting from 'actuators.delay', and use it once it is "
        "sure; the servo lag likewise, if an injected signal shows it. Switch it on if the delay "
        "is not known.")
    longest_delay: float = _setting(0.3, "s", (0.1, MAX_DELAY), restarts=True, text=
        "Longest delay that is searched in flight, beyond 'actuators.time_constant'. Raise it for"
        " inputs that come over a slow link.")
    time_constant: float = _setting(0.0, "s", (0.0, 2.0), restarts=True, text=
        "First-order lag of the servos or motors; 0 for none. Set it if the channels are "
        "commands, not positions.")
    interpolation: str = _setting("hold", choices=("hold", "linear"), text=
        "Input between two samples: held ('hold', as a servo does) or joined by a straight line "
        "('linear', for logged surface positions).")
    lower_limit: tuple[float, ...] = _setting((), text=
        "Raw value of each channel at its lower limit, N values. Learning pauses there, because "
        "the surface may not follow. Empty: no limits. Set it if commands can exceed the travel of"
        " a surface.")
    upper_limit: tuple[float, ...] = _setting((), text=
        "Raw value of each channel at its upper limit, N values, as 'actuators.lower_limit'. "
        "Empty: no limits. Set it if commands can exceed the travel of a surface.")
    timeout: float = _setting(0.5, "s", (0.01, 60.0), text=
        "Age at which the last channel values expire and learning waits for new ones. At a steady"
        " rate they expire sooner, after five intervals or 0.1 s. Raise it for publishers that "
        "send changes only.")

    @property
    def multirotor(self) -> bool:
        """Whether channels that lift it also roll or pitch it, as a multirotor's motors do."""
        rows = self.mixing
        shared = zip(rows.de, rows.da, rows.dth, strict=False)
        return any(dth and (de or da) for de, da, dth in shared)

    def has(self, name: str) -> bool:
        """Whether the vehicle has the input `name`, one of de dr da dth: its row is not zero."""
        return any(getattr(self.mixing, name))


@dataclass(frozen=True)
class FilterSettings:
    """The state-variable filter of the regressors."""

    method: str = _setting(
        "state_variable", choices=("state_variable", "backward_difference"), text=
        "Source of the derivative: 'state_variable' (the same low-pass on both sides of the "
        "equation, at the gyro's rate) or 'backward_difference' of the rates at the ticks, as in "
        "the paper. Change it to reproduce the paper alone.")
    cutoff: float = _setting(15.0, "rad/s", (1.0, 200.0), restarts=True, text=
        "Cut-off of the low-pass: above the fastest mode of interest, below the gyro's noise and "
        "the structure's vibrations. 10 to 20 suits most small aircraft. Raise it for small, "
        "agile ones.")
    max_gap: float = _setting(0.2, "s", (0.01, 1.0), text=
        "Longest gap in the rates that the filters bridge; a longer one restarts them. Raise it "
        "for a lossy link.")


@dataclass(frozen=True)
class ModelSettings:
    """The identified model that runs beside the aircraft."""

    leak_time: float = _setting(5.0, "s", (0.0, 1000.0), read_only=False, text=
        "Time constant of the pull of the model's state towards the measured rates; 0 for none, "
        "as in the paper. Lower it if the predicted rates drift in long flights.")
    inertia: tuple[float, ...] = _setting((), "kg m^2", text=
        "Known inertias Ix, Iy, Iz, Ixz, which fix the coefficients of the rate products. Empty: "
        "these are estimated. Set them if they are measured: fewer coefficients to learn.")


@dataclass(frozen=True)
class GradientSettings:
    """The paper's law Am_dot = e f^T K."""

    gains: tuple[float, ...] = _setting((), text=
        "K: n diagonal entries, or n*n entries row-major, symmetric positive semi-definite, for n "
        "regressors. Empty: 0.15 on the diagonal. Raise them for faster, noisier coefficients.")
    normalisation: str = _setting("variance", choices=("none", "power", "variance"), text=
        "Reference of the gains: 'none' (SI units, as in the paper), 'power' (divided by 1 + f^T "
        "K f) or 'variance' (each divided by its regressor's running variance: rates in 1/s). "
        "Change it to compare with the paper's gains.")
    step: str = _setting("guarded", choices=("guarded", "euler"), text=
        "Step of the law: 'guarded', the exact solution, stable for any gain; or 'euler', the "
        "paper's, which diverges once dt f^T K f exceeds 2, and reports it. Change it to "
        "reproduce the paper alone.")


@dataclass(frozen=True)
class AirspeedSettings:
    """Airspeed, for coefficients that hold across flight speeds."""

    type: str = _setting("", choices=AIRSPEED_TYPES, optional=True, text=
        "Message type of the airspeed topic; empty for none. With one, damping is scaled with the "
        "airspeed and control derivatives with its square. Set it if the flight speed varies by a "
        "fifth or more.")
    reference: float = _setting(20.0, "m/s", (1.0, 400.0), text=
        "Airspeed at which initial and saved coefficients hold: the usual true airspeed. It also "
        "serves as the airspeed, within 20 %, if none is measured. Set it once, before the first "
        "flight.")


@dataclass(frozen=True)
class ArmedSettings:
    """Armed state of the motors: the identifier learns in flight only."""

    type: str = _setting("", choices=ARMED_TYPES, optional=True, text=
        "Message type of the armed topic; empty for none. With one, coefficients move only while "
        "the vehicle is armed. Set it if the autopilot publishes it.")


EXCITATION_FORMS = ("multisine", "3211", "doublet", "probe")


@dataclass(frozen=True)
class ExcitationSettings:
    """Programmed test inputs, which the controller adds after a call of ``~/excite``."""

    form: str = _setting("multisine", choices=EXCITATION_FORMS, read_only=False, text=
        "Test input: 'multisine' moves all inputs at once, each at frequencies of its own; '3211'"
        " and 'doublet' move one after the other; 'probe' is one doublet of each, to confirm "
        "signs and effect after take-off.")
    amplitude: tuple[float, ...] = _setting(
        (0.04, 0.04, 0.04, 0.0), "rad, throttle 0..1", (0.0, 1e3), read_only=False, text=
        "Peak of de, dr, da, dth, in the units of the inputs; 0 leaves one out. Set it to a tenth "
        "of the range of each surface.")
    band: tuple[float, ...] = _setting((0.2, 2.0), "Hz", (0.01, 20.0), read_only=False, text=
        "Lowest and highest frequency: from half the slowest to twice the fastest mode of "
        "interest. Lower it for a large aircraft, raise it for a multirotor.")
    duration: float = _setting(60.0, "s", (1.0, 3600.0), read_only=False, text=
        "Longest run; it ends earlier when all coefficients are known.")
    fade_time: float = _setting(1.0, "s", (0.0, 60.0), read_only=False, text=
        "Time in which multisines fade in and out. An abort does not fade.")
    lead: float = _setting(0.15, "s", (0.0, 0.9), read_only=False, text=
        "Time between a tick and the stamp of its message. The controller adds the value from the"
        " stamp on, so that both sides know when it acts. Raise it for a slow link.")
    min_t_ratio: float = _setting(15.0, "", (0.0, 30.0), read_only=False, text=
        "Value over sigma from which a coefficient is known. When all are, the run ends early. 15"
        " is a sigma of 7 %; 0 never ends early.")
    max_rate: float = _setting(1.5, "rad/s", (0.0, 100.0), read_only=False, text=
        "Rate about any axis at which the run is aborted. Raise it for an agile aircraft.")
    max_attitude: float = _setting(0.8, "rad", (0.0, math.pi), read_only=False, text=
        "Roll or pitch angle, where it is known, at which the run is aborted.")
    min_airspeed: float = _setting(0.0, "m/s", (0.0, 400.0), read_only=False, text=
        "Airspeed, where it is known, below which the run is aborted; 0 for never. Set it well "
        "above the stall.")
    max_airspeed: float = _setting(0.0, "m/s", (0.0, 400.0), read_only=False, text=
        "Airspeed, where it is known, above which the run is aborted; 0 for never. Set it to the "
        "manoeuvring speed.")


@dataclass(frozen=True)
class SupervisionSettings:
    """Conditions for learning, and for a usable verdict."""

    min_fit: float = _setting(-20.0, "%", (-100.0, 100.0), read_only=False, text=
        "Lowest usable fit of free 1-second predictions, on every axis; the fit must also beat "
        "holding the rate. Lower it for gusty flight, raise it for a demanding controller.")
    min_t_ratio: float = _setting(4.0, "", (0.0, 30.0), read_only=False, text=
        "Value over sigma that the main control derivative of a usable row needs. Raise it for a "
        "controller that needs more certainty.")
    max_age: float = _setting(5.0, "s", (0.0, 1e6), read_only=False, text=
        "Time after which a control derivative is unconfirmed if its surface does not move. If "
        "surfaces are excited in turns, it begins when the next turn is due. 0 for never. Raise it"
        " for long cruises in one condition.")
    min_excitation: float = _setting(0.25, "", (0.0, 1.0), read_only=False, text=
        "Variance of an input, relative to its mean variance while learning, below which the "
        "input is quiet. If all inputs of a row are quiet, the weight of the row is reduced. 0 "
        "switches this off. Lower it if gentle manoeuvres are not learned from.")
    min_motion: float = _setting(0.04, "rad/s", (0.0, 1.0), read_only=False, text=
        "Swing of the rates over 2 s below which the aircraft may be at rest: learning pauses if "
        "they do not exceed the gyro's noise either. 0 for never. Raise it if a standing aircraft"
        " is not detected because of that noise.")
    min_force_motion: float = _setting(0.0, "m/s^2", (0.0, 100.0), read_only=False, text=
        "Swing of the specific forces over 2 s below which the aircraft may be at rest; 0 for "
        "never. Set it, to 0.3 or so, if a vehicle on the ground turns its sensor.")
    min_airspeed: float = _setting(0.0, "m/s", (0.0, 400.0), read_only=False, text=
        "Airspeed below which learning pauses, if it is measured. Below a third of "
        "`airspeed.reference` it pauses anyway, and nothing is usable. Set it somewhat below the "
        "stall speed.")
    max_rate: float = _setting(34.9, "rad/s", (0.0, 100.0), read_only=False, text=
        "Range of the gyro: learning pauses where a rate reaches it; 0 for none. 34.9 is 2000 "
        "deg/s; see the sensor's data sheet.")
    stuck_time: float = _setting(0.25, "s", (0.0, 60.0), read_only=False, text=
        "Time for which a signal of the Imu may repeat one value before it is stuck and learning "
        "pauses; 0 for never. A coarsely rounded signal may repeat one value for as long as it did"
        " before.")
    max_residual: float = _setting(6.0, "", (0.0, 1000.0), read_only=False, text=
        "Residual of a row, relative to its usual size, beyond which samples are left out, once "
        "all rows have been usable; 0 for never. Lower it if knocks or landings bias the estimate.")
    plausibility: bool = _setting(True, text=
        "Check units, axes, trim and channels against physics; learning stops while one is "
        "implausible. Switch it off for a vehicle that does not fly upright on average, like a "
        "tail-sitter.")
    expected_signs: tuple[str, ...] = _setting((), text=
        "Known signs of control derivatives, like '+pdot/da'. If the flight shows the opposite, a"
        " surface is connected the wrong way round, or the Imu points backwards: a fault, and "
        "nothing is usable.")


@dataclass(frozen=True)
class Settings:
    """All settings of the identifier, with their defaults."""

    update_rate: float = _setting(20.0, "Hz", (1.0, 200.0), text=
        "Rate of the updates and of the published estimates. Raise it for a controller that needs "
        "estimates sooner; 20 Hz suits most.")
    input_wait: float = _setting(0.05, "s", (0.0, 1.0), text=
        "Time by which the newest Imu stamp must have passed a tick before the tick is computed: "
        "late messages still count. Raise it if samples are dropped as late; lower it for less "
        "latency.")
    time_jump: float = _setting(1.0, "s", (0.1, 60.0), text=
        "Distance from the stream beyond which a stamp is an outlier; five outliers that agree "
        "are a new time base. Change it only for recordings with intended gaps.")
    structure: str = _setting("flight_dynamics", choices=STRUCTURES, text=
        "Model structure: 'baseline' (Section 3 of the paper, 18 coefficients), "
        "'throttle_coupled' (eq. 15, 20), 'augmented' (with a constant and the measured ay and "
        "az, 26) or 'flight_dynamics' (with angle of attack and sideslip as states, 35). Leave it"
        " for anything with wings; a multirotor is 'throttle_coupled' or 'augmented'.")
    estimator: str = _setting("instrumental_variable", choices=ESTIMATORS, text=
        "Estimator: the paper's 'gradient' law, recursive 'least_squares', or the guarded "
        "'instrumental_variable', which gyro noise and gusts do not bias. Leave it unless you "
        "compare methods.")
    initial_coefficients: tuple[float, ...] = _setting((), "", PLAUSIBLE, text=
        "Initial coefficients A_m: 3n values, row-major, SI; for 'flight_dynamics' 3n, or 5n with "
        "ay and az. Empty: zeros. Set them if an aircraft model is at hand.")
    initial_coefficients_file: str = _setting("", text=
        "File of initial coefficients, as replay writes it; it takes precedence over the values. "
        "Set it to start the next flight from a replayed one.")
    state_file: str = _setting("", text=
        "File in which the node keeps its coefficients between runs; it takes precedence over the "
        "initial ones. Empty: $ROS_HOME/uav_ident_ros/NODE.yaml; 'none': neither written nor read."
        " Replay does not use it. Set it for vehicles that share a node name.")
    state_max_age: float = _setting(604800.0, "s", (0.0, 1e9), text=
        "Age of the state file, by the computer's clock, beyond which the node does not use it; 0 "
        "for no limit. Lower it if the aircraft is often changed between flights.")
    save_period: float = _setting(30.0, "s", (0.0, 86400.0), read_only=False, text=
        "Interval at which usable coefficients are written to the state file, at least 1 s; 0 for "
        "only on ~/save and at the end. Raise it to spare a memory card.")
    fixed_coefficients: tuple[str, ...] = _setting((), text=
        "Names of coefficients that keep their initial value, like 'pdot/ay'. Fix known "
        "coefficients, and those that this vehicle does not have.")
    forgetting_time: float = _setting(200.0, "s", (0.0, 1e6), read_only=False, text=
        "Time constant with which old data lose weight; 0 for never. Below 60 s the estimate "
        "suffers. Lower it if the flight condition changes within minutes.")
    adapt_on_start: bool = _setting(True, text=
        "Whether the identifier learns from the start; the service ~/adapt switches it. Set it to"
        " false to fly on known coefficients.")
    imu: ImuSettings = dataclasses.field(default_factory=ImuSettings)
    actuators: ActuatorSettings = dataclasses.field(default_factory=ActuatorSettings)
    airspeed: AirspeedSettings = dataclasses.field(default_factory=AirspeedSettings)
    armed: ArmedSettings = dataclasses.field(default_factory=ArmedSettings)
    filter: FilterSettings = dataclasses.field(default_factory=FilterSettings)
    model: ModelSettings = dataclasses.field(default_factory=ModelSettings)
    gradient: GradientSettings = dataclasses.field(default_factory=GradientSettings)
    supervision: SupervisionSettings = dataclasses.field(default_factory=SupervisionSettings)
    excitation: ExcitationSettings = dataclasses.field(default_factory=ExcitationSettings)
    # fmt: on

    @classmethod
    def from_values(cls, values: Mapping[str, object]) -> Settings:
        """Build settings from dotted names; omitted ones keep their defaults.

        Parameters
        ----------
        values : mapping
            Dotted setting name to value. An empty list may be given as None.

        Raises
        ------
        SettingsError
            If a name is unknown, a value is not allowed, or settings contradict each other.
        """
        known = {setting.name: setting for setting in declarations()}
        settings = cls()
        for name, value in values.items():
            if name not in known:
                group = ", ".join(other for other in known if other.startswith(f"{name}."))
                meant = f"there are {group}" if group else nearest(name, known)
                meant = meant or "see docs/parameters.md"
                raise SettingsError(f"there is no parameter '{name}': {meant}")
            if value is None:
                value = known[name].default if not known[name].type.endswith("[]") else ()
            settings = _with(settings, name.split("."), known[name].check(value))
        _check_consistency(settings)
        return settings

    def values(self) -> dict[str, Value]:
        """Return every setting by its dotted name."""
        return {setting.name: attrgetter(setting.name)(self) for setting in declarations()}


EXCITATION_TIMEOUT = IN_A_ROW / Settings.update_rate
"""Time for which a sample of excitation is valid, s: `IN_A_ROW` ticks at the usual rate. After it
the excitation counts as zero."""


def nearest(name: str, known: Collection[str]) -> str:
    """Return ``did you mean '...'?`` with the most similar known name; empty if none is similar."""
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean '{near[0]}'?" if near else ""


@cache
def declarations() -> tuple[Setting, ...]:
    """Return the declaration of every setting, in the order of the documentation."""
    return tuple(_declarations(Settings, ""))


def _declarations(cls: type, prefix: str) -> Iterator[Setting]:
    for item in fields(cls):
        name, hint = prefix + item.name, str(item.type)
        if "setting" in item.metadata:
            yield replace(item.metadata["setting"], name=name, type=_ARRAYS.get(hint, hint))
        else:
            yield from _declarations(typing.cast(type, item.default_factory), f"{name}.")


def _with(group: Any, path: Sequence[str], value: Value) -> Any:
    """Return a copy of the settings with `value` at a path of attributes."""
    name, *rest = path
    return replace(group, **{name: _with(getattr(group, name), rest, value) if rest else value})


def _refuse(name: str, what: str) -> None:
    raise SettingsError(f"'{name}' {what}")


def _check_lengths(settings: Settings) -> None:
    """Check that every array has as many values as structure and channels need."""
    structure = STRUCTURES[settings.structure]
    n, channels = structure.size, len(settings.actuators.channels)
    by_structure: dict[str, tuple[int, ...]] = {
        "gradient.gains": (0, n, n * n),
        "initial_coefficients": tuple(sorted({0, len(ROWS) * n, len(structure.dense_rows) * n})),
    }
    one_each = ("scale", "trim", "thrust_curve", "lower_limit", "upper_limit")
    by_channels: dict[str, tuple[int, ...]] = {
        **{f"actuators.{name}": (0, channels) for name in one_each},
        **{f"actuators.mixing.{name}": (channels,) for name in INPUTS},
    }
    fixed: dict[str, tuple[int, ...]] = {
        "imu.rpy": (3,),
        "imu.lever_arm": (3,),
        "model.inertia": (0, 4),
        "excitation.amplitude": (len(INPUTS),),
        "excitation.band": (2,),
    }
    values = settings.values()
    for name, allowed in {**by_structure, **by_channels, **fixed}.items():
        count = len(typing.cast(tuple[float, ...], values[name]))
        if count not in allowed:
            wanted, why = " or ".join(str(k) for k in allowed if k), ""
            if name in by_structure:
                why = f" (structure '{structure.name}' has {n} regressors)"
            elif name in by_channels:
                why = f" ('actuators.channels' names {channels})"
            _refuse(name, f"has {count} values: {wanted} are needed{why}")


def _check_consistency(settings: Settings) -> None:
    """Check the settings against each other: lengths, and combinations without meaning."""
    _check_lengths(settings)
    for name in settings.fixed_coefficients:
        try:
            STRUCTURES[settings.structure].index(name)
        except ValueError as error:
            raise SettingsError(f"'fixed_coefficients': {error}") from None
    _check_excitation(settings)
    _check_signs(settings)
    _check_estimator(settings)


def _check_excitation(settings: Settings) -> None:
    low, high = settings.excitation.band
    if low >= high:
        _refuse("excitation.band", f"is [{low:g}, {high:g}]: write the lower frequency first")
    lead, longest = settings.excitation.lead, settings.time_jump + settings.input_wait
    if lead > longest:
        _refuse(
            "excitation.lead",
            f"is {lead:g} s: stamps so far ahead of the Imu's are outliers; 'time_jump' and "
            f"'input_wait' allow {longest:g} s",
        )


def _check_signs(settings: Settings) -> None:
    structure = STRUCTURES[settings.structure]
    for entry in settings.supervision.expected_signs:
        if entry[:1] not in ("+", "-") or entry[1:] not in structure.names:
            _refuse(
                "supervision.expected_signs",
                f"has '{entry}': write + or - and a coefficient of structure "
                f"'{structure.name}', as in '+pdot/da'",
            )


def _check_estimator(settings: Settings) -> None:
    """Check that estimator, structure and filter go together."""
    if settings.estimator == "gradient" and STRUCTURES[settings.structure].has_flow:
        _refuse(
            "estimator",
            "is 'gradient' and 'structure' is 'flight_dynamics', which is not linear "
            "in its coefficients: choose 'augmented', 'throttle_coupled' or 'baseline'",
        )
    if settings.filter.method != "backward_difference":
        return
    if settings.airspeed.type:
        _refuse(
            "airspeed.type",
            f"is '{settings.airspeed.type}': speed scaling needs 'filter.method' 'state_variable'",
        )
    if settings.estimator != "gradient":
        _refuse(
            "filter.method",
            "is 'backward_difference': that is the paper's law only; "
            f"with 'estimator' {settings.estimator!r} use 'state_variable'",
        )
    if settings.actuators.estimate_delay:
        _refuse(
            "actuators.estimate_delay",
            "is true, but 'filter.method' 'backward_difference' sees the rates at the ticks only: "
            "set it to false, or use 'state_variable'",
        )
