# SPDX-License-Identifier: Apache-2.0
"""The plots as a layout of PlotJuggler 3: XML, as its dock widgets and plots load it.

Series are named as its ROS parser names them: a JointState by the names of its joints, a
DiagnosticArray by name of the status and key, everything else by its fields.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from typing import TypeVar

from uav_ident_ros.layouts.plots import (
    DIAGNOSTICS_TOPIC,
    Diagnostic,
    Entry,
    Names,
    Page,
    Plot,
    Source,
    pages,
)

STREAMER = "ROS2 Topic Subscriber"
"""Name of the plugin that subscribes to topics."""

SHOWN_SPAN = 60.0
"""Width of a plot before there is data, s."""

Part = TypeVar("Part")

_HEADER = """\
<?xml version='1.0' encoding='UTF-8'?>
<!-- SPDX-License-Identifier: Apache-2.0 -->
<!-- Layout for PlotJuggler 3. Generated: python -m uav_ident_ros.layouts config -->
"""


def series(source: Source) -> str:
    """Return the name that PlotJuggler gives to a series."""
    if isinstance(source, Entry):
        return f"{source.topic}/{source.name}/{source.part}"
    if isinstance(source, Diagnostic):
        return f"{DIAGNOSTICS_TOPIC}/{source.node}/{source.key}"
    return f"{source.topic}/{source.path.replace('.', '/')}"


def render(names: Names) -> str:
    """Return the layout as text."""
    root = ET.Element("root")
    tabs = ET.SubElement(root, "tabbed_widget", {"name": "Main Window", "parent": "main_window"})
    for page in pages(names):
        _tab(tabs, page)
    ET.SubElement(tabs, "currentTabIndex", index="0")
    ET.SubElement(root, "use_relative_time_offset", enabled="1")
    plugins = ET.SubElement(root, "Plugins")
    _streamer(ET.SubElement(plugins, "plugin", ID=STREAMER), names.topics)
    ET.SubElement(root, "previouslyLoaded_Datafiles")
    ET.SubElement(root, "previouslyLoaded_Streamer", name=STREAMER)
    ET.SubElement(root, "customMathEquations")
    ET.SubElement(root, "snippets")
    ET.indent(root)
    return _HEADER + ET.tostring(root, encoding="unicode") + "\n"


def _streamer(parent: ET.Element, topics: Sequence[str]) -> None:
    """Preselect the topics, by their own stamps: the imu and its prediction then match."""
    ET.SubElement(parent, "use_header_stamp", value="true")
    selected = ET.SubElement(parent, "selected_topics")
    for topic in topics:
        ET.SubElement(selected, "topic", name=topic)


def _tab(parent: ET.Element, page: Page) -> None:
    tab = ET.SubElement(parent, "Tab", tab_name=page.title, containers="1")
    container = ET.SubElement(tab, "Container")

    def row(parent: ET.Element, plots: Sequence[Plot]) -> None:
        _split(parent, "|", plots, _plot)

    _split(container, "-", page.rows, row)


def _split(
    parent: ET.Element,
    orientation: str,
    parts: Sequence[Part],
    fill: Callable[[ET.Element, Part], None],
) -> None:
    """Divide an area evenly; orientation ``-`` puts the parts below one another."""
    sizes = ";".join([f"{1.0 / len(parts):.6f}"] * len(parts))
    splitter = ET.SubElement(
        parent, "DockSplitter", orientation=orientation, count=str(len(parts)), sizes=sizes
    )
    for part in parts:
        fill(splitter, part)


def _plot(parent: ET.Element, plot: Plot) -> None:
    area = ET.SubElement(parent, "DockArea", name=plot.title)
    element = ET.SubElement(
        area, "plot", mode="TimeSeries", style="Lines", flip_x="false", flip_y="false"
    )
    low, high = (f"{value:.6f}" for value in plot.limits or (-1.0, 1.0))
    ET.SubElement(
        element, "range", left="0.000000", right=f"{SHOWN_SPAN:.6f}", bottom=low, top=high
    )
    limits = {} if plot.limits is None else {"min": low, "max": high}
    ET.SubElement(element, "limitY", limits)
    for curve in plot.curves:
        ET.SubElement(element, "curve", name=series(curve.source), color=curve.colour)
