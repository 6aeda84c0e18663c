# SPDX-License-Identifier: Apache-2.0
"""Charts as inline SVG: matplotlib draws, the page's style sheet colours them.

A chart is drawn twice, wide and narrow, and the style sheet shows the one that fits: text that
is shrunk with a picture cannot be read on a telephone.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

from uav_ident_ros.pictures import PictureError


@dataclass(frozen=True)
class Format:
    """Size of the pictures for one kind of screen.

    Parameters
    ----------
    name : str
        Its class in the style sheet.
    width : float
        Inches.
    columns : int
        Small charts side by side.
    bins : int
        Bins of a line across the whole width; each keeps two points.
    """

    name: str
    width: float
    columns: int
    bins: int


WIDE = Format("wide", 9.0, 3, 480)
NARROW = Format("narrow", 4.7, 2, 260)
FORMATS = (WIDE, NARROW)

COLORS = {
    "ink": ("#1a1c1e", "#e6e4df"),
    "muted": ("#5b6168", "#a3a7ab"),
    "grid": ("#dcdedf", "#3a3f45"),
    "paper": ("#fefefd", "#191b1e"),
    # Okabe and Ito's palette, told apart with any colour vision; lighter on dark paper.
    "measured": ("#8e9194", "#83878c"),
    "ahead": ("#d55e00", "#ff8a3d"),
    "tick": ("#0072b2", "#56b4ea"),
    "band": ("#a9d0ea", "#27577a"),
    "third": ("#009e73", "#2cc79b"),
    "fourth": ("#a8588a", "#e09ac5"),
    "waiting": ("#bdbebf", "#6b6e71"),
    "learning": ("#e69f00", "#e69f01"),
    "converged": ("#009e74", "#009e75"),
    "paused": ("#56b4e9", "#3e86b0"),
    "fault": ("#b00020", "#ff5d6c"),
    "shade": ("#eceeef", "#26292d"),
}
"""Colours by name, on light and on dark paper. matplotlib draws with those of the first column,
and the style sheet's variable of that name takes their place."""

_NAMES = {light: name for name, (light, _) in COLORS.items()}

FONT_SIZE = 9.0
"""Points; also user units of the SVG."""

_RC: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "report",
    "font.size": FONT_SIZE,
    "axes.titlesize": FONT_SIZE,
    "axes.titley": 1.0,  # fixed: to look for what is in the way takes a fifth of the time
    "axes.linewidth": 0.6,
    "axes.facecolor": "none",
    "axes.unicode_minus": True,
    "lines.linewidth": 1.0,
    "lines.solid_joinstyle": "round",
    "path.simplify": True,
}

Draw = Callable[[Any, Format], None]
"""Draws into a matplotlib figure for a format."""


def color(name: str) -> str:
    """Return the colour to draw with that the style sheet knows as `name`."""
    return COLORS[name][0]


def draw_svg(draw: Draw, form: Format, height: float, identity: str) -> ElementTree.Element:
    """Draw a chart.

    Parameters
    ----------
    draw : callable
        Draws it.
    form : Format
        The format.
    height : float
        Inches.
    identity : str
        Unique among the charts of a page: what the parts of the SVG are called begins so.

    Returns
    -------
    Element
        An ``svg`` element without scripts, fonts, links or colours of its own.

    Raises
    ------
    PictureError
        If matplotlib is missing.
    """
    try:
        import matplotlib
        from matplotlib.backends.backend_svg import FigureCanvasSVG
        from matplotlib.figure import Figure
    except ImportError:
        raise PictureError("the report needs matplotlib (python3-matplotlib)") from None
    text = io.StringIO()
    with matplotlib.rc_context(_RC):
        figure = Figure(figsize=(form.width, height))
        FigureCanvasSVG(figure)
        figure.patch.set_visible(False)
        draw(figure, form)
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return _clean(ElementTree.fromstring(text.getvalue()), identity)


_LONG_DECIMALS = re.compile(r"(\.\d\d)\d+")
_COLOR = re.compile(r"#[0-9a-f]{6}")
_NO_ROTATION = re.compile(r"rotate\(-?0 [^)]*\)\s*")


def _clean(svg: ElementTree.Element, identity: str) -> ElementTree.Element:
    """Strip what only a file of its own needs, and hand the colours to the style sheet."""
    for element in svg.iter():
        element.tag = element.tag.rpartition("}")[2]
        attributes = {
            name.rpartition("}")[2]: value
            for name, value in element.attrib.items()
            if name.rpartition("}")[2] != "version"
        }
        element.attrib.clear()
        element.attrib.update(attributes)
        element.tail = None
        if element.tag != "text" and element.tag != "tspan":
            element.text = None
    for parent in list(svg.iter()):
        for child in [c for c in parent if c.tag in ("metadata", "style")]:
            parent.remove(child)
    del svg.attrib["width"], svg.attrib["height"]
    _name_parts(svg, identity)
    for element in svg.iter():
        _shorten(element.attrib, element.tag)
    return svg


def _name_parts(svg: ElementTree.Element, identity: str) -> None:
    """Keep the names that something refers to, and make them unique on the page."""
    used = set()
    for element in svg.iter():
        used.update(re.findall(r"url\(#([^)]+)\)", " ".join(element.attrib.values())))
        used.add(element.attrib.get("href", "").removeprefix("#"))
    for element in svg.iter():
        attributes = element.attrib
        if attributes.get("id") in used:
            attributes["id"] = f"{identity}-{attributes['id']}"
        else:
            attributes.pop("id", None)
        for name, value in attributes.items():
            if name == "href" and value.startswith("#"):
                attributes[name] = f"#{identity}-{value[1:]}"
            elif "url(#" in value:
                attributes[name] = value.replace("url(#", f"url(#{identity}-")


def _shorten(attributes: dict[str, str], tag: str) -> None:
    for name, value in attributes.items():
        if name == "d":
            value = " ".join(_LONG_DECIMALS.sub(r"\1", value).split())
        elif name in ("x", "y", "transform"):
            value = _NO_ROTATION.sub("", _LONG_DECIMALS.sub(r"\1", value))
        elif name == "style":
            value = _COLOR.sub(_variable, _text_style(value) if tag == "text" else value)
        attributes[name] = value


def _variable(match: re.Match[str]) -> str:
    name = _NAMES.get(match.group())
    return f"var(--{name})" if name else match.group()


def _text_style(style: str) -> str:
    """Leave the font to the page: matplotlib's own need not be there."""
    kept = []
    for entry in style.split(";"):
        name, _, value = entry.strip().partition(":")
        if name == "font":  # older versions put size and family into one
            size = re.search(r"[\d.]+px", value)
            kept.append(f"font-size: {size.group()}" if size else "")
        elif name and name != "font-family":
            kept.append(f"{name}:{value}")
    return "; ".join(entry for entry in kept if entry)


def tidy(panel: Any) -> None:
    """Style the axes of a panel: a light grid, no box."""
    for side, spine in panel.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(color("muted"))
    panel.tick_params(which="both", length=0, colors=color("muted"), labelcolor=color("ink"), pad=3)
    panel.tick_params(axis="x", pad=5)  # clear of the lowest label of the other axis
    panel.grid(color=color("grid"), linewidth=0.5)
    panel.set_axisbelow(True)
    for text in (panel.xaxis.label, panel.yaxis.label, panel.title):
        text.set_color(color("ink"))


def legend(panel: Any) -> None:
    """Name the lines of a panel, above it at the right."""
    panel.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=len(panel.get_legend_handles_labels()[0]),
        frameon=False,
        borderpad=0.0,
        borderaxespad=0.1,
        handlelength=1.8,
        handletextpad=0.4,
        columnspacing=0.9,
        labelcolor=color("ink"),
    )


def title(panel: Any, text: str) -> None:
    """Write a heading over the left end of a panel."""
    panel.set_title(text, loc="left", color=color("ink"), pad=4)
