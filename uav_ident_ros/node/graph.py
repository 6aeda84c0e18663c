# SPDX-License-Identifier: Apache-2.0
"""What the ROS graph says about an input: who publishes it, as what, and what is meant instead."""

import difflib
import os

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from uav_ident_ros.node.inputs import InputMonitor

OWN_OUTPUT = "coefficients_named"
"""Where a node publishes this, its other topics are an identifier's outputs: nobody's inputs."""


def publishers(node: Node, topic: str) -> list[str]:
    """Return the full names of the nodes that publish a topic, once for each publisher."""
    return sorted(_owner(end) for end in node.get_publishers_info_by_topic(topic))


def namesakes(node: Node) -> int:
    """Return how many nodes carry the full name of `node`, itself included."""
    own = (node.get_name(), node.get_namespace())
    return int(node.get_node_names_and_namespaces().count(own))


def why_silent(node: Node, wanted: InputMonitor) -> str:
    """Return why nothing arrives on a topic, and what to do about it."""
    ends = node.get_publishers_info_by_topic(wanted.topic)
    if not ends:
        return f"nobody publishes '{wanted.topic}': {_instead(node, wanted)}"
    fitting = [end for end in ends if end.topic_type == wanted.feed.type_name]
    if not fitting:
        return _other_type(node, wanted, ends[0])
    own = (
        end.qos_profile
        for end in node.get_subscriptions_info_by_topic(wanted.topic)
        if _owner(end) == node.get_fully_qualified_name()
    )
    subscription = next(own, None)
    problems = [_mismatch(end.qos_profile, subscription) for end in fitting]
    if subscription is not None and all(problems):
        policy, offered, requested = next(filter(None, problems))
        return (
            f"'{wanted.topic}' of {_owner(fitting[0])} is {offered}, and "
            f"'qos_overrides.{wanted.topic}.subscription.{policy}' asks for {requested}: set it to "
            f"{offered}"
        )
    return f"'{wanted.topic}' has a publisher, {_owner(fitting[0])}, which sends nothing"


def _other_type(node: Node, wanted: InputMonitor, end: TopicEndpointInfo) -> str:
    """Say that a topic carries another type; which setting, or which topic, would be right."""
    carried = f"'{wanted.topic}' of {_owner(end)} carries {end.topic_type}"
    carries = f"{carried}, but {wanted.feed.type_name} is expected"
    if end.topic_type in wanted.feed.stream.types:
        return f"{carries}: set '{wanted.feed.stream.setting}' to {end.topic_type}"
    return f"{carries}: {_instead(node, wanted)}"


def _mismatch(offered: QoSProfile, requested: QoSProfile | None) -> tuple[str, str, str] | None:
    """Return the policy that keeps a publisher and a subscription apart, offered and asked."""
    if requested is None:
        return None
    best_effort, reliable = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
    if offered.reliability == best_effort and requested.reliability == reliable:
        return "reliability", "best_effort", "reliable"
    volatile, local = DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL
    if offered.durability == volatile and requested.durability == local:
        return "durability", "volatile", "transient_local"
    return None


def _instead(node: Node, wanted: InputMonitor) -> str:
    """Say which topic may be meant, or that there is none."""
    found, stream, kind = _published(node), wanted.feed.stream, wanted.feed.type_name
    same = [topic for topic, types in found.items() if kind in types]
    if same:
        best = _nearest(wanted.topic, same)
        return f"'{best}' carries {kind}: start with -r {stream.topic}:={best}"
    able = {topic: types[0] for topic, types in found.items() if types[0] in stream.types}
    if able:
        best = _nearest(wanted.topic, list(able))
        return (
            f"'{best}' carries {able[best]}: start with -r {stream.topic}:={best} "
            f"-p {stream.setting}:={able[best]}"
        )
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    return f"no other topic fits: does its source run, with ROS_DOMAIN_ID {domain}?"


def _published(node: Node) -> dict[str, list[str]]:
    """Return topics that others publish, and their types; without those of any identifier."""
    topics = {name: types for name, types in node.get_topic_names_and_types() if types}
    own = {name.rpartition("/")[0] for name in topics if name.endswith(f"/{OWN_OUTPUT}")}
    return {
        name: types
        for name, types in topics.items()
        if name.rpartition("/")[0] not in own and node.count_publishers(name)
    }


def _nearest(topic: str, names: list[str]) -> str:
    return max(sorted(names), key=lambda name: difflib.SequenceMatcher(a=topic, b=name).ratio())


def _owner(end: TopicEndpointInfo) -> str:
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"
