# SPDX-License-Identifier: Apache-2.0
"""Hostile messages, parameters and bytes, drawn at random."""

import math
import random
import struct
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

SECOND_NS = 1_000_000_000

POOL = 1500
"""Number of prepared messages of a topic; their stamps are drawn anew each time."""

NUMBERS = (
    math.nan, math.inf, -math.inf, 1e308, -1e308, 1e12, 5e-324, -5e-324, 2.2e-308, -0.0, 1e-40,
    99.9,
)  # fmt: skip
"""Hostile numbers: not finite, huge, denormal, and just plausible."""

FRAMES = ("", "base_link_frd", "odom_ned", "x" * 3000, "\x7f", "базис", "/", "imu")

STAMP = struct.Struct("<iI")
STAMP_AT = 4
"""Offset of the stamp in the bytes of a message that begins with a header."""

FIRST_YEARS = 2**31
"""Upper limit of the seconds in a stamp."""


def stamped(data: bytes, t_ns: int) -> bytes:
    """Return a message that begins with a header, with the stamp `t_ns`."""
    seconds = t_ns // SECOND_NS % FIRST_YEARS
    stamp = STAMP.pack(seconds, t_ns % SECOND_NS)
    return data[:STAMP_AT] + stamp + data[STAMP_AT + STAMP.size :]


class Hostile:
    """Generator of hostile messages of one type."""

    def __init__(
        self,
        kind: type,  # Message class
        chance: random.Random,  # Source of randomness
    ) -> None:
        self._kind = kind
        self._chance = chance
        self._has_stamp = hasattr(kind(), "header")
        self._pool = [self._make() for _ in range(POOL)]

    def message(self, now_ns: int) -> bytes:
        """Return a message with the stamp `now_ns`, or a hostile one."""
        data = self._chance.choice(self._pool)
        if self._has_stamp and len(data) >= STAMP_AT + STAMP.size:
            return data[:STAMP_AT] + self._stamp(now_ns) + data[STAMP_AT + STAMP.size :]
        return data

    def _stamp(self, now_ns: int) -> bytes:
        chance = self._chance
        match chance.randrange(10):
            case 0:
                return bytes(8)
            case 1:
                return STAMP.pack(chance.choice((-(2**31), -1, 2**31 - 1)), chance.randrange(2**32))
            case 2:
                t_ns = now_ns + int(chance.choice((2.0, 60.0, 1e5, 1e8)) * 1e9)
            case 3:
                t_ns = max(1, now_ns - int(chance.choice((2.0, 60.0, 1e5, 1e8)) * 1e9))
            case 4:
                t_ns = now_ns + chance.randrange(4_000_000)
            case _:
                t_ns = now_ns  # a repeated stamp
        return STAMP.pack(t_ns // SECOND_NS % FIRST_YEARS, t_ns % SECOND_NS)

    def _make(self) -> bytes:
        from rclpy.serialization import serialize_message

        message = example(self._kind)
        match self._chance.randrange(5):
            case 0 | 1:
                spoil_number(message, self._chance)
                return bytes(serialize_message(message))
            case 2:
                spoil_form(message, self._chance)
                return bytes(serialize_message(message))
            case _:
                data = bytes(serialize_message(message))
                return mutated(data, np.random.default_rng(self._chance.getrandbits(32)))


def example(kind: type) -> Any:
    """Return a valid message."""
    message = kind()
    if hasattr(message, "header"):
        message.header.frame_id = "imu_link"
    if hasattr(message, "position"):
        message.name = ["elevator", "rudder", "aileron", "throttle"]
        message.position = [0.01, -0.02, 0.03, 0.5]
    if hasattr(message, "linear_acceleration"):
        message.linear_acceleration.z = 9.8
    return message


def leaves(message: Any) -> Iterator[Callable[[float], None]]:
    """Yield a setter for every floating-point number in a message."""
    for name, type_name in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if type_name in ("double", "float"):
            yield partial(setattr, message, name)
        elif type_name.startswith(("double[", "sequence<double", "sequence<float")):
            for i in range(len(value)):
                yield partial(value.__setitem__, i)
        elif hasattr(value, "get_fields_and_field_types"):
            yield from leaves(value)


def spoil_number(message: Any, chance: random.Random) -> None:
    """Set one number, or all, to a hostile value."""
    setters = list(leaves(message))
    if not setters:
        message.data = chance.random() < 0.5
        return
    chosen = setters if chance.random() < 0.2 else [chance.choice(setters)]
    for setter in chosen:
        setter(chance.choice(NUMBERS))


def spoil_form(message: Any, chance: random.Random) -> None:
    """Change the frame, the names or the number of values of a message."""
    if hasattr(message, "header"):
        message.header.frame_id = chance.choice(FRAMES)
    if hasattr(message, "position"):
        count = chance.choice((0, 1, 3, 5, 500))
        message.name = [chance.choice(("elevator", "", "flaps", "ü" * 40)) for _ in range(count)]
        message.position = [chance.choice(NUMBERS) for _ in range(chance.choice((0, 2, count)))]
    if hasattr(message, "angular_velocity_covariance"):
        message.angular_velocity_covariance[0] = chance.choice((-1.0, math.nan))
        message.linear_acceleration_covariance[0] = chance.choice((-1.0, 0.0))


def parameter(chance: random.Random) -> Any:
    """Return a random parameter, valid or invalid."""
    from rclpy.parameter import Parameter

    from uav_ident_ros.identification.settings import declarations

    known = list(declarations())
    setting = chance.choice([s for s in known if not s.read_only] + [chance.choice(known)])
    low = setting.low if math.isfinite(setting.low) else -1e6
    high = setting.high if math.isfinite(setting.high) else 1e6
    value = chance.choice(
        (chance.uniform(low, high), chance.uniform(low, high), chance.choice(NUMBERS),
         chance.randrange(-9, 9), True, "none", [1.0, math.nan], ["a", "b"], None)
    )  # fmt: skip
    name = setting.name if chance.random() < 0.95 else chance.choice(("no.such", "use_sim_timer"))
    return Parameter(name, value=value).to_parameter_msg()


INTEGERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1)


def mutated(content: bytes, chance: np.random.Generator) -> bytes:
    """Return a mutated copy: one to eight changes of random kinds."""
    data = bytearray(content)
    for _ in range(int(chance.integers(1, 9))):
        change = MUTATIONS[int(chance.integers(len(MUTATIONS)))]
        at = int(chance.integers(max(len(data), 1)))
        if chance.random() < 0.3:  # the part that declares formats
            at = min(at, int(chance.integers(1, 3000)))
        change(data, at, chance)
    return bytes(data)


def _flip(data: bytearray, at: int, chance: np.random.Generator) -> None:
    data[at : at + 1] = bytes(b ^ 1 << int(chance.integers(8)) for b in data[at : at + 1])


def _noise(data: bytearray, at: int, chance: np.random.Generator) -> None:
    size = int(chance.integers(1, 600))
    data[at : at + size] = chance.bytes(min(size, len(data) - at))


def _zeros(data: bytearray, at: int, chance: np.random.Generator) -> None:
    size = min(int(chance.integers(1, 5000)), len(data) - at)
    data[at : at + size] = bytes(size)


def _cut_out(data: bytearray, at: int, chance: np.random.Generator) -> None:
    del data[at : at + int(chance.integers(1, 600))]


def _repeat(data: bytearray, at: int, chance: np.random.Generator) -> None:
    data[at:at] = data[at : at + int(chance.integers(1, 2000))]


def _move(data: bytearray, at: int, chance: np.random.Generator) -> None:
    block = data[at : at + int(chance.integers(1, 2000))]
    to = int(chance.integers(max(len(data), 1)))
    data[to : to + len(block)] = block


def _number(data: bytearray, at: int, chance: np.random.Generator) -> None:
    size = int(chance.choice([1, 2, 4, 8]))
    number = INTEGERS[int(chance.integers(len(INTEGERS)))] % 256**size
    data[at : at + size] = number.to_bytes(size, "little")


def _float(data: bytearray, at: int, chance: np.random.Generator) -> None:
    value = float(chance.choice([np.nan, np.inf, -np.inf, 1e300, -1.0, 5e-324]))
    data[at : at + 8] = struct.pack("<d", value)


def _truncate(data: bytearray, at: int, chance: np.random.Generator) -> None:
    if chance.random() < 0.3:
        del data[at:]


def _text(data: bytearray, at: int, chance: np.random.Generator) -> None:
    data[at : at + 4] = chance.choice([b"1e999", b"-1", b",,,,", b"\n", b'"', b"\xff\xfe", b"nan"])


MUTATIONS: tuple[Callable[[bytearray, int, np.random.Generator], None], ...] = (
    _flip, _flip, _noise, _zeros, _cut_out, _repeat, _move, _number, _number, _float, _truncate,
    _text,
)  # fmt: skip
