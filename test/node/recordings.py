# SPDX-License-Identifier: Apache-2.0
"""What the node tests play: the committed bags, and what replay makes of the same messages."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from uav_ident_ros.bags import Bag, Message
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.messages import import_type
from uav_ident_ros.parameter_file import load_parameters

BAGS = Path(__file__).parents[2] / "bags"
RATES_TOPIC, ACTUATORS_TOPIC = "/imu/data", "/actuators"


@dataclass(frozen=True)
class Recording:
    """The first part of a bag."""

    name: str
    messages: list[Message]
    types: dict[str, str]
    parameter_file: Path

    @property
    def settings(self) -> Settings:
        return Settings.from_values(load_parameters(self.parameter_file, "identifier"))

    @property
    def classes(self) -> dict[str, type]:
        return {topic: import_type(name) for topic, name in self.types.items()}

    @property
    def start_ns(self) -> int:
        return self.messages[0].log_ns


def recording(name: str, seconds: float) -> Recording:
    """Load the first seconds of a committed bag."""
    folder = BAGS / name
    if not folder.exists():
        pytest.skip(f"the example bag '{name}' is not here")
    topics = (RATES_TOPIC, ACTUATORS_TOPIC)
    with Bag(folder) as bag:
        types = {topic: bag.type_of(topic) for topic in topics}
        end_ns = bag.start_ns + int(seconds * 1e9)
        messages = []
        for message in bag.messages(topics):
            if message.log_ns > end_ns:
                break
            messages.append(message)
    return Recording(name, messages, types, folder / "identifier.yaml")
