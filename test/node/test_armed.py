# SPDX-License-Identifier: Apache-2.0
"""The optional armed topic."""

from __future__ import annotations

from dataclasses import replace

import pytest
from node_process import StartNode
from rclpy.serialization import serialize_message
from recordings import MakePlayer, recording
from std_msgs.msg import Bool

from uav_ident_ros.bags import reading as bags

TOPIC = "/armed"


@pytest.mark.parametrize("one_clock", [True, False])
def test_node_learns_only_while_armed(
    start_node: StartNode, make_player: MakePlayer, one_clock: bool
) -> None:
    """An unstamped message is stamped on arrival: on the Imu's clock, whichever that is."""
    plain = recording("multisine", 6.0)
    node = start_node(
        parameter_file=plain.parameter_file,
        parameters={"armed.type": "std_msgs/msg/Bool"},
        sim_time=one_clock,  # without, arrivals are years from the recorded stamps
    )
    flight = replace(plain, types={**plain.types, TOPIC: "std_msgs/msg/Bool"})
    player = make_player(flight, clock=one_clock)
    player.wait_for_node()

    def part(begin: float, end: float, armed: bool) -> list[bags.Message]:
        start_ns = flight.messages[0].log_ns
        chosen = [m for m in flight.messages if begin <= (m.log_ns - start_ns) * 1e-9 < end]
        word = bags.Message(TOPIC, chosen[0].log_ns, serialize_message(Bool(data=armed)))
        return [word, *chosen]

    player.play_in_step(part(0.0, 2.0, armed=False))
    assert {tuple(m.data) for m in player.outputs.coefficients} == {
        tuple(player.outputs.coefficients[0].data)
    }
    player.wait_until(
        lambda: any("not armed" in s.message for s in player.outputs.status), "the reason"
    )
    player.play_in_step(part(2.0, 4.0, armed=True))
    learned = player.outputs.coefficients[-1].data
    assert learned != player.outputs.coefficients[0].data
    player.play_in_step(part(4.0, 6.0, armed=False))
    assert player.outputs.coefficients[-1].data == player.outputs.coefficients[-20].data
    assert ("'/armed': its messages carry no time" in node.log) is not one_clock
    assert "'/armed': message dropped" not in node.log
