# SPDX-License-Identifier: Apache-2.0
"""Parameters: declared as the settings say, described, and in step with the shipped file."""

import math
import re
from collections.abc import Iterator
from pathlib import Path

import parameter_docs
import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from repository import ROOT

from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.settings import Settings, declarations
from uav_ident_ros.node.parameters import declare, follow_changes, settings_of

RCLPY_REASON = re.compile("Wrong parameter type, expected|Static parameter cannot be undeclared")

SHIPPED = ROOT / "config" / "identifier.yaml"


@pytest.fixture
def context() -> Iterator[Context]:
    context = Context()
    yield context
    context.try_shutdown()


def changing(context: Context) -> tuple[Node, list[Settings]]:
    """A node whose parameters may change, and the settings that it has applied."""
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


def test_shipped_file_holds_the_defaults_by_either_reader(context: Context) -> None:
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
        # indices or names
        assert described.dynamic_typing == (setting.name == "actuators.channels"), setting.name
        if setting.type == "float" and math.isfinite(setting.high):
            assert described.floating_point_range[0].to_value == setting.high


def test_change_at_run_time_is_judged_by_the_declaration(context: Context) -> None:
    node, applied = changing(context)
    for setting in declarations():
        for wrong in (-12345, None, "basline", [math.nan]):
            (result,) = node.set_parameters([Parameter(setting.name, value=wrong)])
            assert not result.successful, (setting.name, wrong)
            # rclpy looks at the type by itself, and does not say whose.
            assert setting.name in result.reason or RCLPY_REASON.match(result.reason)
    assert applied == []


def test_change_that_is_allowed_is_applied_and_a_set_of_them_only_whole(context: Context) -> None:
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


def test_qos_override_changes_the_subscription(context: Context, tmp_path: Path) -> None:
    path = tmp_path / "qos.yaml"
    path.write_text(
        "/**:\n  ros__parameters:\n    qos_overrides:\n      /imu/data:\n"
        "        subscription: {depth: 7, reliability: reliable}\n",
        encoding="utf-8",
    )
    from uav_ident_ros.identification.identifier import OnlineIdentifier
    from uav_ident_ros.node.inputs import Inputs
    from uav_ident_ros.node.notices import Guard, Throttle

    node = make_node(context, "--params-file", str(path))
    settings = settings_of(node, ("imu/data", "actuators"))
    printed = Throttle(print)
    Inputs(node, OnlineIdentifier(settings), printed, Guard(printed))
    (profile,) = [s.qos_profile for s in node.subscriptions if s.topic_name == "/imu/data"]
    assert profile.depth == 7
    assert profile.reliability == rclpy.qos.ReliabilityPolicy.RELIABLE
