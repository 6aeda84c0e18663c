# SPDX-License-Identifier: Apache-2.0
"""What the launch files share: they fail aloud, with a status, and leave nobody behind."""

from __future__ import annotations

from pathlib import Path

from launch import LaunchContext
from launch.action import Action
from launch.actions import OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events.process import ProcessExited
from launch.some_entities_type import SomeEntitiesType
from launch.substitutions import LaunchConfiguration

WRONGLY_STARTED = 2
"""Exit status of a program that was started wrongly: starting it again would not help."""


class LaunchError(Exception):
    """Why a launch cannot go on: launch says it, ends all processes, and its own status is 1."""


def files_exist(*arguments: str) -> OpaqueFunction:
    """Return an action that ends the launch if a launch argument names no file or folder.

    It has to stand before the processes: launch forgets those that were started before an
    error in the same description. launch_ros itself goes on without a missing parameter file.
    """

    def check(context: LaunchContext) -> None:
        for name in arguments:
            path = LaunchConfiguration(name).perform(context)
            if not Path(path).exists():
                expanded = Path(path).expanduser()
                hint = f"; write {name}:={expanded}" if expanded.exists() else ""
                raise LaunchError(f"{name} '{path}': there is no such file{hint}")

    return OpaqueFunction(function=check)


def fails_with(*processes: Action, respawn: str | None = None) -> list[RegisterEventHandler]:
    """Return the handlers that end the launch, with status 1, if one of its processes fails.

    Parameters
    ----------
    processes : Action
        Those that are watched.
    respawn : str, optional
        Name of the launch argument that says whether they are started again instead.
    """

    def judge(event: ProcessExited, context: LaunchContext) -> SomeEntitiesType | None:
        status = event.returncode
        again = respawn is not None and LaunchConfiguration(respawn).perform(context) == "true"
        if status == 0 or context.is_shutdown or (again and status != WRONGLY_STARTED):
            return None
        raise LaunchError(f"'{event.process_name}' ended with status {status}")

    return [
        RegisterEventHandler(OnProcessExit(target_action=process, on_exit=judge))
        for process in processes
    ]
