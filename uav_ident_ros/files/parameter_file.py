# SPDX-License-Identifier: Apache-2.0
"""ROS 2 parameter files, read offline by rcl's own rules.

A generic YAML reader would give other values: it takes ``1e-3`` for a word, ``1_000`` for a
number and ``null`` for nothing. rcl (rcl_yaml_param_parser of ROS 2 Jazzy) does not.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from uav_ident_ros.files.strict_yaml import UNUSABLE, problem

ParameterValue = bool | int | float | str | list[bool] | list[int] | list[float] | list[str] | None

PARAMETERS_KEY = "ros__parameters"

IGNORED = ("use_sim_time", "start_type_description_service")
"""Parameters of every rclpy node, which mean nothing offline."""

IGNORED_PREFIXES = ("qos_overrides.",)

_TRUE = frozenset(("Y", "y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON"))
_FALSE = frozenset(("N", "n", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF"))

# C's strtol with base 0, which is how rcl reads integers.
_INTEGER = re.compile(r"[+-]?(0[xX][0-9a-fA-F]+|0[0-7]*|[1-9][0-9]*)")
_NUMBER = re.compile(r"[+-]?(0[xX][0-9a-fA-F.]+([pP][+-]?\d+)?|[\d.]+([eE][+-]?\d+)?)", re.ASCII)
_WORD = re.compile(r"[+-]?(inf|infinity|nan)", re.IGNORECASE)
_DOTTED = re.compile(r"\.nan|\.NaN|\.NAN|[+-]?\.(inf|Inf|INF)")

_INT64_LOW, _INT64_HIGH = -(2**63), 2**63 - 1
_SMALLEST_NORMAL = 2.2250738585072014e-308
"""C's strtod reports a range error below it (and rcl then takes the word as it stands)."""

_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class ParameterFileError(Exception):
    """A parameter file cannot be read; the message names the file, the line and what is wrong."""


@dataclass(frozen=True)
class ParameterFile:
    """Content of a parameter file."""

    path: Path
    # For each section (a node name or pattern), in the order of their first lines, the values by
    # dotted name
    sections: dict[str, dict[str, ParameterValue]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path | str) -> ParameterFile:
        """Read a file.

        Raises
        ------
        ParameterFileError
            If it cannot be read or rcl would refuse it.
        """
        path, sections = Path(path), dict[str, dict[str, ParameterValue]]()
        try:
            root = yaml.compose(path.read_text(encoding="utf-8"), _Loader)
            for section, name, value in _sections(root, "", "the file") if root else ():
                values = sections.setdefault(section, {})
                if name:
                    values[name] = value
        except UNUSABLE as error:
            raise ParameterFileError(f"parameter file '{path}': {problem(error)}") from None
        return cls(path, sections)

    def values_for(
        self,
        node: str,  # Name of the node, with its namespace if it has one: ``/drone1/identifier``
    ) -> dict[str, ParameterValue]:
        """Return what rclpy gives to a node: of all matching sections the last one wins.

        Raises
        ------
        ParameterFileError
            If there are sections, but none for this node.
        """
        values: dict[str, ParameterValue] = {}
        for section in self.sections_for(node):
            values.update(self.sections[section])
        return values

    def sections_for(self, node: str) -> list[str]:
        """Return the sections that are for a node; an empty file has none.

        Raises
        ------
        ParameterFileError
            If there are sections, but none for this node.
        """
        found = [section for section in self.sections if _matches(section, node)]
        if self.sections and not found:
            raise ParameterFileError(
                f"parameter file '{self.path}' has nothing for node '{_absolute(node)}': its "
                f"sections are {', '.join(self.sections)}; write '{_absolute(node)}:' or '/**:'"
            )
        return found


def load_parameters(path: Path | str, node: str) -> dict[str, ParameterValue]:
    """Return the identifier's parameters of a file for the node called `node`.

    What every node has besides (``use_sim_time``, ``qos_overrides``) is left out.

    Raises
    ------
    ParameterFileError
        If the file cannot be read, or none of its sections is for this node.
    """
    return {
        name: value
        for name, value in ParameterFile.read(path).values_for(node).items()
        if name not in IGNORED and not name.startswith(IGNORED_PREFIXES)
    }


def written(value: Any) -> str:
    """Write a value so that rcl reads the right type: words in quotes, floats as floats."""
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(written, value))}]"
    if isinstance(value, str):
        return yaml.safe_dump(value, default_style='"', width=10_000).strip()
    return json.dumps(value)


def _absolute(name: str) -> str:
    return name if name.startswith("/") else f"/{name}"


def _matches(section: str, node: str) -> bool:
    """Whether a section's name or pattern covers a node: ``*`` one token, ``**`` any number."""
    pattern = re.escape(_absolute(section))
    pattern = pattern.replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"(/\w+)")
    return re.fullmatch(pattern, _absolute(node)) is not None


def scalar(text: str, *, quoted: bool = False) -> bool | int | float | str:
    """Give a YAML scalar the type and value that rcl gives it."""
    if quoted:
        return text
    if text in _TRUE:
        return True
    if text in _FALSE:
        return False
    if _INTEGER.fullmatch(text):
        number = _integer(text)
        if _INT64_LOW <= number <= _INT64_HIGH:
            return number
    real = _real(text)
    return text if real is None else real


def _integer(text: str) -> int:
    """Read an integer as C's strtol does: hexadecimal, octal after a leading 0, or decimal."""
    digits = text.lstrip("+-")
    octal = digits[0] == "0" and digits[1:].isdigit()
    number = int(digits, 8 if octal else 0)
    return -number if text[0] == "-" else number


def _real(text: str) -> float | None:
    """Read a number as C's strtod does; None if it is none or out of range."""
    if _DOTTED.fullmatch(text):
        text = text.replace(".", "", 1)
    if _WORD.fullmatch(text):
        return float(text)
    if not _NUMBER.fullmatch(text):
        return None
    try:
        number = float.fromhex(text) if "x" in text.lower() else float(text)
    except (ValueError, OverflowError):
        return None
    digits = re.split(r"[eEpP]" if "x" not in text.lower() else "[pP]", text)[0]
    zero = not re.search(r"[1-9a-fA-F]", digits.lower().replace("0x", ""))
    in_range = abs(number) != float("inf") and (zero or abs(number) >= _SMALLEST_NORMAL)
    return number if in_range else None


class _Loader(yaml.BaseLoader):
    """A loader that takes no aliases, as rcl does not, and knows no types."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise _malformed(self.peek_event(), "ROS does not support aliases")  # type: ignore[no-untyped-call]
        return super().compose_node(parent, index)

    def resolve(self, kind: Any, value: Any, implicit: Any) -> str:
        """Leave every scalar without a tag of its own to `scalar`."""
        return ""


def _malformed(node: Any, reason: str) -> yaml.YAMLError:
    return yaml.composer.ComposerError(None, None, reason, node.start_mark)


def _entries(node: Any, owner: str) -> Iterator[tuple[str, Any, Any]]:
    """Yield the keys of a mapping, each as text and as a node, and the values."""
    if not isinstance(node, yaml.MappingNode):
        raise _malformed(
            node,
            f"{owner} holds a value: node names, then '{PARAMETERS_KEY}:', then the parameters "
            "are needed",
        )
    for key, value in node.value:
        if not isinstance(key, yaml.ScalarNode):
            raise _malformed(key, "a key must be a plain name")
        if not key.value:
            raise _malformed(key, "there is no key")
        yield key.value, key, value


def _sections(node: Any, name: str, owner: str) -> Iterator[tuple[str, str, ParameterValue]]:
    """Yield section, dotted name and value of each parameter; one without a name for a section."""
    for key, place, value in _entries(node, owner):
        if not key.startswith(PARAMETERS_KEY):
            separator = "" if not name or name.endswith("/") else "/"
            yield from _sections(value, f"{name}{separator}{key}", f"'{key}'")
            continue
        if not name:
            raise _malformed(place, f"there is no node name before {PARAMETERS_KEY}")
        _check_name(name, place)
        yield name, "", None
        for parameter, found in _parameters(value, "", f"'{PARAMETERS_KEY}'"):
            yield name, parameter, found


def _parameters(node: Any, prefix: str, owner: str) -> Iterator[tuple[str, ParameterValue]]:
    """Yield the parameters of a mapping, nested or not."""
    if prefix and not node.value:
        raise _malformed(node, f"{owner} is an empty mapping")
    for key, _, value in _entries(node, owner):
        name = f"{prefix}{key}"
        if isinstance(value, yaml.MappingNode):
            yield from _parameters(value, f"{name}.", f"'{name}'")
        else:
            yield name, _value(value)


def _value(node: Any) -> ParameterValue:
    if isinstance(node, yaml.ScalarNode):
        return _scalar(node)
    values: list[Any] = []
    for item in node.value:
        if not isinstance(item, yaml.ScalarNode):
            raise _malformed(item, "a list can hold plain values only")
        values.append(_scalar(item))
        if type(values[-1]) is not type(values[0]):
            raise _malformed(
                item,
                f"the values of a list must be of one type: {values[0]!r} is "
                f"{_WORDS[type(values[0])]}, {values[-1]!r} is {_WORDS[type(values[-1])]}",
            )
    return values or None


_WORDS = {bool: "a bool", int: "an integer", float: "a floating-point number", str: "a word"}

_STRING_TAG = "tag:yaml.org,2002:str"
"""The tag written ``!!str``."""


def _scalar(node: yaml.ScalarNode) -> bool | int | float | str:
    quoted = node.style in ("'", '"') or node.tag == _STRING_TAG
    if not quoted and not node.value:
        raise _malformed(node, "there is no value")
    return scalar(node.value, quoted=quoted)


def _check_name(name: str, place: Any) -> None:
    """Check that a section is a node name or a pattern."""
    if name == "/**":
        return
    for token in name.removeprefix("/").split("/"):
        if token not in ("*", "**") and not _TOKEN.fullmatch(token):
            raise _malformed(
                place,
                f"'{name}' is no node name: letters, digits and '_' make one, '*' and '**' a "
                "pattern",
            )
