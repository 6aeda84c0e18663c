# SPDX-License-Identifier: Apache-2.0
"""Messages without a time: they count from their arrival, whichever clock the Imu runs on."""

import math
import struct
from types import SimpleNamespace

import pytest

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.samples import ARMED
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.messages.feed import Feed
from uav_ident_ros.messages.streams import STREAMS

STEP_NS = 10_000_000
NODE_NS = 1_700_000_000 * 10**9
BOOT_NS = 300 * 10**9
CLOCKS = pytest.mark.parametrize("imu_ns", [NODE_NS, BOOT_NS, NODE_NS + BOOT_NS])
TYPES = {"armed.type": "std_msgs/msg/Bool", "airspeed.type": "std_msgs/msg/Float64"}


class Flight:
    """An identifier, an Imu on a clock of its own, and words on the node's clock."""

    def __init__(self, imu_ns: int, *said: str) -> None:
        types = {name: kind for name, kind in TYPES.items() if name.partition(".")[0] in said}
        self.identifier = OnlineIdentifier(Settings.from_values(types))
        self.offs: list[float] = []
        self._feeds = {
            stream.name: Feed(
                stream,
                self.identifier,
                lambda data: SimpleNamespace(data=struct.unpack("d", data)[0]),
                on_offset=self.offs.append,
            )
            for stream in STREAMS
            if stream.name in said
        }
        self._imu_ns = imu_ns
        self.elapsed_ns = 0

    def say(self, stream: str, value: float) -> None:
        self._feeds[stream].take(struct.pack("d", value), NODE_NS + self.elapsed_ns)

    def fly(self, seconds: float) -> str:
        """Let the Imu go on; return why nothing was learned at last."""
        reason = ""
        for _ in range(round(seconds * 1e9) // STEP_NS):
            self.elapsed_ns += STEP_NS
            rate = 0.2 * math.sin(5e-9 * self.elapsed_ns)
            stamp_ns = self._imu_ns + self.elapsed_ns
            self.identifier.add_actuators(stamp_ns, (rate, 0.0, 0.0, 0.5))
            self.identifier.add_rates(stamp_ns, (rate, 0.0, 0.0))
            for feed in self._feeds.values():
                feed.settle()
            for estimate in self.identifier.advance():
                reason = estimate.reason
        return reason


@CLOCKS
def test_of_several_messages_between_two_samples_the_last_counts(imu_ns: int) -> None:
    flight = Flight(imu_ns, ARMED)
    flight.fly(1.0)
    for armed in (False, True, True, False):
        flight.say(ARMED, armed)
        flight.elapsed_ns += 1000
    assert "not armed" in flight.fly(0.3)
    assert not +flight.identifier.intake.drops[ARMED]
    assert len(flight.offs) == (imu_ns != NODE_NS), "it is told once"


@CLOCKS
def test_a_message_from_before_the_imu_counts(imu_ns: int) -> None:
    flight = Flight(imu_ns, ARMED)
    flight.say(ARMED, True)
    flight.elapsed_ns += STEP_NS
    flight.say(ARMED, False)
    assert "not armed" in flight.fly(0.5)
