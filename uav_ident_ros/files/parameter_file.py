# SPDX-License-Identifier: Apache-2.0
"""Reader of ROS 2 parameter files without ROS, by the rules of rcl.

A generic YAML reader gives other values: ``1e-3`` as a string, ``1_000`` as a number and ``null``
as None. rcl (rcl_yaml_param_parser of ROS 2 Jazzy) gives a number and two strings.
"""

from __future__ import annotations

import ctypes
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from uav_ident_ros.files.strict_yaml import UNUSABLE, malformed, problem

ParameterValue = bool | int | float | str | list[bool] | list[int] | list[float] | list[str] | None

PARAMETER_FILE = "identifier.yaml"
"""The file beside a bag: the meaning of its topics."""

PARAMETERS_KEY = "ros__parameters"

IGNORED = ("use_sim_time", "start_type_description_service")
"""Parameters of every rclpy node, without effect offline."""

QOS_PREFIX = "qos_overrides."
"""Prefix of the subscriptions' parameters, also without effect offline."""

_TRUE = frozenset(("Y", "y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON"))
_FALSE = frozenset(("N", "n", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF"))

_DOTTED = re.compile(r"\.(nan|NaN|NAN)|[+-]?\.(inf|Inf|INF)")
"""YAML's NaN and infinities, which C writes without the dot."""

_TOKEN = r"([A-Za-z_][A-Za-z0-9_]*|\*\*?)"
_SECTION = re.compile(rf"/?{_TOKEN}(/{_TOKEN})*")
"""A node name, or a pattern of one."""


class ParameterFileError(Exception):
    """A parameter file cannot be read; the message names file, line and problem."""


@dataclass(frozen=True)
class ParameterFile:
    """Content of a parameter file."""

    path: Path
    # Values by dotted name for each section (a node name or pattern), in the order of the file
    sections: dict[str, dict[str, ParameterValue]] = field(default_factory=dict)
    # Section and name of each parameter that a section gives more than once: the last counts
    repeated: tuple[tuple[str, str], ...] = ()

    @classmethod
    def read(cls, path: Path | str) -> ParameterFile:
        """Read a file; raises `ParameterFileError` if it is unreadable or rcl refuses it."""
        path, sections = Path(path), dict[str, dict[str, ParameterValue]]()
        repeated: dict[tuple[str, str], None] = {}
        try:
            root = yaml.compose(path.read_text(encoding="utf-8"), _Loader)
            for section, name, value in _sections(root, "", "the file") if root else ():
                values = sections.setdefault(section, {})
                if name in values:
                    repeated[section, name] = None
                if name:
                    values[name] = value
        except UNUSABLE as error:
            raise ParameterFileError(f"parameter file '{path}': {problem(error)}") from None
        return cls(path, sections, (*repeated,))

    def sections_for(self, node: str) -> list[str]:
        """Return the sections for a node, ``/drone1/identifier``; an empty file has none.

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

    def doubts(self, node: str) -> list[str]:
        """Return a sentence on each parameter of a node that a section gives more than once."""
        return [
            f"parameter file '{self.path}' gives '{name}' more than once in section '{section}': "
            f"{written(self.sections[section][name])}, the last, counts; keep one of them"
            for section, name in self.repeated
            if _matches(section, node)
        ]

    def parameters_for(self, node: str) -> dict[str, ParameterValue]:
        """Return the values in the `sections_for` a node; as in rclpy, the last section wins.

        The parameters of every node (``use_sim_time``, ``qos_overrides``) are left out.
        """
        return {
            name: value
            for section in self.sections_for(node)
            for name, value in self.sections[section].items()
            if name not in IGNORED and not name.startswith(QOS_PREFIX)
        }


def load_parameters(path: Path | str, node: str) -> dict[str, ParameterValue]:
    """Return the parameters in a file for the node named `node`: see `parameters_for`.

    Raises
    ------
    ParameterFileError
        If the file cannot be read, or none of its sections is for this node.
    """
    return ParameterFile.read(path).parameters_for(node)


def written(value: Any) -> str:
    """Return the text of a value with the right type for rcl: strings are quoted."""
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(written, value))}]"
    if isinstance(value, str):
        return yaml.safe_dump(value, default_style='"', width=10_000).strip()
    return json.dumps(value)


def _absolute(name: str) -> str:
    return name if name.startswith("/") else f"/{name}"


def _matches(section: str, node: str) -> bool:
    """Return whether a section covers a node; ``*`` is one token, ``**`` any number."""
    pattern = re.escape(_absolute(section))
    pattern = pattern.replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"(/\w+)")
    return re.fullmatch(pattern, _absolute(node)) is not None


_STRING_TAG = "tag:yaml.org,2002:str"
"""The tag written ``!!str``."""

_C = ctypes.CDLL(None, use_errno=True)
_END = ctypes.POINTER(ctypes.c_char_p)
_C.strtoll.argtypes, _C.strtoll.restype = (ctypes.c_char_p, _END, ctypes.c_int), ctypes.c_longlong
_C.strtod.argtypes, _C.strtod.restype = (ctypes.c_char_p, _END), ctypes.c_double


def _scalar(node: yaml.ScalarNode) -> bool | int | float | str:
    """Return a YAML scalar with the type and value of rcl."""
    text = str(node.value)
    if node.style in ("'", '"') or node.tag == _STRING_TAG:
        return text
    if not text:
        raise malformed(node, "there is no value")
    if text in _TRUE or text in _FALSE:
        return text in _TRUE
    integer = _read(_C.strtoll, text, 0)  # hexadecimal, octal after a leading 0, or decimal
    if integer is not None:
        return int(integer)
    real = _read(_C.strtod, text.replace(".", "", 1) if _DOTTED.fullmatch(text) else text)
    return text if real is None else real


def _read(function: Callable[..., float], text: str, *base: int) -> float | None:
    """Return a number by a function of C, as in rcl; None if it is invalid or out of range."""
    content, rest = text.encode(), ctypes.c_char_p()
    ctypes.set_errno(0)
    number = function(content, ctypes.byref(rest), *base)
    return None if rest.value or ctypes.get_errno() else number


class _Loader(yaml.BaseLoader):
    """A loader without types, which refuses aliases, as rcl does."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise malformed(self.peek_event(), "ROS does not support aliases")  # type: ignore[no-untyped-call]
        return super().compose_node(parent, index)

    def resolve(self, kind: Any, value: Any, implicit: Any) -> str:
        """Return no tag: `_scalar` gives the type."""
        return ""


def _entries(node: Any, owner: str) -> Iterator[tuple[Any, Any]]:
    """Yield the keys and values of a mapping, as nodes."""
    if not isinstance(node, yaml.MappingNode):
        content = "is empty" if node.value == "" else "holds a value"
        raise malformed(
            node,
            f"{owner} {content}: '/**:' or a node's name is needed, below it '{PARAMETERS_KEY}:', "
            "and below that the parameters",
        )
    for key, value in node.value:
        if not isinstance(key, yaml.ScalarNode):
            raise malformed(key, "a key must be a plain name")
        if not key.value:
            raise malformed(key, "there is no key")
        yield key, value


def _sections(node: Any, name: str, owner: str) -> Iterator[tuple[str, str, ParameterValue]]:
    """Yield section, dotted name and value of each parameter; for each section an empty name."""
    for key, value in _entries(node, owner):
        if not key.value.startswith(PARAMETERS_KEY):
            if key.value.replace("_", "") == PARAMETERS_KEY.replace("_", ""):
                raise malformed(key, f"'{key.value}' has to be '{PARAMETERS_KEY}'")
            separator = "" if not name or name.endswith("/") else "/"
            yield from _sections(value, f"{name}{separator}{key.value}", f"'{key.value}'")
            continue
        if not name:
            raise malformed(key, f"there is no node name before {PARAMETERS_KEY}")
        if not _SECTION.fullmatch(name):
            reason = "letters, digits and '_' make one, '*' and '**' a pattern"
            raise malformed(key, f"'{name}' is no node name: {reason}")
        yield name, "", None
        for parameter, found in _parameters(value, "", f"'{PARAMETERS_KEY}'"):
            yield name, parameter, found


def _parameters(node: Any, prefix: str, owner: str) -> Iterator[tuple[str, ParameterValue]]:
    """Yield the parameters of a mapping, nested or not."""
    if prefix and not node.value:
        raise malformed(node, f"{owner} is an empty mapping")
    for key, value in _entries(node, owner):
        name = f"{prefix}{key.value}"
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
            raise malformed(item, "a list can hold plain values only")
        values.append(_scalar(item))
        if type(values[-1]) is not type(values[0]):
            raise malformed(
                item,
                f"the values of a list must be of one type: {values[0]!r} is "
                f"{_TYPES[type(values[0])]}, {values[-1]!r} is {_TYPES[type(values[-1])]}",
            )
    return values or None


_TYPES = {bool: "a bool", int: "an integer", float: "a floating-point number", str: "a word"}
