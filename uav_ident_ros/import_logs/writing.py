# SPDX-License-Identifier: Apache-2.0
"""An imported log as a bag with the standard topics."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from uav_ident_ros.bags.messages import (
    IMU,
    JOINT_STATE,
    TWIST,
    VECTOR,
    imu,
    joint_state,
    plain,
    twist_stamped,
    vector_stamped,
)
from uav_ident_ros.bags.writing import BagWriter, qos, whole
from uav_ident_ros.identification.samples import TimeArray
from uav_ident_ros.import_logs.flight_log import FlightLog, Stream
from uav_ident_ros.import_logs.stamps import inside, turned_at
from uav_ident_ros.messages.types import FRAME_IDS

ARMED_STEP_NS = 1_000_000_000
"""Time between two messages that say the same of whether it is armed, ns: the type has no stamp."""

STRING, BOOL = "std_msgs/msg/String", "std_msgs/msg/Bool"

IMU_STREAMS = ("rates", "attitude")
"""What the messages of the Imu are made of."""


Make = Callable[[int, Any], Any]
"""Makes a message from a stamp, ns, and a sample."""


def _imu(log: FlightLog) -> Make:
    frame_id, rates, attitude = FRAME_IDS[log.convention], *map(log.streams.get, IMU_STREAMS)
    assert rates is not None
    turns = [None] * len(rates.t_ns)
    if attitude is not None:
        turns = turned_at(rates.t_ns, attitude.t_ns, attitude.values).tolist()
    turned = iter(turns)

    has_force = log.has_force

    def make(t_ns: int, value: Any) -> Any:
        values = value.tolist()
        force = values[3:] if has_force else None
        return imu(t_ns, values[:3], force, frame_id, next(turned))

    return make


def _joint_state(log: FlightLog) -> Make:
    names = [channel.name for channel in log.channels]
    return lambda t_ns, value: joint_state(t_ns, names, value)


class Topic(NamedTuple):
    """A topic of an imported bag."""

    name: str
    msgtype: str
    maker: Callable[[FlightLog], Make]  # Gives what makes its messages
    depth: int = 10


TOPICS = {
    "actuators": Topic("/actuators", JOINT_STATE, _joint_state),
    "rates": Topic("/imu/data", IMU, _imu, 500),
    "airspeed": Topic(
        "/airspeed", TWIST, lambda _: lambda t_ns, v: twist_stamped(t_ns, (float(v), 0.0, 0.0))
    ),
    "setpoint": Topic(
        "/setpoint/rates",
        VECTOR,
        lambda _: lambda t_ns, pqr: vector_stamped(t_ns, pqr.tolist(), FRAME_IDS["frd"]),
    ),
    "mode": Topic("/mode", STRING, lambda _: lambda _, name: plain(STRING, str(name))),
    "armed": Topic("/armed", BOOL, lambda _: lambda _, armed: plain(BOOL, bool(armed))),
}
"""Topic of each stream; at equal times they are written in this order."""


def write_import(log: FlightLog, folder: Path, finish: Callable[[Path], None]) -> None:
    """Write the bag, and let `finish` write what is to stand beside it into its folder.

    Raises
    ------
    BagWriteError
        If it cannot be written; nothing half-written stays behind.
    """
    streams = {name: stream for name, stream in log.streams.items() if name in TOPICS}
    if log.armed is not None:
        streams["armed"] = _armed(log)
    with whole(folder) as working:
        with BagWriter(working) as bag:
            entries = []
            for name in sorted(streams, key=[*TOPICS].index):
                topic = TOPICS[name]
                bag.topic(topic.name, topic.msgtype, qos(topic.depth, reliable=name != "rates"))
                entries.append(_entries(log, streams[name], name))
            bag.merge(entries)
        finish(working)


def _entries(log: FlightLog, stream: Stream, name: str) -> Iterator[tuple[int, str, Any]]:
    """Yield log time, topic and message; log times never step back, whatever the stamps do."""
    make, topic = TOPICS[name].maker(log), TOPICS[name].name
    log_ns: TimeArray = np.maximum.accumulate(stream.t_ns)
    for recorded, t_ns, value in zip(
        log_ns.tolist(), stream.t_ns.tolist(), stream.values, strict=True
    ):
        yield recorded, topic, make(t_ns, value)


def _armed(log: FlightLog) -> Stream:
    """Return the state at every change, and once a second: the type has no stamp."""
    rates = log.streams["rates"].t_ns
    start, end = int(rates.min()), int(rates.max())
    # Seconds in which there are rates: a damaged stamp may lie years ahead.
    seconds = start + ARMED_STEP_NS * np.unique((rates - start) // ARMED_STEP_NS)
    changes = np.array([t for stretch in log.armed or [] for t in stretch], dtype=np.int64)
    t_ns = np.union1d(seconds, changes[(start <= changes) & (changes < end)])
    until = [(first, last - 1) for first, last in log.armed or []]
    return Stream("armed", t_ns[t_ns < end], inside(t_ns[t_ns < end], until))
