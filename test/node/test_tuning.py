# SPDX-License-Identifier: Apache-2.0
"""`ros2 param set` in flight: every setting that may change does, and the fit recovers."""

from pathlib import Path
from typing import Any

import numpy as np
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from recordings import Fly, call, published, recording, replayed

from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.settings import Setting, Settings, declarations
from uav_ident_ros.messages.types import header_ns
from uav_ident_ros.node.parameters import PARAMETER_TYPES
from uav_ident_ros.player import Player

CHANGEABLE = [setting for setting in declarations() if not setting.read_only]
LEARNING = ("forgetting_time", "model.leak_time")
"""What changes the estimate, and restarts nothing."""

TICK_NS = 50_000_000


def other(setting: Setting, value: Any) -> Any:
    """A value that is a little different."""
    if isinstance(value, str):
        return next(choice for choice in setting.choices if choice != value)
    if isinstance(value, tuple):
        return [other(setting, v) for v in value]
    return 1.05 * value if value else 0.02


def set_all(player: Player, settings: list[Setting], values: dict[str, Any]) -> None:
    """Set parameters as `ros2 param set` does, one after the other."""
    for setting in settings:
        value = values[setting.name]
        parameter = Parameter(setting.name, PARAMETER_TYPES[setting.type], value)
        message = parameter.to_parameter_msg()
        (result,) = call(player, SetParameters, "set_parameters", parameters=[message]).results
        assert result.successful, (setting.name, result.reason)


def test_settings_that_need_no_restart_change_no_bit(fly: Fly, tmp_path: Path) -> None:
    """Thresholds, the signal to inject, how often it saves: set them all, and the model goes on."""
    flight = recording("multisine", 16.0)
    _, player = fly(flight)
    half = len(flight.messages) // 2
    player.play_in_step(flight.messages[:half])
    ticks = published(player.outputs)
    before = Settings.from_values(load_parameters(flight.parameter_file, "identifier")).values()
    quiet = [s for s in CHANGEABLE if not s.restarts and s.name not in LEARNING]
    set_all(player, quiet, {s.name: other(s, before[s.name]) for s in quiet})
    player.play_in_step(flight.messages[half:])
    assert ticks | published(player.outputs) == replayed(flight, tmp_path)


def test_every_change_is_followed_and_the_fit_recovers(fly: Fly) -> None:
    """Each a little wrong, one after the other; then all set back, and the fit is as before."""
    flight = recording("multisine", 40.0)
    _, player = fly(flight)
    before = Settings.from_values(load_parameters(flight.parameter_file, "identifier")).values()
    changes = [s for s in CHANGEABLE if s.restarts or s.name in LEARNING]
    seconds = np.cumsum([12.0, *[2.0] * len(changes), 12.0])
    ends = flight.messages[0].log_ns + np.round(1e9 * seconds).astype(int)

    def play(part: int) -> tuple[list[int], list[dict[str, float]]]:
        """Stamps, ns, and what is published with each."""
        begin = ends[part - 1] if part else 0
        player.play_in_step([m for m in flight.messages if begin < m.log_ns <= ends[part]])
        named = player.outputs.named
        stamps = [header_ns(m) for m in named]
        assert set(np.diff(stamps)) == {TICK_NS}, "no tick is missed"
        return stamps, [dict(zip(m.name, m.position, strict=True)) for m in named]

    stamps, values = play(0)
    fit = np.array([values[-1][f"fit/{axis}"] for axis in "pqr"])
    for part, setting in enumerate(changes, start=1):
        set_all(player, [setting], {setting.name: other(setting, before[setting.name])})
        last_ns, last = stamps[-1], values[-1]
        stamps, values = play(part)
        if setting.restarts:
            assert stamps[0] - last_ns <= 4 * TICK_NS, setting.name
            kept = [name for name in last if "dot/" in name and "usable" not in name]
            assert [values[0][n] for n in kept] == [last[n] for n in kept], setting.name
        else:
            assert stamps[0] - last_ns == TICK_NS, setting.name
    set_all(player, changes, {setting.name: before[setting.name] for setting in changes})
    _, values = play(len(changes) + 1)
    again = np.array([values[-1][f"fit/{axis}"] for axis in "pqr"])
    assert (again > fit - 2.0).all(), (fit, again)
