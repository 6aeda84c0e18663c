# SPDX-License-Identifier: Apache-2.0
"""The settings as ROS parameters: declared with full descriptors, checked before anything runs.

The checks go beyond those of rcl and rclpy: misspelt names, integers in place of doubles, arrays
of the wrong length, ranges of array entries.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from uav_ident_ros.files.parameter_file import IGNORED, QOS_PREFIX
from uav_ident_ros.identification.settings import (
    Setting,
    Settings,
    SettingsError,
    declarations,
    nearest,
)

PARAMETER_TYPES = {
    "bool": Parameter.Type.BOOL,
    "int": Parameter.Type.INTEGER,
    "float": Parameter.Type.DOUBLE,
    "str": Parameter.Type.STRING,
    "float[]": Parameter.Type.DOUBLE_ARRAY,
    "str[]": Parameter.Type.STRING_ARRAY,
}
"""Setting type to parameter type; settings of other types accept two parameter types."""

QOS_POLICIES: dict[str, dict[str, Any]] = {
    "history": {"type": "str", "choices": ("keep_last", "keep_all")},
    "depth": {"type": "int", "low": 1, "high": 100_000},
    "reliability": {"type": "str", "choices": ("reliable", "best_effort", "system_default")},
    "durability": {"type": "str", "choices": ("volatile", "transient_local", "system_default")},
}
"""QoS policies of the subscriptions that may be overridden, with the allowed values. rclpy ignores
a misspelt override, and fails on a wrong one."""


def settings_of(node: Node, topics: Sequence[str]) -> Settings:
    """Build the settings from the parameters of the command line and the parameter files.

    The QoS of its subscriptions to `topics` may be overridden.

    Raises
    ------
    SettingsError
        If a name is unknown or a value is not allowed.
    """
    overridable: dict[str, Setting] = {}
    for topic in map(node.resolve_topic_name, topics):
        for policy, allowed in QOS_POLICIES.items():
            name = f"{QOS_PREFIX}{topic}.subscription.{policy}"
            overridable[name] = Setting(name, default="", unit="", description="", **allowed)
    values: dict[str, object] = {}
    # rclpy has no public accessor (rclcpp has get_parameter_overrides), and automatic declaration
    # fails on an empty list.
    for name, parameter in node._parameter_overrides.items():
        if name in overridable:
            overridable[name].check(parameter.value)
        elif name.startswith(QOS_PREFIX):
            hint = nearest(name, overridable) or f"there are {', '.join(overridable)}"
            raise SettingsError(f"there is no parameter '{name}': {hint}")
        elif name not in IGNORED:
            values[name] = parameter.value
    return Settings.from_values(values)


def declare(node: Node, settings: Settings) -> None:
    """Declare every setting as a parameter of `node`, with its present value."""
    values = settings.values()
    for setting in declarations():
        name, value, final = setting.name, values[setting.name], descriptor(setting)
        plain = list(value) if isinstance(value, tuple) else value
        kind = PARAMETER_TYPES.get(setting.type)
        if kind is None:
            node.declare_parameter(name, plain, final, ignore_override=True)
            continue
        # The final descriptor comes last: rclpy cannot infer the type of an empty list.
        open_ = ParameterDescriptor(description=final.description)
        node.declare_parameter(name, kind, open_, ignore_override=True)
        node.set_parameters([Parameter(name, kind, plain)])
        node.set_descriptor(name, final)


def descriptor(setting: Setting) -> ParameterDescriptor:
    """Return the descriptor of a setting, for ``ros2 param describe`` and rqt_reconfigure."""
    unit = f" [{setting.unit}]" if setting.unit else ""
    result = ParameterDescriptor(
        name=setting.name,
        description=setting.description + unit,
        additional_constraints=_constraints(setting),
        read_only=setting.read_only,
        dynamic_typing=setting.type not in PARAMETER_TYPES,
    )
    if setting.type in PARAMETER_TYPES:
        result.type = PARAMETER_TYPES[setting.type].value
    if setting.type == "float" and setting.bounded:
        result.floating_point_range = [
            FloatingPointRange(from_value=setting.low, to_value=setting.high, step=0.0)
        ]
    return result


def _constraints(setting: Setting) -> str:
    """Return constraints as text: choices, ranges of array entries, the effect of a change."""
    parts = []
    if setting.choices:
        parts.append(f"one of: {setting.allowed()}")
    elif setting.type.endswith("[]") and (setting.low > -math.inf or setting.high < math.inf):
        parts.append(f"each: {setting.allowed()}")
    if setting.read_only:
        parts.append("read once, at the start")
    elif setting.restarts:
        parts.append("a change restarts the filters; the coefficients go on")
    return "; ".join(parts)


def follow_changes(node: Node, settings: Settings, apply: Callable[[Settings], object]) -> None:
    """Check changes of parameters at run time against the declaration, and apply allowed ones.

    The callbacks run between ticks, like services. Parameters that are set atomically are checked
    and applied together.
    """

    def changed(parameters: list[Parameter]) -> Settings:
        before = settings.values()
        return Settings.from_values(
            before | {p.name: p.value for p in parameters if p.name in before}
        )

    def judge(parameters: list[Parameter]) -> SetParametersResult:
        try:
            changed(parameters)
        except SettingsError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def follow(parameters: list[Parameter]) -> None:
        nonlocal settings
        before, settings = settings, changed(parameters)
        for name, value in settings.values().items():
            if value != before.values()[name]:
                node.get_logger().info(f"'{name}' is now {value}")
        if settings != before:
            apply(settings)

    node.add_on_set_parameters_callback(judge)
    node.add_post_set_parameters_callback(follow)
