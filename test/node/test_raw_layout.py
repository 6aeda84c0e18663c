# SPDX-License-Identifier: Apache-2.0
"""The coefficients from the bytes on the wire alone, as a microcontroller reads them.

Nothing of this package and nothing of ROS takes part in the decoding: only `struct`, and the
layout that docs/controllers.md describes.
"""

from __future__ import annotations

import struct

import numpy as np
from node_process import StartNode
from recordings import MakePlayer, recording
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from uav_ident_ros.player import stamp_ns


class Cdr:
    """Reader of little-endian XCDR1: what the encapsulation header 00 01 00 00 announces."""

    def __init__(self, data: bytes) -> None:
        assert data[:2] == b"\x00\x01"
        self._body, self._at = data[4:], 0

    def number(self, form: str) -> float | int:
        size = struct.calcsize(form)
        self._at = (self._at + size - 1) // size * size  # aligned to its own size
        (value,) = struct.unpack_from("<" + form, self._body, self._at)
        self._at += size
        return value

    def string(self) -> str:
        length = self.number("I")  # the closing zero counts
        text = self._body[self._at : self._at + length - 1].decode()
        self._at += length
        return text

    def strings(self) -> list[str]:
        return [self.string() for _ in range(self.number("I"))]

    def doubles(self) -> list[float]:
        return [self.number("d") for _ in range(self.number("I"))]


def named(data: bytes) -> tuple[int, list[str], list[float], list[float]]:
    """Stamp (ns), names, values and sigmas of ~/coefficients_named."""
    cdr = Cdr(data)
    t_ns = cdr.number("i") * 10**9 + cdr.number("I")
    assert cdr.string() == ""  # frame_id
    names, position = cdr.strings(), cdr.doubles()
    assert cdr.doubles() == []  # velocity
    return t_ns, names, position, cdr.doubles()


def dense(data: bytes) -> tuple[list[tuple[str, int, int]], list[float]]:
    """Dimensions (label, size, stride) and data of ~/coefficients."""
    cdr = Cdr(data)
    dimensions = [(cdr.string(), cdr.number("I"), cdr.number("I")) for _ in range(cdr.number("I"))]
    assert cdr.number("I") == 0  # data_offset
    return dimensions, cdr.doubles()


def test_both_topics_are_read_from_their_bytes(
    start_node: StartNode, make_player: MakePlayer
) -> None:
    flight = recording("multisine", 4.0)
    start_node(parameter_file=flight.parameter_file, sim_time=True)
    player = make_player(flight)
    raw: dict[str, list[bytes]] = {"coefficients_named": [], "coefficients": []}
    for topic, kind in (("coefficients_named", JointState), ("coefficients", Float64MultiArray)):
        player.node.create_subscription(
            kind, f"/identifier/{topic}", raw[topic].append, 100, raw=True
        )
    player.wait_for_node()
    player.play_in_step(flight.messages)

    decoded = player.outputs.named[-1]
    t_ns, names, position, effort = named(raw["coefficients_named"][-1])
    assert t_ns == stamp_ns(decoded.header.stamp)
    assert names == list(decoded.name)
    assert position == list(decoded.position)
    assert effort == list(decoded.effort)
    verdicts = [f"verdict/usable{row}" for row in ("", "/pdot", "/qdot", "/rdot")]
    assert names[-7:] == ["fit/p", "fit/q", "fit/r", *verdicts]
    assert set(position[-4:]) <= {0.0, 1.0}

    dimensions, data = dense(raw["coefficients"][-1])
    (rows, n_rows, size), (columns, n, stride) = dimensions
    assert (rows.split(","), n_rows) == (["pdot", "qdot", "rdot"], 3)
    assert (size, stride) == (3 * n, n)
    assert len(data) == size
    matrix = np.array(data).reshape(n_rows, n)
    labels = columns.split(",")
    value = dict(zip(names, position, strict=True))
    for i, row in enumerate(rows.split(",")):
        for j, label in enumerate(labels):
            assert matrix[i, j] == value.get(f"{row}/{label}", 0.0)
