# SPDX-License-Identifier: Apache-2.0
"""Recordings for the node tests, and the offline replay of the same messages."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from excerpts import BAGS, decoded, replay, written
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter

from uav_ident_ros.bags.reading import Bag, Message
from uav_ident_ros.bags.writing import jazzy_types
from uav_ident_ros.commandline import NOT_USABLE, USABLE
from uav_ident_ros.messages.types import header_ns, import_type
from uav_ident_ros.player import START_UP_NS
from uav_ident_ros.player import Player as PlainPlayer
from uav_ident_ros.process import NodeProcess

RATES_TOPIC, ACTUATORS_TOPIC = "/imu/data", "/actuators"
TOPICS = (RATES_TOPIC, ACTUATORS_TOPIC)
NODE = "/identifier"

Spoil = Callable[[Any], Any]
"""Function that alters a message, or returns the bytes to send instead."""

TickValues = dict[int, tuple[float, ...]]
"""All published values of a tick, by its stamp in ns."""


class Player(PlainPlayer):
    """A player at the speed of its node."""

    def play_in_step(self, messages: Sequence[Message]) -> None:
        """Discard earlier outputs and play without loss of messages.

        Messages that continue from the last output are in step from the start: /clock half a second
        ahead of the messages would abort a run of excitation.
        """
        goes_on = 0 <= messages[0].log_ns - self.outputs.newest_ns < START_UP_NS
        self.outputs.clear()
        start_up_ns = 0 if goes_on else START_UP_NS
        self.play(messages, speed=math.inf, in_step=True, start_up_ns=start_up_ns)

    def ticks(self) -> TickValues:
        """Return the node's outputs by tick."""
        out = self.outputs
        return joined(out.named, out.predicted_rates, out.prediction_error)

    def call(self, kind: Any, service: str, **request: object) -> Any:
        """Call a service of the node; return its response."""
        name = f"{NODE}/{service}"
        client = self.node.create_client(kind, name)
        self.wait_until(client.service_is_ready, f"service '{name}'")
        future = client.call_async(kind.Request(**request))
        self.wait_until(future.done, f"an answer of '{name}'")
        self.node.destroy_client(client)
        return future.result()

    def wait_for_status(self) -> None:
        """Wait for a status after all played messages; the next status may precede them."""
        wanted = len(self.outputs.status) + 2
        self.wait_until(lambda: len(self.outputs.status) >= wanted, "two statuses")

    def wait_for_text(self, words: str) -> None:
        """Wait until the diagnostics contain a text."""
        self.wait_until(lambda: any(words in s.message for s in self.outputs.status), words)

    def entries(self) -> dict[str, str]:
        """Return the diagnostics' entries after all played messages."""
        self.wait_for_status()
        return {entry.key: entry.value for entry in self.outputs.status[-1].values}


Fly = Callable[..., tuple[NodeProcess, Player]]


@dataclass(frozen=True)
class Recording:
    """The first part of a bag."""

    messages: list[Message]
    types: dict[str, str]
    parameter_file: Path

    @property
    def classes(self) -> dict[str, type]:
        return {topic: import_type(name) for topic, name in self.types.items()}

    def part(self, begin: float, end: float) -> list[Message]:
        """Return the messages between two times after the start, s."""
        start_ns = self.messages[0].log_ns
        return [m for m in self.messages if begin <= (m.log_ns - start_ns) * 1e-9 < end]

    def replayed(self, folder: Path) -> TickValues:
        """Run `replay` on the messages; return the contents of its bag of estimates."""
        bag = written(folder / "flight", self.types, self.messages)
        status = replay(bag, folder / "out", by=self.parameter_file)
        assert status in (USABLE, NOT_USABLE)
        return estimates(folder / "out")


def recording(name: str, seconds: float) -> Recording:
    """Load the first seconds of a committed bag."""
    folder = BAGS / name
    with Bag(folder) as bag:
        types = {topic: bag.type_of(topic) for topic in TOPICS}
        end_ns = bag.start_ns + int(seconds * 1e9)
        messages = [m for m in bag.messages(TOPICS) if m.log_ns <= end_ns]
    return Recording(messages, types, folder / "identifier.yaml")


def encoded(topic: str, log_ns: int, message: Any) -> Message:
    """Return a message of `uav_ident_ros.bags.writing` as the player sends it."""
    return Message(topic, log_ns, bytes(jazzy_types().serialize_cdr(message, message.__msgtype__)))


def put(name: str, value: Any) -> Spoil:
    """Return a function that sets a field of a message, nested or not."""

    def change(message: Any) -> None:
        *path, last = name.split(".")
        for part in path:
            message = getattr(message, part)
        setattr(message, last, value)

    return change


def change(player: Player, values: dict[str, object]) -> None:
    """Set parameters of the node while it runs."""
    named = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    answer = player.call(SetParametersAtomically, "set_parameters_atomically", parameters=named)
    assert answer.result.successful, answer.result.reason


def estimates(folder: Path) -> TickValues:
    """Return the contents of the bag of estimates in a folder of results."""
    names = ("coefficients_named", "predicted_rates", "prediction_error")
    found = decoded(folder / "estimates")
    return joined(*([m for _, m in found[f"{NODE}/{name}"]] for name in names))


def joined(named: Iterable, predicted: Iterable, error: Iterable) -> TickValues:
    """Return coefficients, sigmas, predicted rates and prediction errors, by tick."""
    ticks = {header_ns(m): (*m.position, *m.effort) for m in named}
    for messages in (predicted, error):
        vectors = {header_ns(m): m.vector for m in messages}
        assert vectors.keys() == ticks.keys()
        for tick, v in vectors.items():
            ticks[tick] += (v.x, v.y, v.z)
    return ticks
