# SPDX-License-Identifier: Apache-2.0
"""Cost of the running node: ``python benchmarks/node_cost.py``.

The node is a process of its own. A second process publishes a flight of `flights.yaml` to it in
real time (stamped actuators at 50 Hz), and this one subscribes to its outputs. The age of a tick
includes its wait for inputs, up to `input_wait`, and for the timer, up to a fifth of its period.
``--hour`` plays an hour of flight at the node's speed instead, and prints its memory.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import closing
from multiprocessing.queues import Queue
from pathlib import Path

import bench
import flights
import numpy as np
from hostile import stamped
from sensor_msgs.msg import Imu, JointState

from uav_ident_ros.bags.writing import jazzy_types
from uav_ident_ros.guest import Guest
from uav_ident_ros.identification.samples import ACTUATORS, RATES_STREAM
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.messages.types import header_ns
from uav_ident_ros.player import Player
from uav_ident_ros.process import NodeProcess, own_domain
from uav_ident_ros.simulation.recording import as_message

FLIGHT = "exact_noise_002"
ACTUATOR_EVERY = 2
"""Decimation of the flight's actuator samples: 50 Hz remain."""

WARM_UP = 5.0
"""Time before the measurement, s, for discovery and the start of the estimator."""

DISCOVERY = 2.0
SETTLE = 2.5
"""Time for the last diagnostics to arrive, s."""

MARGIN = 2.0

TICKS_PER_SECOND = os.sysconf("SC_CLK_TCK")


# --- the publisher ----------------------------------------------------------------------------


def serialized(imu_rate: float, seconds: float) -> Iterator[tuple[int, str, bytes]]:
    """Yield the unstamped messages of the flight in order, with the time since its start, ns."""
    flight = flights.load(FLIGHT, rate=imu_rate)
    start = int(flight.imu_t_ns[0])
    flown, every = list(flight.messages()), {RATES_STREAM: 1, ACTUATORS: ACTUATOR_EVERY}
    found = []
    for stream, step in every.items():
        for sample in [one for one in flown if one.stream == stream][::step]:
            message = as_message(sample, flight)
            data = jazzy_types().serialize_cdr(message, message.__msgtype__)
            found.append((sample.t_ns - start, stream, bytes(data)))
    found.sort(key=lambda item: item[0])
    return (item for item in found if 0 <= item[0] <= seconds * 1e9)


def publish(imu_rate: float, seconds: float, ready: object, sent: Queue[dict[str, int]]) -> None:
    """Publish the flight in real time, with stamps of the system's time."""
    messages = list(serialized(imu_rate, seconds))
    guest = Guest("flight")
    publishers = {
        RATES_STREAM: guest.node.create_publisher(Imu, "imu/data", 1000),
        ACTUATORS: guest.node.create_publisher(JointState, "actuators", 1000),
    }
    while not all(p.get_subscription_count() for p in publishers.values()):
        time.sleep(0.05)
    time.sleep(DISCOVERY)
    ready.set()  # type: ignore[attr-defined]
    counts = dict.fromkeys(publishers, 0)
    start = time.time_ns()
    for t, topic, data in messages:
        due = start + t
        ahead = (due - time.time_ns()) * 1e-9
        if ahead > 0.0:
            time.sleep(ahead)
        publishers[topic].publish(stamped(data, due))
        counts[topic] += 1
    sent.put(counts)
    guest.close()


# --- the measurement --------------------------------------------------------------------------


def cpu_seconds(pid: int) -> float:
    """Return the processor time of a process up to now, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_SECOND


def measure(imu_rate: float, seconds: float) -> tuple[str, ...]:
    """Run node and publisher and measure for `seconds`; return the row of the table."""
    spawn = multiprocessing.get_context("spawn")
    ready, sent = spawn.Event(), spawn.Queue()
    span = WARM_UP + seconds + MARGIN
    publisher = spawn.Process(target=publish, args=(imu_rate, span, ready, sent), daemon=True)
    values = {
        "actuators.type": "sensor_msgs/msg/JointState",
        "actuators.channels": "[elevator, rudder, aileron, throttle]",
        "actuators.trim": "[0.0, 0.0, 0.0, 0.5]",
    }
    log = Path(os.environ["ROS_HOME"]) / "node.log"
    ages: list[int] = []

    def take(message: JointState) -> None:
        ages.append(time.time_ns() - header_ns(message))

    with (
        NodeProcess("uav_ident_ros.node", log, values) as node,
        closing(Player({}, clock=False)) as player,
    ):
        player.wait_for_node()
        topic = "/identifier/coefficients_named"
        player.node.create_subscription(JointState, topic, take, 1000)
        publisher.start()
        player.wait_until(ready.is_set, "the publisher", timeout=120.0)
        player.spin_for(WARM_UP)
        ages.clear()
        begin, cpu, memory = time.monotonic(), cpu_seconds(node.pid), bench.resident_mb(node.pid)
        player.spin_for(seconds)
        if node.poll() is not None:
            raise RuntimeError(f"the node has ended with status {node.returncode}")
        cpu = (cpu_seconds(node.pid) - cpu) / (time.monotonic() - begin)
        memories, age_ms = (memory, bench.resident_mb(node.pid)), np.array(ages) * 1e-6
        player.wait_until(lambda: not sent.empty(), "the publisher to end", timeout=60.0)
        counts = sent.get()
        player.spin_for(SETTLE)
        status = {entry.key: entry.value for entry in player.outputs.status[-1].values}
    return f"{imu_rate:g}", f"{100.0 * cpu:.1f}", *_cells(status, counts, age_ms, *memories)


def _cells(
    status: Mapping[str, str],  # Newest /diagnostics of the node
    counts: Mapping[str, int],  # Messages sent, by stream
    age_ms: FloatArray,  # Age of each estimate when received, ms
    # memory, memory_end: Resident memory of the node before and after, MiB
    memory: float,
    memory_end: float,
) -> tuple[str, ...]:
    """Return the cells of losses, times and memory."""
    update = [status.get(f"ticks: update time {p} [ms]", "-") for p in ("p50", "p99", "max")]
    published = [status.get(f"ticks: age when published {p} [ms]", "-") for p in ("p50", "p99")]
    age = np.percentile(age_ms, (50, 99)) if len(age_ms) else (np.nan, np.nan)
    lost = {stream: sends - int(status[f"{stream}: messages"]) for stream, sends in counts.items()}
    return (
        f"{lost[RATES_STREAM]} / {counts[RATES_STREAM]}",
        f"{lost[ACTUATORS]}",
        " / ".join(update),
        " / ".join(published),
        f"{age[0]:.1f} / {age[1]:.1f}",
        status.get("ticks: timer jitter p99 [ms]", "-"),
        f"{memory:.0f} -> {memory_end:.0f}",
    )


def memory_over_an_hour(folder: Path) -> Iterator[tuple[int, float]]:
    """Play an hour of flight; yield minutes flown and resident memory, MB."""
    from faults import Campaign

    flight = Campaign(seed=1, count=0, sim_time=False, folder=folder)
    try:
        flight.player.wait_for_node()
        yield 0, flight.resident_mb()
        for minute in range(1, 61):
            flight.fly()
            if minute in (1, 2, 5) or minute % 10 == 0:
                yield minute, flight.resident_mb()
    finally:
        flight.end()


COLUMNS = (
    "Imu [Hz]", "CPU [% of a core]", "lost Imu / sent", "lost act.", "update p50/p99/max [ms]",
    "published p50/p99 [ms]", "received p50/p99 [ms]", "timer jitter p99 [ms]", "memory [MB]",
)  # fmt: skip


def main() -> None:
    """Measure and print."""
    parser = bench.parser(__doc__, seconds=60.0)
    parser.add_argument("--rates", type=float, nargs="+", default=[200.0, 500.0, 1000.0])
    parser.add_argument("--hour", action="store_true", help="memory over an hour of flight")
    options = parser.parse_args()
    with own_domain(), tempfile.TemporaryDirectory() as logs:
        os.environ["ROS_LOG_DIR"] = os.environ["ROS_HOME"] = logs
        if options.hour:
            for minute, memory in memory_over_an_hour(Path(logs)):
                print(f"{minute:3d} min of flight: {memory:.1f} MB", flush=True)
            return
        print(f"flight {FLIGHT}, {options.seconds:g} s per rate, actuators at 50 Hz")
        print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start")
        rows = (measure(rate, options.seconds) for rate in options.rates)
        for line in bench.table(COLUMNS, rows):
            print(line, flush=True)


if __name__ == "__main__":
    main()
