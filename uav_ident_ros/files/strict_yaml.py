# SPDX-License-Identifier: Apache-2.0
"""Strict reading of YAML: unique keys, checked entries."""

import errno
import math
from collections.abc import Collection, Mapping
from decimal import Decimal
from typing import Any

import yaml

from uav_ident_ros.identification.settings import nearest
from uav_ident_ros.messages.types import NS_PER_S


class EntryError(Exception):
    """An entry is wrong; the message names it and the allowed values."""


def malformed(place: Any, reason: str) -> yaml.YAMLError:
    """Return the error for a node or an event, with its line for `problem`."""
    return yaml.MarkedYAMLError(problem=reason, problem_mark=place.start_mark)


class _UniqueKeys:
    """Part of a loader that refuses a key that occurs twice; PyYAML takes the last."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Return a mapping; raises a YAMLError if a key occurs twice."""
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise malformed(key, "a key must be a plain name")
            if key.value in seen:
                raise malformed(key, f"'{key.value}' is there twice: keep one of the two")
            seen.add(key.value)
        return dict(super().construct_mapping(node, deep))  # type: ignore[misc]


class StrictLoader(_UniqueKeys, yaml.BaseLoader):
    """A loader of text, mappings and lists; the caller converts the text."""


class TypedLoader(_UniqueKeys, yaml.SafeLoader):
    """A loader of values with the types of YAML."""


UNUSABLE = (OSError, UnicodeDecodeError, RecursionError, yaml.YAMLError, EntryError)
"""Exceptions from reading and checking a text file."""


def problem(error: BaseException) -> str:
    """Return the problem of a file in one line, from one of `UNUSABLE`, with its line number."""
    if isinstance(error, yaml.MarkedYAMLError):
        mark = error.problem_mark or error.context_mark
        reason = str(error.problem or error.context)
        if r"'\t'" in reason:
            reason = "there is a tab: YAML is indented with spaces"
        return f"line {mark.line + 1 if mark else 1}: {reason}"
    if isinstance(error, OSError):
        missing = error.errno == errno.ENOENT
        return "there is no such file or folder" if missing else error.strerror or str(error)
    if isinstance(error, UnicodeDecodeError):
        return "it is not text in UTF-8"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    return str(error).splitlines()[0]


def mapping(
    content: Any, owner: str, needed: Collection[str], optional: Collection[str] = ()
) -> dict[str, Any]:
    """Return a mapping with all needed keys and no keys but these and the optional ones.

    Raises
    ------
    EntryError
        If it is no mapping, lacks a key or has an unknown one.
    """
    allowed = (*needed, *optional)
    if not isinstance(content, Mapping):
        raise EntryError(f"{owner} must be a mapping with {', '.join(allowed)}")
    for key in content:
        if key not in allowed:
            raise EntryError(f"{owner} has an unknown entry '{key}': {meant(str(key), allowed)}")
    if missing := [key for key in needed if key not in content]:
        raise EntryError(f"{owner} has no {', '.join(missing)}")
    return dict(content)


def nanoseconds(
    text: Any,
    unit_ns: int,  # Unit of the text, ns
    latest_ns: int,  # First time out of range, ns
    what: str,
    cure: str = "",  # Remedy for a time out of range, ends the message
) -> int:
    """Return a stamp in ns; decimals are exact, while floats lose ns of times since 1970.

    Raises
    ------
    EntryError
        If it is no number, negative or too late.
    """
    try:
        t_ns = Decimal(text) * unit_ns
        if 0 <= t_ns < latest_ns:  # checked first: the int may have a million digits
            return int(t_ns.to_integral_value())
    except (ArithmeticError, ValueError, TypeError):
        raise EntryError(f"{what} is '{text}', which is no number{comma(text)}") from None
    raise EntryError(f"{what} is '{text}': a stamp holds 0 to {latest_ns // NS_PER_S} s{cure}")


def comma(text: Any) -> str:
    """Return the cure for a decimal comma, as in tables of some countries; else nothing."""
    return ": decimals need a point" if "," in str(text) else ""


def meant(name: str, known: Collection[str]) -> str:
    """Return a hint: the nearest of the known names, or all of them if none is near."""
    return nearest(name, known) or f"allowed are {', '.join(known)}"


def finite(value: Any, what: str) -> float:
    """Return a finite number; raises `EntryError` otherwise."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise EntryError(f"{what} is {value!r}: a finite number is needed")
    return float(value)
