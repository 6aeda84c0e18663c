# SPDX-License-Identifier: Apache-2.0
"""Parameters: declared from the settings, and changed in flight, with a fit that recovers."""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import parameter_docs
import pytest
import rclpy
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from recordings import Fly, Player, recording
from repository import ROOT

from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.settings import Setting, Settings, declarations
from uav_ident_ros.messages.types import header_ns
from uav_ident_ros.node.parameters import PARAMETER_TYPES, declare, follow_changes, settings_of

RCLPY_REASON = re.compile("Wrong parameter type, expected|Static parameter cannot be undeclared")

SHIPPED = ROOT / "config" / "identifier.yaml"


@pytest.fixture
def context() -> Iterator[Context]:
    context = Context()
    yield context
    context.try_shutdown()


def changing(context: Context) -> tuple[Node, list[Settings]]:
    """Return a node with changeable parameters, and the list of its applied settings."""
    node = make_node(context)
    settings = settings_of(node, ())
    declare(node, settings)
    applied: list[Settings] = []
    follow_changes(node, settings, applied.append)
    return node, applied


def make_node(context: Context, *arguments: str) -> Node:
    rclpy.init(args=["test", "--ros-args", *arguments], context=context)
    return Node("identifier", context=context)


def test_shipped_file_is_in_step_with_the_declaration() -> None:
    """On failure: scripts/make_docs."""
    assert SHIPPED.read_text(encoding="utf-8") == parameter_docs.render()


def test_shipped_file_has_the_defaults_in_rclpy_and_offline(context: Context) -> None:
    offline = Settings.from_values(load_parameters(SHIPPED, "identifier"))
    node = make_node(context, "--params-file", str(SHIPPED))
    assert settings_of(node, ()) == Settings() == offline


def test_every_parameter_is_declared_with_its_value_and_described(context: Context) -> None:
    node = make_node(context, "-p", "actuators.trim:=[0.0, 0.0, 0.0, 0.5]")
    settings = settings_of(node, ())
    declare(node, settings)
    values = settings.values()
    assert values["actuators.trim"] == (0.0, 0.0, 0.0, 0.5)
    for setting in declarations():
        value = node.get_parameter(setting.name).value
        wanted = values[setting.name]
        assert (tuple(value) if isinstance(wanted, tuple) else value) == wanted, setting.name
        described = node.describe_parameter(setting.name)
        assert described.description.startswith(setting.description)
        assert setting.unit in described.description
        assert described.read_only == setting.read_only
        if setting.choices:
            assert f"one of: {setting.allowed()}" in described.additional_constraints
        # indices or names
        assert described.dynamic_typing == (setting.name == "actuators.channels"), setting.name
        if setting.type == "float" and math.isfinite(setting.high):
            assert described.floating_point_range[0].to_value == setting.high


def test_invalid_changes_at_run_time_are_refused_with_the_parameter(context: Context) -> None:
    node, applied = changing(context)
    for setting in declarations():
        for wrong in (-12345, None, "basline", [math.nan]):
            (result,) = node.set_parameters([Parameter(setting.name, value=wrong)])
            assert not result.successful, (setting.name, wrong)
            # rclpy checks the type itself, without the parameter's name.
            assert setting.name in result.reason or RCLPY_REASON.match(result.reason)
    assert applied == []


def test_valid_changes_are_applied_and_an_atomic_set_only_as_a_whole(context: Context) -> None:
    node, applied = changing(context)
    (result,) = node.set_parameters([Parameter("forgetting_time", value=60.0)])
    assert result.successful, result.reason
    assert applied[-1].forgetting_time == 60.0
    both = [Parameter("model.leak_time", value=2.0), Parameter("forgetting_time", value=-1.0)]
    result = node.set_parameters_atomically(both)
    assert not result.successful
    assert "forgetting_time out of range Min: 0.0" in result.reason
    assert node.get_parameter("model.leak_time").value == Settings().model.leak_time
    assert len(applied) == 1
    both[1] = Parameter("supervision.min_fit", value=40.0)
    assert node.set_parameters_atomically(both).successful
    assert len(applied) == 2
    assert (applied[1].model.leak_time, applied[1].supervision.min_fit) == (2.0, 40.0)
    assert applied[1].forgetting_time == 60.0
    (result,) = node.set_parameters([Parameter("update_rate", value=10.0)])
    assert not result.successful
    assert "update_rate" in result.reason
    assert "read once" in node.describe_parameter("update_rate").additional_constraints


CHANGEABLE = [setting for setting in declarations() if not setting.read_only]
LEARNING = ("forgetting_time", "model.leak_time")
"""Settings that change the estimate without a restart."""

TICK_NS = 50_000_000


def other(setting: Setting, value: Any) -> Any:
    """Return a slightly different valid value."""
    if isinstance(value, str):
        return next(choice for choice in setting.choices if choice != value)
    if isinstance(value, tuple):
        return [other(setting, v) for v in value]
    return 1.05 * value if value else 0.02


def set_all(player: Player, settings: list[Setting], values: dict[str, Any]) -> None:
    """Set parameters one after the other, like `ros2 param set`."""
    for setting in settings:
        value = values[setting.name]
        parameter = Parameter(setting.name, PARAMETER_TYPES[setting.type], value)
        message = parameter.to_parameter_msg()
        (result,) = player.call(SetParameters, "set_parameters", parameters=[message]).results
        assert result.successful, (setting.name, result.reason)


def test_settings_without_effect_on_the_model_change_no_bit(fly: Fly, tmp_path: Path) -> None:
    """They are thresholds, the injected signal and the period of saving."""
    flight = recording("multisine", 8.0)
    _, player = fly(flight)
    half = len(flight.messages) // 2
    player.play_in_step(flight.messages[:half])
    ticks = player.ticks()
    before = Settings.from_values(load_parameters(flight.parameter_file, "identifier")).values()
    quiet = [s for s in CHANGEABLE if not s.restarts and s.name not in LEARNING]
    set_all(player, quiet, {s.name: other(s, before[s.name]) for s in quiet})
    player.play_in_step(flight.messages[half:])
    assert ticks | player.ticks() == flight.replayed(tmp_path)


def test_every_change_misses_no_tick_and_the_fit_recovers(fly: Fly) -> None:
    """Each setting changes slightly, one after the other; then all return to their values."""
    flight = recording("multisine", 24.0)
    _, player = fly(flight)
    before = Settings.from_values(load_parameters(flight.parameter_file, "identifier")).values()
    changes = [s for s in CHANGEABLE if s.restarts or s.name in LEARNING]
    seconds = np.cumsum([8.0, *[1.0] * len(changes), 8.0])
    ends = flight.messages[0].log_ns + np.round(1e9 * seconds).astype(int)

    def play(part: int) -> tuple[list[int], list[dict[str, float]]]:
        """Return the stamps, ns, and the published values of each."""
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
