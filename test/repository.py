# SPDX-License-Identifier: Apache-2.0
"""Declarations of the repository: setup.py and the launch files."""

import re
import runpy
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import setuptools

ROOT = Path(__file__).resolve().parents[1]


def setup_arguments() -> dict[str, Any]:
    """Run setup.py with a recording stand-in for `setuptools.setup`; return its arguments."""
    recorded: dict[str, Any] = {}
    with mock.patch.object(setuptools, "setup", lambda **arguments: recorded.update(arguments)):
        runpy.run_path(str(ROOT / "setup.py"))
    return recorded


def console_scripts() -> dict[str, str]:
    """Return the executables and their entry points."""
    lines = setup_arguments()["entry_points"]["console_scripts"]
    return dict(re.split(r"\s*=\s*", line, maxsplit=1) for line in lines)


# --- launch files, without launch: a stand-in for each class keeps its arguments ---------------

MODULES = (
    "launch", "launch.action", "launch.actions", "launch.conditions", "launch.event_handlers",
    "launch.events", "launch.events.process", "launch.some_entities_type", "launch.substitutions",
    "launch_ros", "launch_ros.actions", "launch_ros.parameter_descriptions",
    "launch_ros.substitutions",
)  # fmt: skip


@dataclass
class Made:
    """An object of launch: its class and its arguments."""

    kind: str
    args: tuple[Any, ...]
    named: dict[str, Any]

    def perform(self, context: dict[str, str]) -> str:
        return context[self.args[0]]


class StandIn(ModuleType):
    """A stand-in for a module of launch: its classes keep their arguments."""

    def __getattr__(self, kind: str) -> Any:
        return lambda *args, **named: Made(kind, args, named)


def launch_entries(path: Path) -> list[Made]:
    """Return the contents of a launch file's description."""
    with mock.patch.dict(sys.modules, {name: StandIn(name) for name in MODULES}):
        sys.modules.pop("uav_ident_ros.launching", None)
        return list(runpy.run_path(str(path))["generate_launch_description"]().args[0])


def everything(value: Any) -> Iterator[Made]:
    """Yield every object of launch in a description, nested or not."""
    if isinstance(value, Made):
        yield value
        value = [*value.args, *value.named.values()]
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for item in value:
            yield from everything(item)


def read_arguments(made: list[Made]) -> set[str]:
    return {m.args[0] for m in everything(made) if m.kind == "LaunchConfiguration"}


def launch_arguments(made: list[Made]) -> list[Made]:
    return [m for m in made if m.kind == "DeclareLaunchArgument"]
