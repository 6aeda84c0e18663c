# SPDX-License-Identifier: Apache-2.0
"""The shipped layouts: current, well-formed, and drawn from an estimates bag's own topics.

`test/node/test_layout_topics.py` holds every path against what a running node publishes.
"""

from __future__ import annotations

import json
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.layouts import foxglove, plotjuggler
from uav_ident_ros.layouts.__main__ import DEFAULTS, main
from uav_ident_ros.layouts.plots import Entry, Field, Names, pages

ROOT = Path(__file__).resolve().parents[1]
CONFIG = ROOT / "config"
FILES = ("plotjuggler.xml", "foxglove.json")


def test_the_shipped_files_are_current(tmp_path: Path) -> None:
    assert main([str(tmp_path)]) == 0
    for name in FILES:
        assert (tmp_path / name).read_text() == (CONFIG / name).read_text(), (
            f"config/{name} is out of step: run scripts/make_docs"
        )


def test_other_names_and_structures_can_be_written(tmp_path: Path) -> None:
    arguments = ["--node", "drone1/identifier", "--imu-topic", "/mavros/imu/data"]
    assert main([str(tmp_path), *arguments, "--structure", "baseline"]) == 0
    for name in FILES:
        text = (tmp_path / name).read_text()
        assert "/drone1/identifier/coefficients_named" in text
        assert "/mavros/imu/data" in text
        assert '"/identifier' not in text
        assert "pdot/ay" not in text


def test_a_folder_that_is_not_there_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path / "missing")]) == 1
    assert "missing" in capsys.readouterr().err


@pytest.mark.parametrize("structure", STRUCTURES)
def test_every_coefficient_is_shown_once_with_its_deviation(structure: str) -> None:
    names = Names("/identifier", "/imu/data", STRUCTURES[structure])
    shown = Counter(
        (curve.source.name, curve.source.part)
        for page in pages(names)
        for row in page.rows
        for plot in row
        for curve in plot.curves
        if isinstance(curve.source, Entry)
    )
    assert set(shown.values()) == {1}
    wanted = {(name, part) for name in names.structure.names for part in ("position", "effort")}
    assert wanted <= set(shown)


def test_curves_of_a_plot_can_be_told_apart() -> None:
    for page in pages(DEFAULTS):
        for row in page.rows:
            for plot in row:
                assert plot.curves
                assert len({curve.colour for curve in plot.curves}) == len(plot.curves)
                assert len({curve.label for curve in plot.curves}) == len(plot.curves)


# --- PlotJuggler ------------------------------------------------------------------------------


def test_plotjuggler_finds_what_it_looks_for() -> None:
    """The elements and attributes that PlotJuggler 3 reads when it restores its widgets."""
    root = ET.parse(CONFIG / "plotjuggler.xml").getroot()
    assert root.tag == "root"
    tabs = root.findall("tabbed_widget[@name='Main Window']/Tab")
    assert [tab.get("tab_name") for tab in tabs] == [page.title for page in pages(DEFAULTS)]
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
        assert sum(sizes) == pytest.approx(1.0, abs=1e-5)
        assert {child.tag for child in children} <= {"DockSplitter", "DockArea"}
    for area in root.iter("DockArea"):
        (plot,) = list(area)
        assert plot.get("mode") == "TimeSeries"
        assert [child.tag for child in plot][:2] == ["range", "limitY"]
        assert {child.tag for child in plot[2:]} == {"curve"}


def test_plotjuggler_subscribes_to_every_topic_it_draws() -> None:
    root = ET.parse(CONFIG / "plotjuggler.xml").getroot()
    (streamer,) = root.findall("Plugins/plugin")
    (previous,) = root.findall("previouslyLoaded_Streamer")
    assert streamer.get("ID") == previous.get("name") == "ROS2 Topic Subscriber"
    topics = {topic.get("name") for topic in streamer.iter("topic")}
    assert topics == set(DEFAULTS.topics)
    for curve in root.iter("curve"):
        assert any(str(curve.get("name")).startswith(f"{topic}/") for topic in topics)


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
    layout = json.loads((CONFIG / "foxglove.json").read_text())
    panels = layout["configById"]
    tabs = panels[layout["layout"]]
    assert layout["layout"].startswith("Tab!")
    assert [tab["title"] for tab in tabs["tabs"]] == [
        *(page.title for page in pages(DEFAULTS)),
        "Diagnostics",
    ]
    shown = [panel for tab in tabs["tabs"] for panel in leaves(tab["layout"])]
    assert Counter(shown) == Counter(set(panels) - {layout["layout"]})
    kinds = {"Plot", "Indicator", "DiagnosticSummary", "DiagnosticStatusPanel"}
    assert {panel.partition("!")[0] for panel in shown} == kinds
    for panel in shown:
        if panel.startswith("Plot!"):
            for drawn in panels[panel]["paths"]:
                assert drawn["enabled"]
                assert drawn["timestampMethod"] == "headerStamp"


def test_both_programs_show_the_same_curves() -> None:
    root = ET.parse(CONFIG / "plotjuggler.xml").getroot()
    layout = json.loads((CONFIG / "foxglove.json").read_text())
    declared = [
        curve.source
        for page in pages(DEFAULTS)
        for row in page.rows
        for plot in row
        for curve in plot.curves
    ]
    assert [c.get("name") for c in root.iter("curve")] == [plotjuggler.series(s) for s in declared]
    drawn = [
        curve["value"]
        for panel, content in layout["configById"].items()
        if panel.startswith("Plot!")
        for curve in content["paths"]
    ]
    assert drawn == [foxglove.path(source, DEFAULTS) for source in declared]


# --- an estimates bag -------------------------------------------------------------------------


def test_an_estimates_bag_feeds_the_layouts(tmp_path: Path) -> None:
    """Opened in either program, `estimates/` fills every plot of the node's own topics."""
    bag = ROOT / "bags" / "pulses"
    if not bag.is_dir():
        pytest.skip("the example bags are not here")
    command = [sys.executable, "-m", "uav_ident_ros.replay", str(bag), "--output", str(tmp_path)]
    command += ["--params-file", str(bag / "identifier.yaml")]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    (estimates,) = tmp_path.rglob("estimates")
    names = Names(DEFAULTS.node, DEFAULTS.rates_topic, DEFAULTS.structure)
    own = {topic for topic in names.topics if topic.startswith(f"{names.node}/")}
    with Bag(estimates) as content:
        decoders = {topic: content.decoder(topic) for topic in own}
        last = {m.topic: m.data for m in content.messages(tuple(own))}
        messages = {topic: decoders[topic](data) for topic, data in last.items()}
    assert set(messages) == own, run.stderr
    named = messages[names.coefficients]
    for page in pages(names):
        for row in page.rows:
            for plot in row:
                for curve in plot.curves:
                    source = curve.source
                    if isinstance(source, Entry):
                        index = list(named.name).index(source.name)
                        assert foxglove.path(source, names).endswith(f".{source.part}[{index}]")
                        assert len(getattr(named, source.part)) == len(named.name)
                    elif isinstance(source, Field) and source.topic in own:
                        vector, component = source.path.split(".")
                        assert isinstance(
                            getattr(getattr(messages[source.topic], vector), component), float
                        )
