# SPDX-License-Identifier: Apache-2.0
"""The optional topics, airspeed and armed: on the Imu's clock, or on whichever."""

import math
from dataclasses import replace
from typing import Any

import pytest
from geometry_msgs.msg import TwistStamped
from rclpy.serialization import serialize_message
from recordings import Fly, part, recording, shown, wait_for_words
from std_msgs.msg import Bool, Float64

from uav_ident_ros.bags.reading import Message
from uav_ident_ros.ros import to_stamp

AIRSPEED, ARMED = "/airspeed", "/armed"
EVERY = 20
"""Messages of the flight per airspeed: about 12 Hz."""


def airspeed(kind: type, stamp_ns: int, value: float) -> Any:
    if kind is Float64:
        return Float64(data=value)
    twist = TwistStamped()
    twist.header.stamp = to_stamp(stamp_ns)
    twist.twist.linear.x = value
    return twist


@pytest.mark.parametrize(
    ("one_clock", "name", "kind"),
    [
        (True, "geometry_msgs/msg/TwistStamped", TwistStamped),
        (False, "std_msgs/msg/Float64", Float64),  # arrivals are years from the recorded stamps
    ],
)
def test_node_learns_with_an_airspeed_and_only_while_armed(
    fly: Fly, one_clock: bool, name: str, kind: type
) -> None:
    plain = recording("multisine", 8.0)
    types = {**plain.types, AIRSPEED: name, ARMED: "std_msgs/msg/Bool"}
    flight = replace(plain, types=types)
    parameters = {"airspeed.type": name, "armed.type": types[ARMED]}
    node, player = fly(flight, parameters=parameters, sim_time=one_clock)
    learned = player.outputs.coefficients
    count = dropped = 0

    def play(begin: float, end: float, armed: bool) -> None:
        nonlocal count, dropped
        chosen = part(flight, begin, end)
        messages = [Message(ARMED, chosen[0].log_ns, serialize_message(Bool(data=armed)))]
        for number, message in enumerate(chosen):
            messages.append(message)
            if number % EVERY == 0:
                bad = number % (5 * EVERY) == 0
                speed = airspeed(kind, message.log_ns, math.nan if bad else 20.0)
                messages.append(Message(AIRSPEED, message.log_ns, serialize_message(speed)))
                count, dropped = count + 1, dropped + bad
        player.play_in_step(messages)

    player.play_in_step(part(flight, 0.0, 2.0))
    wait_for_words(player, "no message on '/airspeed' yet")
    play(2.0, 4.0, armed=False)
    assert len({tuple(m.data) for m in learned}) == 1
    wait_for_words(player, "not armed")
    play(4.0, 6.0, armed=True)
    assert learned[-1].data != learned[0].data
    play(6.0, 8.0, armed=False)
    assert learned[-1].data == learned[-20].data
    for topic in (AIRSPEED, ARMED):
        unstamped = topic == ARMED or kind is Float64
        printed = f"'{topic}': its messages carry no time" in node.log
        assert printed is (unstamped and not one_clock)
    values = shown(player)
    assert int(values["airspeed: dropped: not finite"]) == dropped
    assert int(values["airspeed: messages"]) == count
    assert "'/armed': message dropped" not in node.log
