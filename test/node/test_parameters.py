# SPDX-License-Identifier: Apache-2.0
"""Parameters: declared as the settings say, described, and in step with the shipped file."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy
from node_process import ROOT
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from uav_ident_ros import parameter_template
from uav_ident_ros.identification.settings import Settings, declarations
from uav_ident_ros.parameter_file import load_parameters
from uav_ident_ros.parameters import declare, settings_of

SHIPPED = ROOT / "config" / "identifier.yaml"


@pytest.fixture
def context() -> Iterator[Context]:
    context = Context()
    yield context
    context.try_shutdown()


def make_node(context: Context, *arguments: str) -> Node:
    rclpy.init(args=["test", "--ros-args", *arguments], context=context)
    return Node("identifier", context=context)


def test_shipped_file_is_in_step_with_the_declaration() -> None:
    """On failure: python -m uav_ident_ros.parameter_template > config/identifier.yaml."""
    assert SHIPPED.read_text(encoding="utf-8") == parameter_template.render()


def test_shipped_file_holds_the_defaults_by_either_reader(context: Context) -> None:
    offline = Settings.from_values(load_parameters(SHIPPED, "identifier"))
    node = make_node(context, "--params-file", str(SHIPPED))
    assert settings_of(node, ()) == Settings() == offline


@pytest.mark.parametrize("bag", ["multisine", "pulses"])
def test_parameters_of_a_bag_are_read_alike_by_either_reader(context: Context, bag: str) -> None:
    path = ROOT / "bags" / bag / "identifier.yaml"
    node = make_node(context, "--params-file", str(path))
    given = settings_of(node, ())
    assert given == Settings.from_values(load_parameters(path, "identifier"))
    assert given != Settings()


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
        if setting.type == "float" and math.isfinite(setting.high):
            assert described.floating_point_range[0].to_value == setting.high


def test_change_at_run_time_is_judged_by_the_declaration(context: Context) -> None:
    node = make_node(context)
    declare(node, settings_of(node, ()))
    for setting in declarations():
        (result,) = node.set_parameters([Parameter(setting.name, value=-12345)])
        assert not result.successful, setting.name
        assert setting.name in result.reason


def test_qos_override_changes_the_subscription(context: Context, tmp_path: Path) -> None:
    path = tmp_path / "qos.yaml"
    path.write_text(
        "/**:\n  ros__parameters:\n    qos_overrides:\n      /imu/data:\n"
        "        subscription: {depth: 7, reliability: reliable}\n",
        encoding="utf-8",
    )
    from uav_ident_ros.identification.identifier import OnlineIdentifier
    from uav_ident_ros.inputs import ACTUATORS_TOPIC, RATES_TOPIC, RatesInput
    from uav_ident_ros.notices import Throttle

    node = make_node(context, "--params-file", str(path))
    settings = settings_of(node, (RATES_TOPIC, ACTUATORS_TOPIC))
    RatesInput(node, OnlineIdentifier(settings), Throttle(print))
    (profile,) = [s.qos_profile for s in node.subscriptions if s.topic_name == "/imu/data"]
    assert profile.depth == 7
    assert profile.reliability == rclpy.qos.ReliabilityPolicy.RELIABLE
