# SPDX-License-Identifier: Apache-2.0
"""Parser of a page into a tree, by the standard library, with the nesting checked."""

import xml.etree.ElementTree as ET
from html.parser import HTMLParser

VOID = {"meta", "br", "img", "link", "input", "hr"}
"""HTML elements without an end tag."""


class _Parser(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tree = ET.TreeBuilder()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = {name: value or "" for name, value in attrs}
        assert len(attributes) == len(attrs), f"<{tag}> has an attribute twice"
        self.tree.start(tag, attributes)
        self.open.append(tag)
        if tag in VOID:
            self.handle_endtag(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"</{tag}> closes something else"
        self.tree.end(tag)

    def handle_data(self, data: str) -> None:
        if self.open:
            self.tree.data(data)


def parse(text: str) -> ET.Element:
    """Return the page as a tree."""
    parser = _Parser()
    parser.feed(text)
    parser.close()
    assert not parser.open, f"<{parser.open[-1]}> is not closed"
    return parser.tree.close()


def one(element: ET.Element, path: str) -> ET.Element:
    """Return the only element below another at a path."""
    (found,) = element.iterfind(f".//{path}")
    return found


def words(element: ET.Element) -> str:
    """Return all text in an element."""
    return "".join(element.itertext())


def table(page: ET.Element, caption: str) -> ET.Element:
    """Return the table whose caption starts with a text."""
    (found,) = [t for t in page.iter("table") if words(one(t, "caption")).startswith(caption)]
    return found


def rows_of(page: ET.Element, caption: str) -> dict[str, list[ET.Element]]:
    """Return the cells of a table's rows, by the row headings."""
    rows = one(table(page, caption), "tbody").iter("tr")
    return {words(one(row, "th")): [*row.iter("td")] for row in rows}
