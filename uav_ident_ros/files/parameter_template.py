# SPDX-License-Identifier: Apache-2.0
"""The parameter file with every default, written from the declaration of the settings.

``python -m uav_ident_ros.files.parameter_template > config/identifier.yaml``
"""

import json
import sys
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

import yaml

from uav_ident_ros.identification.settings import Setting, Settings, Value, declarations

WIDTH = 96
"""Width of the comment lines."""

_HEADER = """\
# SPDX-License-Identifier: Apache-2.0
# Every parameter of the node `identifier` with its default. Generated from the declaration of
# the settings: python -m uav_ident_ros.files.parameter_template > config/identifier.yaml
# Copy it, keep the lines that differ, and pass it with --params-file to `identifier` (as
# `--ros-args --params-file FILE`) or to `replay`. Numbers need a decimal point: 20.0, not 20.
# `/**` means any node in any namespace; `identifier:` alone does not match /drone1/identifier.
/**:
  ros__parameters:
"""


def render(
    settings: Settings | None = None,  # The values to write; the defaults if left out
) -> str:
    """Return the parameter file as text."""
    values = (settings or Settings()).values()
    return _HEADER + "\n".join(_lines(values)) + "\n"


def _lines(values: Mapping[str, Value]) -> Iterator[str]:
    open_groups: list[str] = []
    for setting in declarations():
        *groups, leaf = setting.name.split(".")
        shared = 0
        while shared < min(len(groups), len(open_groups)) and (
            groups[shared] == open_groups[shared]
        ):
            shared += 1
        for depth in range(shared, len(groups)):
            yield f"{_indent(depth)}{groups[depth]}:"
        open_groups = groups
        indent = _indent(len(groups))
        yield from textwrap.wrap(
            _comment(setting),
            WIDTH,
            initial_indent=f"{indent}# ",
            subsequent_indent=f"{indent}# ",
            break_on_hyphens=False,
        )
        yield f"{indent}{leaf}: {written(values[setting.name])}"


def _indent(depth: int) -> str:
    return "  " * (depth + 2)


def _comment(setting: Setting) -> str:
    numeric = setting.type in ("float", "int", "float[]")
    if setting.choices or (numeric and setting.bounded):
        return f"{setting.description} ({setting.allowed()})"
    return f"{setting.description} ({setting.unit})" if setting.unit else setting.description


def written(value: Value | list[Any]) -> str:
    """Write a value so that rcl reads the right type: words in quotes, floats as floats."""
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(written, value))}]"
    if isinstance(value, str):
        return yaml.safe_dump(value, default_style='"', width=10_000).strip()
    return json.dumps(value)


if __name__ == "__main__":
    sys.stdout.write(render())
