# SPDX-License-Identifier: Apache-2.0
"""`fleet.html`: the flights of every aircraft on one page."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from bokeh.models import BoxAnnotation, ColumnDataSource, Span

from uav_ident_ros.bags.writing import write_file
from uav_ident_ros.offline.fleet import FlownAircraft
from uav_ident_ros.offline.tables import Row, Table, Words
from uav_ident_ros.report.page import Section, render
from uav_ident_ros.report.style import COLORS
from uav_ident_ros.report.timeline import Chart, hover, plain_figure, value_range

MOST_CHARTS = 24
"""Most charts of an aircraft, control derivatives first."""


def write_fleet_page(path: Path, fleet: Sequence[FlownAircraft]) -> None:
    """Write the page; raises `BagWriteError` if the file cannot be written."""
    sections = [_section(k, aircraft) for k, aircraft in enumerate(fleet)]
    findings = [f"{a.name}: {finding.text}" for a in fleet for finding in a.findings]
    flights = sum(len(a.flights) for a in fleet)
    others = sum(len({flight for flight, _ in a.unusable}) for a in fleet)
    text = "no coefficient has changed"
    if findings:
        text = f"{len(findings)} changes in {sum(bool(a.findings) for a in fleet)} aircraft"
    page = render(
        sections,
        name="Fleet",
        facts=[f"{len(fleet)} aircraft", f"{flights} usable flights", f"{others} others"],
        usable=not findings,
        verdict=text,
        advice=findings,
    )
    write_file(path, page)


def _section(k: int, aircraft: FlownAircraft) -> Section:
    tables = [aircraft.table] if aircraft.pooled else []
    others = [Row(flight, [Words(why)]) for flight, why in aircraft.unusable]
    if others:
        folded = f"{len(others)} flights without a usable model"
        tables.append(Table("Not usable", ("flight", Words("reason")), others, folded))
    count = f"{len(aircraft.flights)} usable flights."
    charts = [*_charts(k, aircraft)]
    return Section(f"aircraft-{k}", aircraft.name or "no name", tables, charts, [count])


def _charts(k: int, aircraft: FlownAircraft) -> Iterator[Chart]:
    for name in aircraft.main[:MOST_CHARTS]:
        value, sigma = aircraft.values[name], aircraft.sigmas[name]
        pooled = aircraft.pooled[name]
        own = [f for f in aircraft.findings if f.coefficient == name]
        marked = {flight for f in own for flight in (f.since, f.named)}
        colors = [COLORS["ahead" if f in marked else "tick"] for f in aircraft.flights]
        source = ColumnDataSource(
            {
                "flight": list(aircraft.flights),
                "number": np.arange(1, len(value) + 1),
                "value": value,
                "sigma": sigma,
                "low": value - sigma,
                "high": value + sigma,
                "color": colors,
            }
        )
        chart = plain_figure(180, "flight", "", y_range=value_range(value - sigma, value + sigma))
        chart.min_border_left = 0
        low, high = pooled.value - pooled.next_sigma, pooled.value + pooled.next_sigma
        chart.add_layout(BoxAnnotation(bottom=low, top=high, fill_alpha=0.2))
        chart.add_layout(Span(dimension="width", location=pooled.value, line_dash="dashed"))
        chart.segment("number", "low", "number", "high", source=source, color="color")
        drawn = chart.scatter("number", "value", source=source, color="color", size=6)
        tips = (("", "@flight"), (name, "@value{0.0000}"), ("sigma", "@sigma{0.0000}"))
        hover(chart, drawn, *tips)
        yield Chart(f"fleet-{k}-{name.replace('/', '-')}", name, chart, small=True)
