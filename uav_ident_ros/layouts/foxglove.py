# SPDX-License-Identifier: Apache-2.0
"""The plots as a layout of Foxglove: JSON, panels by id and how they divide the window.

An array is reached by index there: the entries of ~/coefficients_named keep the order of the
structure, so a layout holds for one structure.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Any

from uav_ident_ros.layouts.plots import (
    DIAGNOSTICS_TOPIC,
    GREEN,
    ORANGE,
    Diagnostic,
    Entry,
    Names,
    Page,
    Plot,
    Source,
    pages,
)
from uav_ident_ros.messages.types import USABLE_NAME, entry_names

VIEW_WIDTH = 60.0
"""Seconds that a live plot shows."""

NOTHING_COLOUR = "#a0a0a0"
"""Colour of the verdict before there is one."""


def path(source: Source, names: Names) -> str:
    """Return the message path of a source."""
    if isinstance(source, Entry):
        index = entry_names(names.structure).index(source.name)
        return f"{source.topic}.{source.part}[{index}]"
    if isinstance(source, Diagnostic):
        return (
            f'{DIAGNOSTICS_TOPIC}.status[:]{{name=="{source.node}"}}'
            f'.values[:]{{key=="{source.key}"}}.value'
        )
    return f"{source.topic}.{source.path}"


def render(names: Names) -> str:
    """Return the layout as text."""
    panels: dict[str, Any] = {}
    tabs = [{"title": page.title, "layout": _page(page, names, panels)} for page in pages(names)]
    tabs.append({"title": "Diagnostics", "layout": _diagnostics(names, panels)})
    panels["Tab!pages"] = {"activeTabIdx": 0, "tabs": tabs}
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": "Tab!pages",
    }
    return json.dumps(layout, indent=2, ensure_ascii=False) + "\n"


def _page(page: Page, names: Names, panels: dict[str, Any]) -> Any:
    """Add the panels of a page; return how they divide it."""
    rows = []
    for plots in page.rows:
        ids = []
        for plot in plots:
            ids.append(_panel_id("Plot", f"{page.title} {plot.title}"))
            panels[ids[-1]] = _plot(plot, names)
        rows.append(_divide("row", ids))
    return _divide("column", rows)


def _panel_id(kind: str, title: str) -> str:
    """Return an id; it names the kind of panel, and what it shows."""
    return f"{kind}!{re.sub('[^a-z0-9]+', '-', title.lower()).strip('-')}"


def _divide(direction: str, parts: Sequence[Any]) -> Any:
    """Divide an area evenly: a row of columns or a column of rows, two at a time."""
    if len(parts) == 1:
        return parts[0]
    return {
        "direction": direction,
        "first": parts[0],
        "second": _divide(direction, parts[1:]),
        "splitPercentage": round(100.0 / len(parts), 2),
    }


def _plot(plot: Plot, names: Names) -> dict[str, Any]:
    panel: dict[str, Any] = {
        "foxglovePanelTitle": plot.title,
        "paths": [
            {
                "value": path(curve.source, names),
                "label": curve.label,
                "color": curve.colour,
                "enabled": True,
                # by the messages' own stamps: the imu and its prediction then match
                "timestampMethod": "headerStamp",
            }
            for curve in plot.curves
        ],
        "showLegend": True,
        "legendDisplay": "floating",
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showPlotValuesInLegend": True,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "sidebarDimension": 240,
        "followingViewWidth": VIEW_WIDTH,
    }
    if plot.limits is not None:
        panel["minYValue"], panel["maxYValue"] = plot.limits
    return panel


def _diagnostics(names: Names, panels: dict[str, Any]) -> Any:
    """Add the verdict as a light, all statuses, and the node's own in full."""
    panels["Indicator!usable"] = {
        "foxglovePanelTitle": "May a controller use it?",
        "path": path(Entry(names.coefficients, USABLE_NAME), names),
        "style": "background",
        "rules": [
            {"operator": "=", "rawValue": "1", "color": GREEN, "label": "usable"},
            {"operator": "=", "rawValue": "0", "color": ORANGE, "label": "not usable"},
        ],
        "fallbackColor": NOTHING_COLOUR,
        "fallbackLabel": "no tick yet",
    }
    panels["DiagnosticSummary!all"] = {
        "topicToRender": DIAGNOSTICS_TOPIC,
        "minLevel": 0,
        "pinnedIds": [],
        "hardwareIdFilter": "",
        "sortByLevel": True,
    }
    panels["DiagnosticStatusPanel!node"] = {
        "topicToRender": DIAGNOSTICS_TOPIC,
        "selectedHardwareId": "",
        "selectedName": names.node,
    }
    left = _divide("column", ["Indicator!usable", "DiagnosticSummary!all"])
    return _divide("row", [left, "DiagnosticStatusPanel!node"])
