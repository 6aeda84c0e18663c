# SPDX-License-Identifier: Apache-2.0
"""The shipped layouts: well-formed, and the node publishes every path in them.

This file restates the programs' rules from their sources: PlotJuggler's restoration of widgets
and its names of series, and the grammar of Foxglove's message paths.
"""

import json
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.serialization import deserialize_message
from recordings import NODE, RATES_TOPIC, Fly, recording
from repository import ROOT
from sensor_msgs.msg import JointState

from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.messages.published import entry_names

NAMED = f"{NODE}/coefficients_named"
STRUCTURE = STRUCTURES["flight_dynamics"]
"""Structure of the layouts."""

PLOTJUGGLER = ET.parse(ROOT / "config" / "plotjuggler.xml").getroot()
FOXGLOVE: dict[str, Any] = json.loads((ROOT / "config" / "foxglove.json").read_text())
PANELS = FOXGLOVE["configById"]
DRAWN = [str(curve.get("name")) for curve in PLOTJUGGLER.iter("curve")]
"""Curves of PlotJuggler, by name."""

CURVES = [curve for panel in PANELS.values() for curve in panel.get("paths", ())]
"""Curves of Foxglove."""


# --- the files --------------------------------------------------------------------------------


def test_the_plotjuggler_layout_restores_its_subscriber_and_topics() -> None:
    """The format is that of its ROS plugins since January 2024 (parser_configuration.cpp)."""
    (streamer,) = PLOTJUGGLER.findall("Plugins/plugin")
    (previous,) = PLOTJUGGLER.findall("previouslyLoaded_Streamer")
    assert streamer.get("ID") == previous.get("name") == "ROS2 Topic Subscriber"
    saved = {child.tag: str(child.get("value")) for child in streamer}
    assert saved["use_header_stamp"] == "true"
    # larger arrays are cut or discarded: ~/coefficients_named must fit
    assert int(saved["max_array_size"]) > max(len(entry_names(s)) for s in STRUCTURES.values())
    topics = saved["selected_topics"].split(";")
    assert all(any(name.startswith(f"{topic}/") for name in DRAWN) for topic in topics)


def leaves(layout: Any) -> list[str]:
    """Return the panel ids of a tree of splits."""
    if isinstance(layout, str):
        return [layout]
    return leaves(layout["first"]) + leaves(layout["second"])


def test_the_foxglove_layout_has_every_panel_once_on_header_stamps() -> None:
    tabs = PANELS[FOXGLOVE["layout"]]["tabs"]
    shown = [panel for tab in tabs for panel in leaves(tab["layout"])]
    assert Counter(shown) == Counter(set(PANELS) - {FOXGLOVE["layout"]})
    kinds = {"Plot", "Indicator", "DiagnosticSummary", "DiagnosticStatusPanel"}
    assert {panel.partition("!")[0] for panel in shown} == kinds
    assert all(c["enabled"] and c["timestampMethod"] == "headerStamp" for c in CURVES)


# --- with a node ------------------------------------------------------------------------------


def numbers(topic: str, path: str, value: Any) -> Iterator[tuple[str, str]]:
    """Yield every number of a message: its series in PlotJuggler, its path in Foxglove."""
    if isinstance(value, JointState):
        for part in ("position", "velocity", "effort"):
            for i, (name, _) in enumerate(zip(value.name, getattr(value, part), strict=False)):
                yield f"{topic}/{name}/{part}", f"{path}.{part}[{i}]"
    elif isinstance(value, DiagnosticStatus):
        assert value.hardware_id == ""  # otherwise a part of the name
        for entry in value.values:
            with suppress(ValueError):
                float(entry.value)
                where = f'.status[:]{{name=="{value.name}"}}.values[:]{{key=="{entry.key}"}}.value'
                yield f"{topic}/{value.name}/{entry.key}", f"{path}{where}"
    elif isinstance(value, (int, float)):
        yield topic, path
    elif hasattr(value, "get_fields_and_field_types"):
        for field in value.get_fields_and_field_types():
            yield from numbers(f"{topic}/{field}", f"{path}.{field}", getattr(value, field))


@pytest.fixture
def messages(fly: Fly) -> dict[str, Any]:
    """Return the node's messages for a flight, in the structure of the layouts."""
    flight = recording("c172p", 6.0)
    _, player = fly(flight, parameters={"structure": STRUCTURE.name})
    player.play_in_step(flight.messages)
    player.wait_until(
        lambda: any("delay [s]" in {v.key for v in s.values} for s in player.outputs.status[-1:]),
        "a status with an estimate",
    )
    newest = next(m for m in reversed(flight.messages) if m.topic == RATES_TOPIC)
    outputs = player.outputs
    return {
        RATES_TOPIC: deserialize_message(newest.data, flight.classes[RATES_TOPIC]),
        NAMED: outputs.named[-1],
        f"{NODE}/predicted_rates": outputs.predicted_rates[-1],
        f"{NODE}/prediction_error": outputs.prediction_error[-1],
        "/diagnostics": outputs.status[-1],
    }


def test_the_node_publishes_every_path_of_the_layouts(messages: dict[str, Any]) -> None:
    there = [pair for topic, message in messages.items() for pair in numbers(topic, topic, message)]
    series, paths = {name for name, _ in there}, {path: name for name, path in there}
    assert set(DRAWN) - series == set()
    (selected,) = PLOTJUGGLER.iter("selected_topics")
    assert set(str(selected.get("value")).split(";")) == set(messages)

    # both draw the same entries, each once, and every coefficient with its sigma
    entries = Counter(name for name in DRAWN if name.startswith(NAMED))
    assert entries == Counter(n for c in CURVES if (n := paths[c["value"]]).startswith(NAMED))
    assert set(entries.values()) == {1}
    parts = ("position", "effort")
    assert {f"{NAMED}/{name}/{part}" for name in STRUCTURE.names for part in parts} <= set(entries)

    light = PANELS["Indicator!usable"]["path"]
    for path, label in [(c["value"], c["label"]) for c in CURVES] + [(light, "usable")]:
        name = paths[path]
        if name.startswith(f"{NAMED}/"):  # an index needs its label
            entry = name.removeprefix(f"{NAMED}/").rpartition("/")[0]
            assert entry.removeprefix("verdict/") == label

    panel, status = PANELS["DiagnosticStatusPanel!node"], messages["/diagnostics"]
    assert panel["selectedName"] == status.name
    assert panel["selectedHardwareId"] == status.hardware_id
