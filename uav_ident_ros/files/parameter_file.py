# SPDX-License-Identifier: Apache-2.0
"""ROS 2 parameter files, read offline by rcl's own rules.

A generic YAML reader would give other values: it takes ``1e-3`` for a word, ``1_000`` for a
number and ``null`` for nothing. rcl (rcl_yaml_param_parser of ROS 2 Jazzy) does not.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

ParameterValue = bool | int | float | str | list[bool] | list[int] | list[float] | list[str] | None

PARAMETERS_KEY = "ros__parameters"

IGNORED = ("use_sim_time", "start_type_description_service")
"""Parameters of every rclpy node, which mean nothing offline."""

IGNORED_PREFIXES = ("qos_overrides.",)

_TRUE = frozenset(("Y", "y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON"))
_FALSE = frozenset(("N", "n", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF"))

# C's strtol with base 0 and strtod, which is how rcl reads numbers.
_INTEGER = re.compile(r"[+-]?(0[xX][0-9a-fA-F]+|0[0-7]*|[1-9][0-9]*)")
_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_HEXADECIMAL = re.compile(r"[+-]?0[xX]([0-9a-fA-F]+\.?[0-9a-fA-F]*|\.[0-9a-fA-F]+)([pP][+-]?\d+)?")
_INFINITE = re.compile(r"([+-]?)(inf|infinity)", re.IGNORECASE)
_NOT_A_NUMBER = re.compile(r"[+-]?nan(\(\w*\))?", re.IGNORECASE)
_DOTTED = frozenset(
    [".nan", ".NaN", ".NAN"]
    + [sign + word for sign in ("", "+", "-") for word in (".inf", ".Inf", ".INF")]
)

_INT64_LOW, _INT64_HIGH = -(2**63), 2**63 - 1
_SMALLEST_NORMAL = 2.2250738585072014e-308
"""C's strtod reports a range error below it (and rcl then takes the word as it stands)."""

_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")

_PRECEDENCE = ("bool", "int", "float", "str", "bool[]", "int[]", "float[]", "str[]", "empty")
"""Where one name was given values of several types, rclpy takes the first of these."""


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
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8")
        except OSError as error:
            reason = "does not exist" if error.errno == errno.ENOENT else error.strerror
            raise ParameterFileError(f"parameter file '{path}': {reason}") from None
        except UnicodeDecodeError:
            raise ParameterFileError(f"parameter file '{path}' is not text in UTF-8") from None
        try:
            return cls(path, _Parser(text).sections())
        except _MalformedError as error:
            raise ParameterFileError(f"parameter file '{path}', {error}") from None

    def values_for(self, node: str) -> dict[str, ParameterValue]:
        """Return what rclpy gives to a node: of all matching sections the last one wins.

        Parameters
        ----------
        node : str
            Name of the node, with its namespace if it has one: ``/drone1/identifier``.

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


def _absolute(name: str) -> str:
    return name if name.startswith("/") else f"/{name}"


def _matches(section: str, node: str) -> bool:
    """Whether a section's name or pattern covers a node: ``*`` one token, ``**`` any number."""
    pattern = re.escape(_absolute(section))
    pattern = pattern.replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"(/\w+)")
    return re.fullmatch(pattern, _absolute(node)) is not None


class _MalformedError(Exception):
    """Line and reason."""

    def __init__(self, mark: Any, reason: str) -> None:
        line = f"line {mark.line + 1}: " if mark is not None else ""
        super().__init__(f"{line}{reason}")


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
    if text in _DOTTED:
        text = text.replace(".", "", 1)
    if _INFINITE.fullmatch(text):
        return float(text)
    if _NOT_A_NUMBER.fullmatch(text):
        return float("nan")
    if _DECIMAL.fullmatch(text):
        number = float(text)
    elif _HEXADECIMAL.fullmatch(text):
        try:
            number = float.fromhex(text)
        except OverflowError:
            return None
    else:
        return None
    zero = not re.search(r"[1-9a-fA-F]", re.split(r"[eEpP]", text.lower().replace("0x", ""))[0])
    in_range = abs(number) != float("inf") and (zero or abs(number) >= _SMALLEST_NORMAL)
    return number if in_range else None


def _type_name(value: Any) -> str:
    return type(value).__name__


class _Parser:
    """Walks the events of a YAML text as rcl does."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._sections: dict[str, dict[str, dict[str, ParameterValue]]] = {}

    def sections(self) -> dict[str, dict[str, ParameterValue]]:
        """Parameters by section and dotted name."""
        try:
            # Events, not a document: a document would already have lost the scalars' text.
            self._events: Iterator[Any] = iter(
                [e for e in yaml.parse(self._text, yaml.SafeLoader) if not _is_frame(e)]
            )
        except yaml.MarkedYAMLError as error:
            problem = error.problem or "it is not YAML"
            raise _MalformedError(error.problem_mark or error.context_mark, problem) from None
        except yaml.YAMLError as error:
            reason = str(error).splitlines()[0]
            raise _MalformedError(None, reason) from None
        for event in self._events:
            if isinstance(event, yaml.ScalarEvent):
                continue  # a document without content
            self._expect_mapping(event, "the file")
            self._section("")
        return {
            section: {name: _preferred(typed) for name, typed in parameters.items()}
            for section, parameters in self._sections.items()
        }

    def _expect_mapping(self, event: Any, owner: str) -> None:
        if isinstance(event, yaml.AliasEvent):
            raise _MalformedError(event.start_mark, "ROS does not support aliases")
        if not isinstance(event, yaml.MappingStartEvent):
            raise _MalformedError(
                event.start_mark,
                f"{owner} holds a value: node names, then '{PARAMETERS_KEY}:', then the parameters "
                "are needed",
            )

    def _entries(self) -> Iterator[tuple[str, Any, Any]]:
        """Key, its event and the first event of the value, to the end of the mapping."""
        for key in self._events:
            if isinstance(key, yaml.MappingEndEvent):
                return
            if not isinstance(key, yaml.ScalarEvent):
                raise _MalformedError(key.start_mark, "a key must be a plain name")
            if not key.value:
                raise _MalformedError(key.start_mark, "there is no key")
            yield key.value, key, next(self._events)

    def _section(self, name: str) -> None:
        """Read a mapping of node names, or of a node to its parameters."""
        for key, event, value in self._entries():
            if not key.startswith(PARAMETERS_KEY):
                self._expect_mapping(value, f"'{key}'")
                separator = "" if not name or name.endswith("/") else "/"
                self._section(f"{name}{separator}{key}")
                continue
            if not name:
                raise _MalformedError(
                    event.start_mark, f"there is no node name before {PARAMETERS_KEY}"
                )
            _check_name(name, event.start_mark)
            self._expect_mapping(value, f"'{PARAMETERS_KEY}'")
            self._parameters("", self._sections.setdefault(name, {}), value)

    def _parameters(
        self, prefix: str, target: dict[str, dict[str, ParameterValue]], start: Any
    ) -> None:
        """Read a mapping of parameters, nested or not."""
        empty = bool(prefix)
        for key, _, value in self._entries():
            empty = False
            name = f"{prefix}{key}"
            if isinstance(value, yaml.MappingStartEvent):
                self._parameters(f"{name}.", target, value)
                continue
            typed = target.setdefault(name, {})
            kind, read = self._value(value)
            typed[kind] = read
        if empty:
            raise _MalformedError(start.start_mark, f"'{prefix[:-1]}' is an empty mapping")

    def _value(self, event: Any) -> tuple[str, ParameterValue]:
        """Type and value of a parameter."""
        if isinstance(event, yaml.AliasEvent):
            raise _MalformedError(event.start_mark, "ROS does not support aliases")
        if isinstance(event, yaml.ScalarEvent):
            single = _scalar(event)
            return _type_name(single), single
        values: list[Any] = []
        for item in self._events:
            if isinstance(item, yaml.SequenceEndEvent):
                break
            if isinstance(item, yaml.AliasEvent):
                raise _MalformedError(item.start_mark, "ROS does not support aliases")
            if not isinstance(item, yaml.ScalarEvent):
                raise _MalformedError(item.start_mark, "a list can hold plain values only")
            values.append(_scalar(item))
            if type(values[-1]) is not type(values[0]):
                raise _MalformedError(
                    item.start_mark,
                    f"the values of a list must be of one type: {values[0]!r} is "
                    f"{_WORDS[type(values[0])]}, {values[-1]!r} is {_WORDS[type(values[-1])]}",
                )
        if not values:
            return "empty", None
        return f"{_type_name(values[0])}[]", values


_WORDS = {bool: "a bool", int: "an integer", float: "a floating-point number", str: "a word"}


_STRING_TAG = "tag:yaml.org,2002:str"
"""The tag written ``!!str``."""


def _is_frame(event: Any) -> bool:
    """Whether an event only frames streams and documents."""
    frames = (yaml.StreamStartEvent, yaml.StreamEndEvent)
    return isinstance(event, (*frames, yaml.DocumentStartEvent, yaml.DocumentEndEvent))


def _scalar(event: yaml.ScalarEvent) -> bool | int | float | str:
    quoted = event.style in ("'", '"') or event.tag == _STRING_TAG
    if not quoted and not event.value:
        raise _MalformedError(event.start_mark, "there is no value")
    return scalar(event.value, quoted=quoted)


def _check_name(name: str, mark: Any) -> None:
    """Check that a section is a node name or a pattern."""
    if name == "/**":
        return
    for token in name.removeprefix("/").split("/"):
        if token not in ("*", "**") and not _TOKEN.fullmatch(token):
            raise _MalformedError(
                mark,
                f"'{name}' is no node name: letters, digits and '_' make one, '*' and '**' a "
                "pattern",
            )


def _preferred(typed: dict[str, ParameterValue]) -> ParameterValue:
    return typed[min(typed, key=_PRECEDENCE.index)]
