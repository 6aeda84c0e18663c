# SPDX-License-Identifier: Apache-2.0
"""The optional airspeed topic."""

from __future__ import annotations

import math
from dataclasses import replace

from geometry_msgs.msg import TwistStamped
from node_process import StartNode
from rclpy.serialization import serialize_message
from recordings import MakePlayer, recording, wait_for_status
from std_msgs.msg import Float64

from uav_ident_ros.bags import reading as bags
from uav_ident_ros.player import to_stamp

TOPIC = "/airspeed"

AIRSPEED_EVERY = 20
"""Messages of the flight per airspeed: about 12 Hz."""


def test_node_waits_for_airspeed_and_learns_with_it(
    start_node: StartNode, make_player: MakePlayer
) -> None:
    plain = recording("multisine", 5.0)
    start_node(
        parameter_file=plain.parameter_file,
        parameters={"airspeed.type": "geometry_msgs/msg/TwistStamped"},
    )
    flight = replace(plain, types={**plain.types, TOPIC: "geometry_msgs/msg/TwistStamped"})
    player = make_player(flight, clock=False)
    player.wait_for_node()
    begin = flight.messages[0].log_ns
    without = [m for m in flight.messages if m.log_ns < begin + int(2e9)]
    player.play_in_step(without)
    player.wait_until(
        lambda: any("no message on '/airspeed' yet" in s.message for s in player.outputs.status),
        "the state",
    )
    waiting = player.outputs.coefficients[-1].data
    messages = []
    for number, message in enumerate(flight.messages[len(without) :]):
        messages.append(message)
        if number % AIRSPEED_EVERY == 0:
            twist = TwistStamped()
            twist.header.stamp = to_stamp(message.log_ns)
            bad = number % (5 * AIRSPEED_EVERY) == 0
            twist.twist.linear.x = math.nan if bad else 20.0
            messages.append(bags.Message(TOPIC, message.log_ns, serialize_message(twist)))
    player.play_in_step(messages)
    wait_for_status(player)
    assert player.outputs.coefficients[-1].data != waiting
    shown = {entry.key: entry.value for entry in player.outputs.status[-1].values}
    assert int(shown["airspeed: dropped: not finite"]) > 0
    assert int(shown["airspeed: messages"]) == sum(m.topic == TOPIC for m in messages)


def test_node_takes_an_unstamped_airspeed_on_another_clock(
    start_node: StartNode, make_player: MakePlayer
) -> None:
    plain = recording("multisine", 4.0)
    node = start_node(
        parameter_file=plain.parameter_file,
        parameters={"airspeed.type": "std_msgs/msg/Float64"},
    )
    flight = replace(plain, types={**plain.types, TOPIC: "std_msgs/msg/Float64"})
    player = make_player(flight, clock=False)  # arrivals are years from the recorded stamps
    player.wait_for_node()
    messages = []
    for number, message in enumerate(flight.messages):
        if number % AIRSPEED_EVERY == 0:
            data = serialize_message(Float64(data=20.0))
            messages.append(bags.Message(TOPIC, message.log_ns, data))
        messages.append(message)
    player.play_in_step(messages)
    assert any(player.outputs.coefficients[-1].data)
    assert "'/airspeed': its messages carry no time" in node.log
    assert "'/airspeed': message dropped" not in node.log
