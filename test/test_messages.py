# SPDX-License-Identifier: Apache-2.0
"""Adapters of every supported message type, the CDR reader, and messages without a time."""

import itertools
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from uav_ident_ros.bags import writing
from uav_ident_ros.bags.writing import NOT_KNOWN, NOT_MEASURED, jazzy_types
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.samples import ARMED
from uav_ident_ros.identification.settings import Settings, SettingsError
from uav_ident_ros.messages import types
from uav_ident_ros.messages.feed import Feed, decode_imu_cdr
from uav_ident_ros.messages.streams import STREAMS, Stream
from uav_ident_ros.messages.types import RatesReading

STAMP_NS = 1_700_000_001_250_000_003
PX4_US = 1_700_000_001_250_007


M = SimpleNamespace


def header(frame_id: str = "base_link") -> SimpleNamespace:
    return M(stamp=M(sec=1_700_000_001, nanosec=250_000_003), frame_id=frame_id)


def vector(x: float, y: float, z: float) -> SimpleNamespace:
    return M(x=x, y=y, z=z)


def imu(frame_id: str = "base_link", *, rates: bool = True, force: bool = True) -> Any:
    covariances = tuple(NOT_KNOWN if known else NOT_MEASURED for known in (rates, force))
    turn = np.random.default_rng(len(frame_id)).normal(size=4).tolist()
    return writing.imu(STAMP_NS, (0.1, -0.2, 0.3), (1.0, 2.0, 9.8), frame_id, turn, covariances)


def serialized(message: Any, **options: Any) -> bytes:
    return bytes(jazzy_types().serialize_cdr(message, "sensor_msgs/msg/Imu", **options))


# The same four channels 1.5, -0.5, 0.25, 0.75 in a message of each type. The types outside
# ROS 2's common interfaces are stand-ins with the fields of their published definitions.
CHANNELS = [1.5, -0.5, 0.25, 0.75]
PX4 = {"timestamp": PX4_US + 5, "timestamp_sample": PX4_US}
ACTUATOR_MESSAGES: dict[str, tuple[Any, int | None]] = {
    "std_msgs/msg/Float64MultiArray": (M(data=CHANNELS), None),
    "std_msgs/msg/Float32MultiArray": (M(data=np.array(CHANNELS, dtype=np.float32)), None),
    "sensor_msgs/msg/JointState": (
        M(header=header(), name=list("abcd"), position=CHANNELS, velocity=[], effort=[]), STAMP_NS),
    "actuator_msgs/msg/Actuators": (
        M(header=header(), position=CHANNELS, velocity=[], normalized=[]), STAMP_NS),
    "mavros_msgs/msg/RCOut": (M(header=header(), channels=CHANNELS), STAMP_NS),
    "mavros_msgs/msg/ActuatorControl": (
        M(header=header(), group_mix=0, controls=np.array([*CHANNELS, 0, 0, 0, 0])), STAMP_NS),
    "px4_msgs/msg/ActuatorMotors": (M(**PX4, control=np.array([*CHANNELS] + [math.nan] * 8)),
        PX4_US * 1000),
    "px4_msgs/msg/ActuatorServos": (M(**PX4, control=np.array([*CHANNELS] + [math.nan] * 4)),
        PX4_US * 1000),
    "px4_msgs/msg/ActuatorOutputs": (
        M(timestamp=PX4_US, noutputs=4, output=np.array([*CHANNELS] + [0.0] * 12)), PX4_US * 1000),
}  # fmt: skip

SAMPLED = RatesReading(PX4_US * 1000, (1.0, 2.0, 3.0), None, "")
FORCED = {
    "gyro_rad": np.array([1.0, 2.0, 3.0]),
    "accelerometer_m_s2": np.array([4.0, 5.0, 6.0]),
}
RATES_MESSAGES = [
    ("sensor_msgs/msg/Imu", imu(),
        RatesReading(STAMP_NS, (0.1, -0.2, 0.3), (1.0, 2.0, 9.8), "base_link")),
    ("px4_msgs/msg/VehicleAngularVelocity", M(**PX4, xyz=[1.0, 2.0, 3.0]), SAMPLED),
    ("px4_msgs/msg/VehicleAngularVelocity",
        M(timestamp=PX4_US, timestamp_sample=0, xyz=[1.0, 2.0, 3.0]), SAMPLED),
    ("px4_msgs/msg/SensorCombined",
        M(timestamp=PX4_US, accelerometer_timestamp_relative=0, **FORCED),
        SAMPLED._replace(specific_force=(4.0, 5.0, 6.0))),
    ("px4_msgs/msg/SensorCombined",
        M(timestamp=PX4_US, accelerometer_timestamp_relative=0x7FFFFFFF, **FORCED), SAMPLED),
]  # fmt: skip

OPTIONAL = [
    ("std_msgs/msg/Float64", M(data=21.5), (None, 21.5)),
    ("std_msgs/msg/Float32", M(data=21.5), (None, 21.5)),
    ("geometry_msgs/msg/TwistStamped", M(header=header(), twist=M(linear=vector(18.0, 6.0, 9.0))),
        (STAMP_NS, 21.0)),
    ("mavros_msgs/msg/VfrHud", M(header=header(), airspeed=21.5), (STAMP_NS, 21.5)),
    ("px4_msgs/msg/AirspeedValidated", M(timestamp=7, true_airspeed_m_s=21.5), (7_000, 21.5)),
    ("std_msgs/msg/Bool", M(data=True), (None, True)),
    ("mavros_msgs/msg/State", M(header=header(), armed=True), (STAMP_NS, True)),
    ("px4_msgs/msg/VehicleStatus", M(timestamp=7, arming_state=2), (7_000, True)),
    ("px4_msgs/msg/VehicleStatus", M(timestamp=7, arming_state=1), (7_000, False)),
    ("px4_msgs/msg/ActuatorArmed", M(timestamp=7, armed=True), (7_000, True)),
]  # fmt: skip


def reader(**actuators: Any) -> types.ActuatorReader:
    values = {f"actuators.{name}": value for name, value in actuators.items()}
    n = len(values.get("actuators.channels", CHANNELS))
    values |= {f"actuators.mixing.{row}": [1.0] * n for row in ("de", "dr", "da", "dth")}
    return types.ActuatorReader(Settings.from_values(values).actuators)


def test_every_declared_type_is_read() -> None:
    assert types.RATE_ADAPTERS.keys() == {name for name, _, _ in RATES_MESSAGES}
    assert types.ACTUATOR_ADAPTERS.keys() == ACTUATOR_MESSAGES.keys()
    assert {name for name, _, _ in OPTIONAL} == {*types.AIRSPEED_READERS, *types.ARMED_READERS}
    for name, message, expected in RATES_MESSAGES:
        assert types.RATE_ADAPTERS[name].read(message) == expected, name
    for name, message, (stamp_ns, value) in OPTIONAL:
        assert {**types.AIRSPEED_READERS, **types.ARMED_READERS}[name](message) == (
            stamp_ns,
            pytest.approx(value),
        ), name
    for name, (message, stamp_ns) in ACTUATOR_MESSAGES.items():
        assert reader(type=name, channels=[3, 0])(message) == (stamp_ns, (0.75, 1.5)), name


@pytest.mark.parametrize("stream", [s for s in STREAMS if s.setting], ids=lambda s: s.name)
def test_the_types_that_are_read_are_the_choices_of_a_setting(stream: Stream) -> None:
    setting, words = stream.setting, [*[""] * stream.optional, *stream.types]
    for name in words:
        assert stream.type_of(Settings.from_values({setting: name})) == name
    *_, last = words
    for wrong, hint in [(last[:-1], f"; did you mean '{last}'?")] + [("", "")] * ("" not in words):
        with pytest.raises(SettingsError) as error:
            Settings.from_values({setting: wrong})
        names = ", ".join(word or '""' for word in words)
        assert str(error.value) == f"'{setting}' is '{wrong}': allowed are {names}{hint}"


def joints(name: list[str], position: list[float], **more: Any) -> SimpleNamespace:
    return M(header=header(), name=name, position=position, **more)


def by_name(*channels: str | int, **more: Any) -> types.ActuatorReader:
    return reader(type="sensor_msgs/msg/JointState", channels=list(channels), **more)


def test_channels_by_name_follow_the_names_of_each_message() -> None:
    read, unnamed = by_name("rudder", "elevator"), joints([], [1.0, 2.0])
    message = joints(["elevator", "rudder"], [1.0, 2.0], effort=[3.0, 4.0])
    assert read(message)[1] == (2.0, 1.0)
    assert by_name("elevator", field="effort")(message)[1] == (3.0,)
    for _ in range(2):
        with pytest.raises(types.ChannelError, match="no channel 'rudder': the message names none"):
            read(unnamed)
    message.name = ["rudder", "elevator"]
    assert read(message)[1] == (1.0, 2.0)
    with pytest.raises(types.ChannelError, match="no channel 'rudder': the message names none"):
        read(unnamed)
    assert by_name(1, 0)(unnamed)[1] == (2.0, 1.0)


def test_absent_channels_are_named_in_the_error() -> None:
    many = joints([f"servo{i}" for i in range(5000)], [1.0] * 5000)  # the error lists a part
    one, four = joints(["elevator"], [1.0]), M(data=CHANNELS)
    for read, message, words in (
        (by_name("elevater"), one, "'elevater' among elevator; did you mean"),
        (by_name("elevator"), many, "servo29 and 4970 more"),
        (types.read_excitation, many, "servo29 and 4970 more"),
        (reader(channels=[0, 4]), four, "'data' has 4 values, too few for channels 0, 4"),
        (by_name("b"), joints(["a", "b"], [1.0]), "'position' has 1 values"),
    ):
        with pytest.raises(types.ChannelError, match=words) as error:
            read(message)
        assert len(str(error.value)) < 500


def test_only_channels_in_use_must_be_finite() -> None:
    for bad in (math.nan, math.inf, -math.inf):
        message = M(data=[1.0, bad, 2.0])
        assert reader(channels=[0, 2])(message)[1] == (1.0, 2.0)
        with pytest.raises(types.ChannelError, match="not all finite") as caught:
            reader(channels=[0, 1])(message)
        assert caught.value.reason == "not finite"


def test_a_wrong_field_and_names_without_a_name_field_are_refused() -> None:
    with pytest.raises(types.MessageTypeError, match="has position, velocity, normalized"):
        reader(type="actuator_msgs/msg/Actuators", field="data")
    with pytest.raises(types.MessageTypeError, match="names no channels"):
        reader(type="mavros_msgs/msg/RCOut", channels=["elevator"])


def test_a_frame_is_a_fault_if_it_contradicts_the_convention() -> None:
    for frame_id in ("base_link_frd", "map_ned"):
        assert frame_id in types.frame_fault("flu", frame_id, "sensor_msgs/msg/Imu")
        assert not types.frame_fault("frd", frame_id, "sensor_msgs/msg/Imu")
    assert not types.frame_fault("flu", "base_link", "sensor_msgs/msg/Imu")
    assert not types.frame_fault("frd", "", "px4_msgs/msg/SensorCombined")
    assert "'frd'" in types.frame_fault("flu", "", "px4_msgs/msg/SensorCombined")


def test_cdr_reader_agrees_with_the_decoder() -> None:
    """Also without rates or force, which a covariance of -1 marks as absent."""
    for length, little_endian, rates, force in itertools.product(range(18), *[(True, False)] * 3):
        message = imu("x" * length, rates=rates, force=force)
        data = serialized(message, little_endian=little_endian)
        expected = types.RATE_ADAPTERS["sensor_msgs/msg/Imu"].read(message)
        assert decode_imu_cdr(data) == decode_imu_cdr(memoryview(data)) == expected
        assert (expected.rates is None, expected.specific_force is None) == (not rates, not force)
        for cut in (0, 1, 4, 12, 16, 40, len(data) - 1):
            assert decode_imu_cdr(data[:cut]) is None


def test_cdr_reader_returns_none_for_other_encodings() -> None:
    data = serialized(imu("a"))
    assert decode_imu_cdr(b"\x00\x07" + data[2:]) is None
    assert decode_imu_cdr(data[:16] + b"\xff" + data[17:]) is None  # frame_id is not UTF-8
    assert decode_imu_cdr(data[:12] + b"\xff\xff\xff\xff" + data[16:]) is None


def test_a_type_is_imported_or_refused_by_name() -> None:
    sensor_msgs = pytest.importorskip("sensor_msgs.msg")
    assert types.import_type("sensor_msgs/msg/Imu") is sensor_msgs.Imu
    for name, words in (
        ("nothing_here/msg/Imu", "'nothing_here/msg/Imu' is not installed"),
        ("uav_ident_ros/messages/Nothing", "has no type"),
        ("sensor_msgs/Imu", "'sensor_msgs/Imu' is no message type: write package/msg/Type"),
    ):
        with pytest.raises(types.MessageTypeError, match=words):
            types.import_type(name)


NODE_NS = 1_700_000_000 * 10**9
BOOT_NS = 300 * 10**9


@pytest.mark.parametrize("flown", [0, 100])
@pytest.mark.parametrize("imu_ns", [NODE_NS, BOOT_NS, NODE_NS + BOOT_NS])
def test_the_last_message_without_a_stamp_before_a_sample_applies(imu_ns: int, flown: int) -> None:
    """Such messages apply from their arrival, for any clock of the Imu, also before its start."""
    identifier = OnlineIdentifier(Settings.from_values({"armed.type": "std_msgs/msg/Bool"}))
    (stream,) = (stream for stream in STREAMS if stream.name == ARMED)
    offs: list[float] = []
    feed = Feed(stream, identifier, lambda data: M(data=data == b"yes"), on_offset=offs.append)

    def fly(first: int, until: int) -> list[str]:
        """Add samples every 10 ms; return the reasons to pause."""
        reasons = []
        for k in range(first + 1, until + 1):
            rate, stamp_ns = 0.2 * math.sin(0.05 * k), imu_ns + 10_000_000 * k
            identifier.add_actuators(stamp_ns, (rate, 0.0, 0.0, 0.5))
            identifier.add_rates(stamp_ns, (rate, 0.0, 0.0))
            feed.settle()
            reasons += [estimate.reason for estimate in identifier.advance()]
        return reasons

    fly(0, flown)
    for number, payload in enumerate((b"no", b"yes", b"yes", b"no")):
        feed.take(payload, NODE_NS + 10_000_000 * flown + 1000 * number)
    assert "not armed" in fly(flown, flown + 50)[-1]
    assert not +identifier.intake.drops[ARMED]
    assert len(offs) == (imu_ns != NODE_NS), "it is told once"
