# SPDX-License-Identifier: Apache-2.0
"""The shipped layouts: well-formed, and every name in them is one that the node publishes.

`test/node/test_layout_topics.py` holds every path against what a running node publishes.
"""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path
from typing import Any

from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.messages.published import entry_names

CONFIG = Path(__file__).resolve().parents[1] / "config"
NAMED = "/identifier/coefficients_named"
STRUCTURE = STRUCTURES["flight_dynamics"]
"""Structure that the layouts are made for."""

PARTS = ("position", "effort")


def plotjuggler() -> ET.Element:
    return ET.parse(CONFIG / "plotjuggler.xml").getroot()


def foxglove() -> dict[str, Any]:
    return json.loads((CONFIG / "foxglove.json").read_text())


def foxglove_curves() -> list[dict[str, Any]]:
    panels = foxglove()["configById"].values()
    return [curve for panel in panels for curve in panel.get("paths", ())]


def entries_in_plotjuggler() -> Counter[tuple[str, str]]:
    """Name and part of every entry of ~/coefficients_named that is drawn."""
    curves = [str(curve.get("name")) for curve in plotjuggler().iter("curve")]
    own = [c.removeprefix(f"{NAMED}/") for c in curves if c.startswith(f"{NAMED}/")]
    return Counter((name, part) for name, _, part in (c.rpartition("/") for c in own))


def entries_in_foxglove() -> Counter[tuple[str, str]]:
    """Name and part of every entry, by its index in the arrays."""
    names = entry_names(STRUCTURE)
    found = [
        re.fullmatch(rf"{NAMED}\.(\w+)\[(\d+)\]", curve["value"]) for curve in foxglove_curves()
    ]
    return Counter((names[int(m.group(2))], m.group(1)) for m in found if m is not None)


def test_every_coefficient_is_drawn_once_with_its_deviation() -> None:
    coefficients = {(name, part) for name in STRUCTURE.names for part in PARTS}
    others = {(n, "position") for n in entry_names(STRUCTURE) if n not in STRUCTURE.names}
    for drawn in (entries_in_plotjuggler(), entries_in_foxglove()):
        assert set(drawn.values()) == {1}
        assert coefficients <= set(drawn) <= coefficients | others


def test_both_programs_draw_the_same_entries() -> None:
    assert entries_in_plotjuggler() == entries_in_foxglove()


# --- PlotJuggler ------------------------------------------------------------------------------


def test_plotjuggler_finds_what_it_looks_for() -> None:
    """The elements and attributes that PlotJuggler 3 reads when it restores its widgets."""
    root = plotjuggler()
    tabs = root.findall("tabbed_widget[@name='Main Window']/Tab")
    assert tabs
    for tab in tabs:
        containers = tab.findall("Container")
        assert str(len(containers)) == tab.get("containers")
        for container in containers:
            (splitter,) = list(container)
            assert splitter.tag == "DockSplitter"
    for splitter in root.iter("DockSplitter"):
        children = list(splitter)
        assert splitter.get("orientation") in ("|", "-")
        assert splitter.get("count") == str(len(children))
        sizes = [float(size) for size in str(splitter.get("sizes")).split(";")]
        assert len(sizes) == len(children)
        assert {child.tag for child in children} <= {"DockSplitter", "DockArea"}
    for area in root.iter("DockArea"):
        (plot,) = list(area)
        assert plot.get("mode") == "TimeSeries"
        assert [child.tag for child in plot][:2] == ["range", "limitY"]
        assert {child.tag for child in plot[2:]} == {"curve"}


def test_plotjuggler_subscribes_to_every_topic_it_draws() -> None:
    """As its ROS plugins save it since January 2024, see their parser_configuration.cpp."""
    root = plotjuggler()
    (streamer,) = root.findall("Plugins/plugin")
    (previous,) = root.findall("previouslyLoaded_Streamer")
    assert streamer.get("ID") == previous.get("name") == "ROS2 Topic Subscriber"
    saved = {child.tag: str(child.get("value")) for child in streamer}
    assert saved["use_header_stamp"] == "true"
    # a larger array is cut or thrown away: ~/coefficients_named must pass whole
    assert int(saved["max_array_size"]) > max(len(entry_names(s)) for s in STRUCTURES.values())
    topics = saved["selected_topics"].split(";")
    curves = [str(curve.get("name")) for curve in root.iter("curve")]
    assert all(any(name.startswith(f"{topic}/") for topic in topics) for name in curves)
    assert all(any(name.startswith(f"{topic}/") for name in curves) for topic in topics)


# --- Foxglove ---------------------------------------------------------------------------------


def leaves(layout: Any) -> list[str]:
    """Panel ids of a tree of splits; a split has two parts and a share."""
    if isinstance(layout, str):
        return [layout]
    assert set(layout) == {"direction", "first", "second", "splitPercentage"}
    assert layout["direction"] in ("row", "column")
    assert 0.0 < layout["splitPercentage"] < 100.0
    return leaves(layout["first"]) + leaves(layout["second"])


def test_foxglove_finds_every_panel_once() -> None:
    layout = foxglove()
    panels = layout["configById"]
    tabs = panels[layout["layout"]]["tabs"]
    shown = [panel for tab in tabs for panel in leaves(tab["layout"])]
    assert Counter(shown) == Counter(set(panels) - {layout["layout"]})
    kinds = {"Plot", "Indicator", "DiagnosticSummary", "DiagnosticStatusPanel"}
    assert {panel.partition("!")[0] for panel in shown} == kinds


def test_foxglove_draws_by_the_stamps() -> None:
    curves = foxglove_curves()
    assert curves
    assert all(c["enabled"] and c["timestampMethod"] == "headerStamp" for c in curves)
