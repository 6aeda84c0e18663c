# SPDX-License-Identifier: Apache-2.0
"""Messages without a time: they count from their arrival, whichever clock the Imu runs on."""

import math

import pytest

from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.samples import AIRSPEED, ARMED, Drop
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.messages.feed import Arrivals

STEP_NS = 10_000_000
NODE_NS = 1_700_000_000 * 10**9
BOOT_NS = 300 * 10**9
CLOCKS = pytest.mark.parametrize("imu_ns", [NODE_NS, BOOT_NS, NODE_NS + BOOT_NS])


class Flight:
    """An identifier, an Imu on a clock of its own, and words on the node's clock."""

    def __init__(self, imu_ns: int) -> None:
        settings = Settings.from_values({"armed.type": "std_msgs/msg/Bool"})
        self.identifier = OnlineIdentifier(settings)
        self.offs: list[float] = []
        self.words = Arrivals(self.identifier, self.identifier.add_armed, self.offs.append)
        self.airspeeds = Arrivals(self.identifier, self.identifier.add_airspeed)
        self._imu_ns = imu_ns
        self.elapsed_ns = 0

    def on_offset(self, armed: bool) -> Drop | None:
        return self.words.add(None, NODE_NS + self.elapsed_ns, armed)

    def fly(self, seconds: float) -> str:
        """Let the Imu go on; return why nothing was learned at last."""
        reason = ""
        for _ in range(round(seconds * 1e9) // STEP_NS):
            self.elapsed_ns += STEP_NS
            rate = 0.2 * math.sin(5e-9 * self.elapsed_ns)
            stamp_ns = self._imu_ns + self.elapsed_ns
            self.identifier.add_actuators(stamp_ns, (rate, 0.0, 0.0, 0.5))
            self.identifier.add_rates(stamp_ns, (rate, 0.0, 0.0))
            self.words.settle()
            for estimate in self.identifier.advance():
                reason = estimate.reason
        return reason


@CLOCKS
def test_of_several_messages_between_two_samples_the_last_counts(imu_ns: int) -> None:
    flight = Flight(imu_ns)
    flight.fly(1.0)
    for armed in (False, True, True, False):
        flight.on_offset(armed)
        flight.elapsed_ns += 1000
    assert "not armed" in flight.fly(0.3)
    assert not +flight.identifier.intake.drops[ARMED]


@CLOCKS
def test_a_message_from_before_the_imu_counts(imu_ns: int) -> None:
    flight = Flight(imu_ns)
    flight.on_offset(True)
    flight.elapsed_ns += STEP_NS
    flight.on_offset(False)
    assert "not armed" in flight.fly(0.5)


def test_bad_values_are_counted_once() -> None:
    flight = Flight(BOOT_NS)
    assert flight.airspeeds.add(None, NODE_NS, math.nan) is Drop.NOT_FINITE
    flight.fly(0.5)
    assert flight.airspeeds.add(None, NODE_NS + STEP_NS, 20.0) is None
    assert +flight.identifier.intake.drops[AIRSPEED] == {Drop.NOT_FINITE: 1}
