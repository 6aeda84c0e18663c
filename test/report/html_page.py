# SPDX-License-Identifier: Apache-2.0
"""A page as a tree, by the standard library's HTML parser, with the nesting checked."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from html.parser import HTMLParser

VOID = {"meta", "br", "img", "link", "input", "hr"}
"""Elements of HTML without an end."""


@dataclass
class Node:
    """An element: tag, attributes, and what is in it."""

    tag: str
    attributes: dict[str, str]
    children: list[Node | str] = field(default_factory=list)

    def all(self, tag: str = "", **attributes: str) -> Iterator[Node]:
        """Yield this element and those below it that have the tag and the attributes."""
        wanted = {name.rstrip("_"): value for name, value in attributes.items()}
        if tag in ("", self.tag) and wanted.items() <= self.attributes.items():
            yield self
        for child in self.children:
            if isinstance(child, Node):
                yield from child.all(tag, **attributes)

    def one(self, tag: str = "", **attributes: str) -> Node:
        """Return the only element with the tag and the attributes."""
        (found,) = self.all(tag, **attributes)
        return found

    @property
    def text(self) -> str:
        """All text in it."""
        return "".join(c if isinstance(c, str) else c.text for c in self.children)

    def rows(self) -> list[list[Node]]:
        """Cells of every row of a table's body."""
        (body,) = self.all("tbody")
        return [[*row.all("th"), *row.all("td")] for row in body.all("tr")]


class _Parser(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.root = Node("", {})
        self._open = [self.root]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        node = Node(tag, {name: value or "" for name, value in attrs})
        assert len(node.attributes) == len(attrs), f"<{tag}> has an attribute twice"
        self._open[-1].children.append(node)
        if tag not in VOID:
            self._open.append(node)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop().tag == tag, f"</{tag}> closes something else"

    def handle_data(self, data: str) -> None:
        self._open[-1].children.append(data)

    def close(self) -> None:
        super().close()
        assert self._open == [self.root], f"<{self._open[-1].tag}> is not closed"


def parse(text: str) -> Node:
    """Return the page as a tree."""
    parser = _Parser()
    parser.feed(text)
    parser.close()
    return parser.root
