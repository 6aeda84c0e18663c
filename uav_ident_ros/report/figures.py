# SPDX-License-Identifier: Apache-2.0
"""A chart on the page: wide and narrow, with legend, caption and a text for those who listen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from xml.etree.ElementTree import Element

from uav_ident_ros.report.drawing import FORMATS, Draw, draw_svg
from uav_ident_ros.report.markup import element

Legend = Sequence[tuple[str, str]]
"""Names, and the colours of the style sheet that stand for them."""


def figure(
    identity: str,
    draw: Draw,
    heights: Mapping[str, float],
    *,
    heading: str,
    spoken: str,
    caption: str,
    legend: Legend = (),
) -> Element:
    """Return a ``figure``.

    Parameters
    ----------
    identity : str
        Unique on the page.
    draw : callable
        Draws the chart.
    heights : mapping
        Height of the chart for each format, inches.
    heading : str
        What it shows.
    spoken : str
        The chart in words, with its main numbers.
    caption : str
        How to read it.
    legend : sequence
        Names and colours.
    """
    result = element("figure", element("h3", heading), id=identity)
    if legend:
        result.append(_legend(legend))
    for form in FORMATS:
        svg = draw_svg(draw, form, heights[form.name], f"{identity}-{form.name}")
        svg.attrib.update({"class": form.name, "role": "img", "aria-label": spoken})
        result.append(svg)
    result.append(element("figcaption", caption))
    return result


def _legend(entries: Legend) -> Element:
    items = [
        element("li", element("span", class_="swatch", style=f"--shade:var(--{shade})"), name)
        for name, shade in entries
    ]
    return element("ul", *items, class_="legend")
