# SPDX-License-Identifier: Apache-2.0
"""HTML as a tree: what is text stays text, whatever a bag or a parameter is called."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import zip_longest
from xml.etree.ElementTree import Element

Node = Element | str
"""An element or text."""


def element(tag: str, *children: Node, **attributes: str) -> Element:
    """Return an element.

    Parameters
    ----------
    tag : str
        Its tag.
    children : Element or str
        What is in it, in order.
    attributes : str
        Attributes; ``class_`` is ``class`` and ``aria_label`` is ``aria-label``.
    """
    names = {name.rstrip("_").replace("_", "-"): value for name, value in attributes.items()}
    result = Element(tag, names)
    last: Element | None = None
    for child in children:
        if isinstance(child, Element):
            result.append(child)
            last = child
        elif last is None:
            result.text = (result.text or "") + child
        else:
            last.tail = (last.tail or "") + child
    return result


def table(
    caption: str, head: Sequence[Node], rows: Iterable[Sequence[Node]], class_: str = ""
) -> Element:
    """Return a table that scrolls by itself where the screen is narrow.

    Parameters
    ----------
    caption : str
        What it shows.
    head : sequence of nodes
        Headings of the columns.
    rows : iterable of sequences of nodes
        Cells; the first of each row is its heading. A cell that is an ``td`` is taken as it is.
    class_ : str
        Class of the table.
    """
    rows = [tuple(row) for row in rows]
    body = [
        element("tr", element("th", row[0], scope="row"), *(_cell(cell) for cell in row[1:]))
        for row in rows
    ]
    first = rows[0] if rows else ()
    headings = [
        element("th", heading, scope="col", **_attributes(cell))
        for heading, cell in zip_longest(head, first, fillvalue="")
    ]
    content = element(
        "table",
        element("caption", caption),
        element("thead", element("tr", *headings)),
        element("tbody", *body),
        class_=class_ or "plain",
    )
    # A box that scrolls must be reachable with the keyboard.
    return element("div", content, class_="scroll", tabindex="0", role="region", aria_label=caption)


def _attributes(cell: Node) -> dict[str, str]:
    """Return what a heading takes over from the first cell below it."""
    words = isinstance(cell, Element) and cell.get("class") == "words"
    return {"class_": "words"} if words else {}


def _cell(cell: Node) -> Element:
    if isinstance(cell, Element) and cell.tag == "td":
        return cell
    return element("td", cell)


def number(value: float | None, style: str = ".4g", unit: str = "") -> Node:
    """Return a number to read, with the exact one in the ``data`` element around it."""
    if value is None or not math.isfinite(value):
        return "–"
    text = f"{value:{style}}".replace("-", "−")
    return element("data", f"{text}{unit}", value=repr(float(value)))
