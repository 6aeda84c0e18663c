# SPDX-License-Identifier: Apache-2.0
"""Hostile inputs of every kind to the node: ``python benchmarks/faults.py``.

The node learns a recorded flight, then receives all the disturbances of `Campaign`, once on the
system's time and once on simulated time. It must stay up, and never publish a value that is not
finite or out of bounds. Afterwards it learns the same flight again, without a reset, and its
predictions must be as good as before.
"""

import itertools
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import bench
import hostile
import numpy as np
from bench import ACTUATORS_TOPIC, AIRSPEED_TOPIC, MULTISINE, RATES_TOPIC
from geometry_msgs.msg import TwistStamped
from hostile import SECOND_NS, Hostile, stamped
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger

from uav_ident_ros.bags.reading import Bag
from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification.prediction import PredictionFit
from uav_ident_ros.identification.settings import LARGEST_NUMBER, declarations
from uav_ident_ros.messages.types import import_type
from uav_ident_ros.node.parameters import PARAMETER_TYPES
from uav_ident_ros.offline.run import OfflineRun, run_over
from uav_ident_ros.offline.ticks import Ticks
from uav_ident_ros.player import NodeOutputs, Player, PlayerError
from uav_ident_ros.process import NodeProcess, own_domain

ARMED_TOPIC = "/armed"
TYPES = {
    RATES_TOPIC: "sensor_msgs/msg/Imu",
    ACTUATORS_TOPIC: "sensor_msgs/msg/JointState",
    AIRSPEED_TOPIC: "geometry_msgs/msg/TwistStamped",
    ARMED_TOPIC: "std_msgs/msg/Bool",
}
STREAMS = {
    RATES_TOPIC: "rates",
    ACTUATORS_TOPIC: "actuators",
    AIRSPEED_TOPIC: "airspeed",
    ARMED_TOPIC: "armed",
}

LEARNING_TIME = 60.0
"""Length of the flight before and after the disturbances, s."""

PIECE_TIME = 2.0
"""Length of the flight between two silences or jumps, s."""

BURST = {False: 100, True: 2}
"""Messages on one topic between two waits for the node, by whether its time is simulated: few
enough to lose none. With simulated time the executor answers before it has read all of them."""

FLOOD_RATE = 5000.0
FLOOD_TIME = 3.0
SILENCE = 2.5
"""Time without a message, s, above the node's timeout of a topic."""

CALLS_SHARE = 0.002
"""Share of the Imu messages that are followed by a call."""

LIMITS = {"lower": "[-0.5, -0.5, -0.5, -0.1]", "upper": "[0.5, 0.5, 0.5, 1.1]"}
"""Limits of the channels, rad and throttle. Without them a command of 99.9 rad is valid, and weighs
more than an hour of flight."""

LARGEST_LOSS = 2.0
"""Largest loss of fit afterwards, points."""

BOUNDS = {
    "fit/": (-1000.0, 100.0),
    "verdict/": (0.0, 1.0),
    "": (-LARGEST_NUMBER, LARGEST_NUMBER),
}
LARGEST_RATE = 200.0
"""Bounds of the outputs: entries by the prefix of their names; rates, rad/s."""


def out_of_bounds(outputs: NodeOutputs) -> Iterator[str]:
    """Yield the published values that are not finite or out of bounds."""
    for named in outputs.named:
        good = np.isfinite(named.effort).all()
        for name, value in zip(named.name, named.position, strict=True):
            low, high = next(b for begin, b in BOUNDS.items() if name.startswith(begin))
            good = good and low <= value <= high
        if not good:
            yield f"published {named}"
    for dense in outputs.coefficients:
        if not (np.abs(dense.data) <= LARGEST_NUMBER).all():
            yield f"published {dense}"
    for vector in (*outputs.predicted_rates, *outputs.prediction_error):
        v = vector.vector
        if not (np.abs([v.x, v.y, v.z]) <= LARGEST_RATE).all():
            yield f"published {v}"


class Campaign:
    """One node, all the disturbances, and their results."""

    def __init__(
        self,
        seed: int,  # Seed of everything
        count: int,  # Hostile messages for every input
        sim_time: bool,  # Whether the node runs on simulated time
        folder: Path,  # Folder for its log and its state file
    ) -> None:
        # Messages sent on each topic, the hostile ones among them, and calls of each service
        self.sent: Counter[str] = Counter()
        self.hostile: Counter[str] = Counter()
        self.calls: Counter[str] = Counter()
        # 1-second fit, on the last 40 % of the flight, of the coefficients learned before and after
        self.before: PredictionFit | None = None
        self.after: PredictionFit | None = None
        self.ticks, self.memory = 0, (0.0, 0.0)
        self.status: dict[str, str] = {}  # Last diagnostics
        self.problems: list[str] = []  # Violations of the requirements
        self.chance = random.Random(seed)
        self._count = count
        self._sim_time = sim_time
        self._process = self._start(folder)
        # armed has no stamp and holds from its arrival; only /clock aligns it with the others.
        self.topics = [topic for topic in TYPES if sim_time or topic != ARMED_TOPIC]
        self._types = {topic: import_type(TYPES[topic]) for topic in self.topics}
        self.player = Player(self._types, clock=sim_time)
        self._node, self._learned = self.player.node, np.zeros(0)
        self._barrier = self._node.create_client(GetParameters, "/identifier/get_parameters")
        self._question = GetParameters.Request(names=["update_rate"])
        self._may_reset = True
        self._unheard: Counter[str] = Counter()
        self.now_ns = 0
        self._flight = self._load_flight()
        self._hostile = {t: Hostile(kind, self.chance) for t, kind in self._types.items()}

    def _start(self, folder: Path) -> NodeProcess:
        values = {
            "airspeed.type": TYPES[AIRSPEED_TOPIC],
            "armed.type": TYPES[ARMED_TOPIC] if self._sim_time else '""',
            "state_file": folder / "state.yaml",
            "save_period": 1.0,
            "actuators.lower_limit": LIMITS["lower"],
            "actuators.upper_limit": LIMITS["upper"],
            "use_sim_time": self._sim_time,
        }
        log = folder / "node.log"
        return NodeProcess("uav_ident_ros.node", log, values, file=MULTISINE / "identifier.yaml")

    def _load_flight(self) -> list[tuple[int, str, bytes]]:
        """Return good messages: those of the bag, an airspeed at 10 Hz, armed twice."""
        with Bag(MULTISINE) as bag:
            found = [
                (m.log_ns, m.topic, m.data) for m in bag.messages((RATES_TOPIC, ACTUATORS_TOPIC))
            ]
            start, end = bag.start_ns, bag.start_ns + int(LEARNING_TIME * 1e9)
        twist = TwistStamped()
        twist.twist.linear.x = 20.0
        airspeed, armed = serialize_message(twist), serialize_message(Bool(data=True))
        found += [(t, AIRSPEED_TOPIC, airspeed) for t in range(start, end, SECOND_NS // 10)]
        if self._sim_time:
            found += [(t, ARMED_TOPIC, armed) for t in range(start, end, SECOND_NS // 2)]
        return sorted((f for f in found if f[0] < end), key=lambda f: f[0])

    # -- messages and calls ----------------------------------------------------------------

    def send(self, topic: str, data: bytes, hostile: bool = False) -> None:
        """Send one message; wait for the node after each `BURST`, to lose none."""
        self._publish(topic, data, hostile)
        self._unheard[topic] += 1
        if self._unheard[topic] >= BURST[self._sim_time]:
            self.wait()

    def _publish(self, topic: str, data: bytes, hostile: bool) -> None:
        try:
            self.player.send(topic, data)
        except RuntimeError:  # longer than the type allows
            return
        self.sent[topic] += 1
        self.hostile[topic] += hostile

    def wait(self) -> None:
        """Wait until the node has processed the messages."""
        self._unheard.clear()
        if self._process.poll() is not None:
            raise RuntimeError(f"the node has ended with status {self._process.returncode}")
        if self._answer(self._barrier, self._question, 10.0) is None:
            self.problems.append("the node did not answer for 10 s")

    def _answer(self, client: Any, request: Any, timeout: float = 5.0) -> Any:
        """Call a service and return the response; None on a timeout."""
        future = client.call_async(request)
        if not self.player.spin_for(timeout, future.done):
            client.remove_pending_request(future)
            return None
        return future.result()

    def listen(self, seconds: float) -> None:
        """Receive the node's outputs for a time, and check their bounds."""
        self.player.spin_for(seconds)
        outputs = self.player.outputs
        self.problems += itertools.islice(out_of_bounds(outputs), 20)
        self.ticks += len(outputs.named)
        if outputs.coefficients:
            self._learned = np.array(outputs.coefficients[-1].data)
        for status in outputs.status:
            self.status = {entry.key: entry.value for entry in status.values}
        outputs.clear()

    # -- the flight ------------------------------------------------------------------------

    def fly(
        self,
        seconds: float = LEARNING_TIME,  # Length of the part
        between: Callable[[], None] | None = None,  # Called after every Imu message
        without: str = "",  # Topic that is left out
    ) -> None:
        """Play the beginning of the flight, with stamps that continue the last one."""
        start = self._flight[0][0]
        shift_ns = self.now_ns + SECOND_NS // 20 - start if self.now_ns else 0
        clock_ns = 0
        for t_ns, topic, data in self._flight:
            if t_ns - start > seconds * SECOND_NS:
                break
            if topic == without:
                continue
            self.now_ns = t_ns + shift_ns
            if self.now_ns - clock_ns >= SECOND_NS // 100:
                clock_ns = self.now_ns
                self.player.clock.send(clock_ns)
            self.send(topic, data if topic == ARMED_TOPIC else stamped(data, self.now_ns))
            if between is not None and topic == RATES_TOPIC:
                between()
        for _ in range(10):
            self.now_ns += SECOND_NS // 100
            self.player.clock.send(self.now_ns)
            self.listen(0.02)
        self.wait()

    @cached_property
    def _replayed(self) -> OfflineRun:
        """Return the replay of the flight, for the windows and inputs of the score."""
        return run_over(MULTISINE, load_parameters(MULTISINE / "identifier.yaml", "identifier"))

    def learned(self) -> PredictionFit:
        """Return the fit of the node's last coefficients on the end of the flight."""
        self.listen(0.5)
        run = self._replayed
        learned = self._learned.reshape(run.structure.mask.shape)
        run.estimates = Ticks(
            run.structure, [replace(e, coefficients=learned) for e in run.estimates]
        )
        return run.score()["last_40_percent"]

    # -- disturbances ----------------------------------------------------------------------

    def mixed_with_flight(self) -> None:
        """Send hostile messages between the good ones of a flight, on every topic."""
        imu = sum(topic == RATES_TOPIC for _, topic, _ in self._flight)
        share = self._count / imu
        due = 0.0

        def between() -> None:
            nonlocal due
            due += share
            while due >= 1.0:
                due -= 1.0
                for topic in self.topics:
                    self._send_hostile(topic)
            self._call_now_and_then()

        self.fly(between=between)

    def _send_hostile(self, topic: str) -> None:
        """Send a hostile message; draw another one if it is too long."""
        before = self.hostile[topic]
        while self.hostile[topic] == before:
            self.send(topic, self._hostile[topic].message(self.now_ns), hostile=True)

    def _call_now_and_then(self) -> None:
        if self.chance.random() < CALLS_SHARE:
            self.call_something()

    def floods(self) -> None:
        """Send good and hostile messages at 5 kHz, on each topic in turn."""
        good = {topic: data for _, topic, data in self._flight}
        for topic in self.topics:
            for bad in (False, True):
                start = time.monotonic()
                for number in range(int(FLOOD_TIME * FLOOD_RATE)):
                    self.now_ns += int(1e9 / FLOOD_RATE)
                    data = good[topic]
                    if bad:
                        data = self._hostile[topic].message(self.now_ns)
                    elif topic != ARMED_TOPIC:
                        data = stamped(data, self.now_ns)
                    self._publish(topic, data, bad)
                    ahead = start + number / FLOOD_RATE - time.monotonic()
                    if ahead > 0.0:
                        time.sleep(ahead)
                for _ in range(5):
                    self.wait()

    def silences(self) -> None:
        """Interrupt each topic in turn, then remove and restore its publisher."""
        for topic in self.topics:
            self.fly(PIECE_TIME)
            self.listen(SILENCE)
            self.call_something()
            publishers = self.player._publishers
            self._node.destroy_publisher(publishers.pop(topic))
            self.fly(1.0, without=topic)
            publishers[topic] = self._node.create_publisher(self._types[topic], topic, 1000)
            self.player.wait_for_node()
        self.fly(PIECE_TIME)

    def jumps(self) -> None:
        """Make large jumps of the message time, and of /clock, in both directions."""
        start = self.now_ns
        for seconds in (5.0, -3.0, 3600.0, -3600.0, 86400.0 * 400, -86400.0 * 400, 1.5, -1.5):
            self.now_ns = max(SECOND_NS, self.now_ns + int(seconds * 1e9))
            self.fly(PIECE_TIME)
            self.call_something()
        for clock_ns in (0, 1, 2**31 * SECOND_NS - 1, self.now_ns, self.now_ns - SECOND_NS):
            self.player.clock.send(clock_ns)
            self.listen(0.1)
        self.now_ns = max(self.now_ns, start)
        self.fly(PIECE_TIME)

    def call_something(self) -> None:
        """Call one of the services, or set random parameters."""

        def parameters() -> dict[str, Any]:
            count = self.chance.randrange(1, 6)
            return {"parameters": [hostile.parameter(self.chance) for _ in range(count)]}

        names = [s.name for s in declarations()] + ["", "no/such", "x" * 300]
        calls: list[tuple[str, Any, Callable[[], dict[str, Any]]]] = [
            ("save", Trigger, dict),
            ("adapt", SetBool, lambda: {"data": self.chance.random() < 0.5}),
            ("set_parameters", SetParameters, parameters),
            ("set_parameters", SetParameters, parameters),
            ("set_parameters_atomically", SetParametersAtomically, parameters),
            ("describe_parameters", DescribeParameters,
             lambda: {"names": self.chance.sample(names, 5)}),
            ("reset", Trigger, dict),
        ]  # fmt: skip
        service, kind, fields = self.chance.choice(calls if self._may_reset else calls[:-1])
        self.calls[service] += 1
        if self._once(kind, service, **fields()) is None:
            self.problems.append(f"no answer to '{service}'")

    def _once(self, kind: Any, service: str, **fields: Any) -> Any:
        client = self._node.create_client(kind, f"/identifier/{service}")
        client.wait_for_service(timeout_sec=2.0)
        answer = self._answer(client, kind.Request(**fields))
        self._node.destroy_client(client)
        return answer

    def parameter_storm(self) -> None:
        """Call services and set parameters continually in flight."""
        for _ in range(max(20, self._count // 500)):
            self.call_something()

    def calm_down(self) -> None:
        """Restore all parameters and switch learning on, without a reset."""
        own = load_parameters(MULTISINE / "identifier.yaml", "identifier")
        # with the type, which an empty array does not define
        parameters = [
            Parameter(s.name, PARAMETER_TYPES[s.type], own.get(s.name, s.default))
            for s in declarations()
            if not s.read_only
        ]
        answer = self._once(
            SetParametersAtomically,
            "set_parameters_atomically",
            parameters=[parameter.to_parameter_msg() for parameter in parameters],
        )
        if answer is None or not answer.result.successful:
            self.problems.append(f"the parameters could not be set back: {answer}")
        self._once(SetBool, "adapt", data=True)

    # -- all of it -------------------------------------------------------------------------

    def run(self) -> None:
        """Run the campaign."""
        try:
            self.player.wait_for_node()
            begin = self.resident_mb()
            for phase in self._phases():
                phase()
            self.listen(2.5)
            self.memory = (begin, self.resident_mb())
            self._judge()
        except (RuntimeError, PlayerError) as error:
            self.problems.append(str(error))
        finally:
            self.end()

    def _phases(self) -> Iterator[Callable[[], None]]:
        yield self.parameter_storm  # before the first message
        yield partial(self.fly, 5.0, self._call_now_and_then)
        yield self.calm_down
        # No reset from here on: the node must recover without one.
        self._may_reset = False
        yield self.fly
        self.before = self.learned()
        yield self.mixed_with_flight
        yield self.floods
        yield self.silences
        yield self.jumps
        yield self.parameter_storm
        yield self.calm_down
        yield self.fly
        self.after = self.learned()

    def _judge(self) -> None:
        status = self.status
        assert self.before is not None
        assert self.after is not None
        if (self.after.model < self.before.model - LARGEST_LOSS).any():
            self.problems.append(
                f"the fit was {self.before.model.round(1)} %, and is "
                f"{self.after.model.round(1)} % now"
            )
        if status.get("internal errors") != "0":
            self.problems.append(f"internal errors: {status.get('internal errors')}")
        for stream in (STREAMS[topic] for topic in self.topics):
            if not int(status.get(f"{stream}: dropped", 0)):
                self.problems.append(f"nothing was dropped of the {stream}")

    def resident_mb(self) -> float:
        """Return the resident memory of the node, MB."""
        return bench.resident_mb(self._process.pid)

    def end(self) -> None:
        """End the node, check its exit status, and leave the graph."""
        status, log = self._process.end(signal.SIGTERM), self._process.log
        if status != 0 or "Traceback" in log:
            tail = "\n".join(log.splitlines()[-30:])
            self.problems.append(f"it ended with status {status}:\n{tail}")
        self.player.close()


def report(campaign: Campaign) -> Iterator[str]:
    """Yield the lines of a campaign's result."""
    status = campaign.status
    for topic, stream in STREAMS.items():
        if not campaign.sent[topic]:
            continue
        drops = {
            key.removeprefix(f"{stream}: dropped: "): value
            for key, value in status.items()
            if key.startswith(f"{stream}: dropped: ")
        }
        yield (
            f"{topic}: {campaign.sent[topic]} sent, {campaign.hostile[topic]} of them hostile; "
            f"{status.get(f'{stream}: messages')} arrived, "
            f"{status.get(f'{stream}: dropped')} dropped"
        )
        yield "    " + ", ".join(f"{reason}: {count}" for reason, count in drops.items())
    yield f"calls: {dict(campaign.calls)}; ticks published: {campaign.ticks}"
    yield "memory: {:.0f} -> {:.0f} MB".format(*campaign.memory)
    if campaign.before is not None and campaign.after is not None:
        before, after = campaign.before.model.round(1), campaign.after.model.round(1)
        yield f"1-second fit of p, q, r: {before} % before, {after} % after"
    yield from campaign.problems or ["no problem"]


def main() -> int:
    """Run the campaign and print its result; return the exit status, 1 if there is a problem."""
    options = bench.parser(__doc__, messages=100_000, seed=1).parse_args()
    failed = False
    for sim_time in (False, True):
        begin = time.monotonic()
        with own_domain(), tempfile.TemporaryDirectory() as folder:
            os.environ["ROS_LOG_DIR"] = folder
            campaign = Campaign(options.seed, options.messages, sim_time, Path(folder))
            campaign.run()
        clock = "simulated time" if sim_time else "system time"
        print(f"--- {clock}, seed {options.seed}, {time.monotonic() - begin:.0f} s")
        print(*report(campaign), sep="\n", flush=True)
        failed = failed or bool(campaign.problems)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
