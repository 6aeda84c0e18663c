# SPDX-License-Identifier: Apache-2.0
"""What is written from the declaration of the settings: config/identifier.yaml, parameter tables.

``python scripts/parameter_docs.py FILE...`` renews config/identifier.yaml and, in each file, what
stands between the markers ``<!-- generated: NAME -->`` and ``<!-- end: NAME -->``. NAME is one of
`TABLES`.
"""

import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from uav_ident_ros.files.parameter_file import written
from uav_ident_ros.identification.settings import Setting, Value, declarations
from uav_ident_ros.messages.types import ACTUATOR_ADAPTERS, RATE_ADAPTERS

CONFIG = Path(__file__).resolve().parents[1] / "config" / "identifier.yaml"

MAIN_PARAMETERS = (
    "structure",
    "imu.type",
    "imu.convention",
    "imu.rpy",
    "imu.lever_arm",
    "actuators.type",
    "actuators.channels",
    "actuators.mixing.de",
    "actuators.mixing.dr",
    "actuators.mixing.da",
    "actuators.mixing.dth",
    "actuators.scale",
    "actuators.trim",
    "actuators.delay",
    "actuators.estimate_delay",
    "actuators.time_constant",
    "airspeed.type",
    "airspeed.reference",
    "initial_coefficients_file",
)
"""What a new vehicle has to look at."""

_BLOCK = re.compile(
    r"(?P<start><!-- generated: (?P<name>[\w-]+) -->\n).*?(?P<end><!-- end: (?P=name) -->)",
    re.DOTALL,
)


def write_value(value: Value) -> str:
    """Write a value as in a parameter file, words without quotes."""
    return value if isinstance(value, str) and value else written(value)


def allowed_values(setting: Setting) -> str:
    """Describe what a setting may be, in a few words; empty if anything goes."""
    if setting.name in ("imu.type", "actuators.type"):
        return "[these](#message-types)"
    if setting.choices:
        return ", ".join(f"`{write_value(choice)}`" for choice in setting.words)
    return setting.allowed() if setting.bounded else setting.unit


def full_tables() -> str:
    """Return one table of every setting for each group, with a heading."""
    groups: dict[str, list[Setting]] = {}
    for setting in declarations():
        group, _, _ = setting.name.rpartition(".")
        groups.setdefault(group, []).append(setting)
    parts = []
    for group, settings in groups.items():
        rows = [
            (
                f"`{setting.name}`",
                setting.type.replace("|", " or "),
                f"`{write_value(setting.default)}`",
                allowed_values(setting),
                setting.description,
            )
            for setting in settings
        ]
        table = markdown(("name", "type", "default", "allowed", "meaning"), rows)
        parts.append(f"### {f'`{group}`' if group else 'General'}\n\n{table}")
    return "\n".join(parts)


def main_parameters() -> str:
    """Name what a new vehicle has to look at, with the defaults."""
    known = {setting.name: setting for setting in declarations()}
    rows = [(f"`{name}`", f"`{write_value(known[name].default)}`") for name in MAIN_PARAMETERS]
    return markdown(("name", "default"), rows)


def changeable() -> str:
    """Say which parameters may change while the node runs, and what that does."""
    free = [s for s in declarations() if not s.read_only]
    at_once = ", ".join(f"`{setting.name}`" for setting in free if not setting.restarts)
    warm = ", ".join(f"`{setting.name}`" for setting in free if setting.restarts)
    return (
        f"These take effect at the next tick: {at_once}.\n\nThese change the signals: {warm}. The "
        "filters restart. The coefficients go on, with less trust, as at a warm start.\n\nThe node "
        "reads all others once, at the start: they set the meaning of the messages and of the "
        "coefficients, or their number.\n"
    )


def rates_types() -> str:
    """Return the table of the message types of the rates."""
    rows = [(f"`{name}`", "frd" if own.frd else "as set") for name, own in RATE_ADAPTERS.items()]
    return markdown(("`imu.type`", "`imu.convention`"), rows)


def actuator_types() -> str:
    """Return the table of the message types of the actuators."""
    rows = [
        (
            f"`{name}`",
            ", ".join(f"`{field}`" for field in adapter.fields),
            "index or name" if adapter.named else "index",
            "its own" if adapter.stamp else "arrival (bag: log time)",
            adapter.unit,
        )
        for name, adapter in ACTUATOR_ADAPTERS.items()
    ]
    header = ("`actuators.type`", "`actuators.field`, default first", "channels by")
    return markdown((*header, "time", "unit"), rows)


TABLES: dict[str, Callable[[], str]] = {
    "parameters": full_tables,
    "main-parameters": main_parameters,
    "changeable": changeable,
    "rates-types": rates_types,
    "actuator-types": actuator_types,
}
"""What may stand between markers, by name."""


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    cells = ([cell.replace("|", "\\|") for cell in line] for line in lines)
    return "".join(f"| {' | '.join(line)} |\n" for line in cells)


def renew(text: str) -> str:
    """Return `text` with every block between markers written anew."""

    def block(match: re.Match[str]) -> str:
        return f"{match['start']}\n{TABLES[match['name']]()}\n{match['end']}"

    return _BLOCK.sub(block, text)


# --- config/identifier.yaml ---

WIDTH = 96
"""Width of the comment lines."""

_HEADER = """\
# SPDX-License-Identifier: Apache-2.0
# Every parameter of the node `identifier` with its default. Generated from the declaration of
# the settings by scripts/make_docs.
# Copy it, keep the lines that differ, and pass it with --params-file to `identifier` (as
# `--ros-args --params-file FILE`) or to `replay`. Numbers need a decimal point: 20.0, not 20.
# `/**` means any node in any namespace; `identifier:` alone does not match /drone1/identifier.
/**:
  ros__parameters:
"""


def render() -> str:
    """Return the parameter file as text."""
    return _HEADER + "\n".join(_lines()) + "\n"


def _lines() -> Iterator[str]:
    open_groups: list[str] = []
    for setting in declarations():
        *groups, leaf = setting.name.split(".")
        for depth, group in enumerate(groups):
            if groups[: depth + 1] != open_groups[: depth + 1]:
                yield f"{_indent(depth)}{group}:"
        open_groups = groups
        indent = _indent(len(groups))
        yield from textwrap.wrap(
            _comment(setting),
            WIDTH,
            initial_indent=f"{indent}# ",
            subsequent_indent=f"{indent}# ",
            break_on_hyphens=False,
        )
        yield f"{indent}{leaf}: {written(setting.default)}"


def _indent(depth: int) -> str:
    return "  " * (depth + 2)


def _comment(setting: Setting) -> str:
    numeric = setting.type in ("float", "int", "float[]")
    if setting.choices or (numeric and setting.bounded):
        return f"{setting.description} ({setting.allowed()})"
    return f"{setting.description} ({setting.unit})" if setting.unit else setting.description


if __name__ == "__main__":
    CONFIG.write_text(render(), encoding="utf-8")
    for file in map(Path, sys.argv[1:]):
        file.write_text(renew(file.read_text(encoding="utf-8")), encoding="utf-8")
