# SPDX-License-Identifier: Apache-2.0
"""Every path of the shipped layouts names a topic and a field that the node really publishes.

The programs' rules are written here a second time, from their sources: how PlotJuggler's ROS
parser names series, and the grammar of Foxglove's message paths.
"""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from node_process import ROOT
from rclpy.serialization import deserialize_message
from recordings import NODE, RATES_TOPIC, Fly, recording
from sensor_msgs.msg import JointState

from uav_ident_ros.player import Player

CONFIG = ROOT / "config"

STRUCTURE = "flight_dynamics"
FLIGHT = "c172p"
SECONDS = 6.0


def published(player: Player, imu: Any) -> dict[str, Any]:
    """The newest message on every topic, the Imu's included."""
    outputs = player.outputs
    return {
        RATES_TOPIC: imu,
        f"{NODE}/coefficients_named": outputs.named[-1],
        f"{NODE}/predicted_rates": outputs.predicted_rates[-1],
        f"{NODE}/prediction_error": outputs.prediction_error[-1],
        "/diagnostics": DiagnosticArray(status=[outputs.status[-1]]),
    }


def numbers(name: str, value: Any) -> Iterator[str]:
    """Names of the numbers in a message, its fields joined by '/'."""
    if isinstance(value, (int, float)):
        yield name
    elif hasattr(value, "get_fields_and_field_types"):
        for field in value.get_fields_and_field_types():
            yield from numbers(f"{name}/{field}", getattr(value, field))


def series(topic: str, message: Any) -> Iterator[str]:
    """Names of the series that PlotJuggler makes of a message."""
    if isinstance(message, JointState):
        for part in ("position", "velocity", "effort"):
            for name, _ in zip(message.name, getattr(message, part), strict=False):
                yield f"{topic}/{name}/{part}"
    elif isinstance(message, DiagnosticArray):
        for status in message.status:
            assert status.hardware_id == ""  # else it is part of the name
            for value in status.values:
                if is_number(value.value):
                    yield f"{topic}/{status.name}/{value.key}"
    else:
        yield from numbers(topic, message)


def is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


PATH = re.compile(r"""\.(\w+)(?:\[(\d+)\]|\[(:)\]\{(\w+)=="([^"]*)"\})?""")


def at(path: str, messages: dict[str, Any]) -> Any:
    """Value of a Foxglove message path: fields, indices, and the first that a filter lets pass."""
    topic, dot, rest = path.partition(".")
    value = messages[topic]
    position = 0
    while position < len(dot + rest):
        part = PATH.match(dot + rest, position)
        assert part is not None, f"'{path}' does not parse"
        field, index, every, key, wanted = part.groups()
        value = getattr(value, field)
        if index is not None:
            value = value[int(index)]
        if every is not None:
            (value,) = (entry for entry in value if getattr(entry, key) == wanted)
        position = part.end()
    return value


def foxglove_curves() -> dict[str, str]:
    """Path and label of every curve, and of the verdict's light."""
    panels = json.loads((CONFIG / "foxglove.json").read_text())["configById"]
    found = {
        curve["value"]: curve["label"]
        for panel in panels.values()
        for curve in panel.get("paths", ())
    }
    found[panels["Indicator!usable"]["path"]] = "usable"
    return found


@pytest.fixture
def messages(fly: Fly) -> dict[str, Any]:
    """What the node publishes for a flight, in the structure that the layouts are made for."""
    flight = recording(FLIGHT, SECONDS)
    _, player = fly(flight, parameters={"structure": STRUCTURE}, sim_time=True)
    player.play_in_step(flight.messages)
    player.wait_until(
        lambda: any("delay [s]" in {v.key for v in s.values} for s in player.outputs.status[-1:]),
        "a status with an estimate",
    )
    newest = next(m for m in reversed(flight.messages) if m.topic == RATES_TOPIC)
    return published(player, deserialize_message(newest.data, flight.classes[RATES_TOPIC]))


def test_the_layouts_draw_what_the_node_publishes(messages: dict[str, Any]) -> None:
    there = {name for topic, message in messages.items() for name in series(topic, message)}
    root = ET.parse(CONFIG / "plotjuggler.xml").getroot()
    drawn = {str(curve.get("name")) for curve in root.iter("curve")}
    assert drawn
    assert drawn - there == set()
    (selected,) = root.iter("selected_topics")
    assert set(str(selected.get("value")).split(";")) == set(messages)

    named = messages[f"{NODE}/coefficients_named"]
    for path, label in foxglove_curves().items():
        value = at(path, messages)
        assert isinstance(value, float) or is_number(value), path
        index = re.fullmatch(r".*/coefficients_named\.\w+\[(\d+)\]", path)
        if index is not None:  # an index says nothing by itself: the label must be right
            name = named.name[int(index.group(1))]
            assert name.removeprefix("verdict/") == label

    panel = json.loads((CONFIG / "foxglove.json").read_text())["configById"]
    status = messages["/diagnostics"].status[0]
    assert panel["DiagnosticStatusPanel!node"]["selectedName"] == status.name
    assert panel["DiagnosticStatusPanel!node"]["selectedHardwareId"] == status.hardware_id
