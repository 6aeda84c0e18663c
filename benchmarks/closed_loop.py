# SPDX-License-Identifier: Apache-2.0
"""The identified model in a control loop, measured: ``python benchmarks/closed_loop.py NAME``.

cold       no initial coefficients: what normal flight alone identifies; JSBSim's c172p, every
           node a process, in step
restart    the identifier killed (-9) in flight and started again
latency    from the stamp of an Imu sample to the command and to the coefficients, real time

Tables go to the terminal, figures to build/closed_loop/. Faults: ``fault_campaign.py``.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import uav_ident_ros  # noqa: F401  (first: it limits the threads of NumPy)
from uav_ident_ros.domain import own_domain
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.closed_loop import ClosedLoop, Loop, tracking_error

ROOT = Path(__file__).resolve().parents[1]
BUILD = ROOT / "build" / "closed_loop"

DURATION = 100.0

FLIGHT_TIMEOUT = 600.0
ATTEMPTS = 3

Record = dict[str, FloatArray]


def fly(loop: Loop, during: Callable[[ClosedLoop], None] | None = None) -> tuple[Record, str]:
    """Fly once in a domain of its own; return the record and what the controller said.

    A flight in which somebody fell silent, on a machine too busy or in a domain that another
    program uses too, is flown again.
    """
    for _ in range(ATTEMPTS):
        with (
            tempfile.TemporaryDirectory() as folder,
            own_domain(),
            ClosedLoop(loop, Path(folder)) as running,
        ):
            if during is not None:
                during(running)
            record = running.wait(FLIGHT_TIMEOUT)
            said = running.log("simulated_plant")
            if during is not None or "going on" not in said:
                return record, running.log("controller")
        print(f"again, because of:\n{said}", file=sys.stderr)
    raise SystemExit(f"no undisturbed flight in {ATTEMPTS} attempts")


# --- cold ------------------------------------------------------------------------------------


def cold(_: int) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for start in ("cold", "with initial coefficients"):
        record, said = fly(Loop(DURATION, cold=start == "cold"))
        names = [str(name) for name in record["names"]]
        last = {
            name: [float(record[key][-1, i]) for key in ("values", "sigma")]
            for i, name in enumerate(names)
        }
        out[start] = {
            "coefficients": last,
            "fit": record["fit"][-1].tolist(),
            "usable, % of ticks": 100.0 * float(np.mean(record["usable"])),
            "controller": said.splitlines(),
            "tracking, deg/s": tracking_error(record, 30.0, DURATION).tolist(),
        }
    return out


def cold_lines(found: dict[str, Any]) -> Iterator[str]:
    shown = ("pdot/p", "pdot/da", "qdot/q", "qdot/de", "rdot/r", "rdot/dr", "pdot/dth", "qdot/pr")
    yield "| coefficient | " + " | ".join(found) + " |"
    yield "|---" * (len(found) + 1) + "|"
    for name in shown:
        cells = ["{:.2f} ± {:.2f}".format(*run["coefficients"][name]) for run in found.values()]
        yield f"| `{name}` | " + " | ".join(cells) + " |"
    for start, run in found.items():
        p, q, r = run["fit"]
        yield (
            f"{start}: fit {p:.0f} / {q:.0f} / {r:.0f} %, usable in "
            f"{run['usable, % of ticks']:.0f} % of the ticks; "
            + "tracking {:.2f} / {:.2f} / {:.2f} deg/s".format(*run["tracking, deg/s"])
        )


# --- restart ---------------------------------------------------------------------------------

KILL_TIME, RESTART_TIME = 40.0, 60.0


def restart(seeds: int) -> dict[str, Any]:
    out: dict[str, Any] = {"tracking": [], "controller": []}
    for seed in range(seeds):
        undisturbed, _said = fly(Loop(DURATION, seed=seed))
        record, said = fly(Loop(DURATION, seed=seed), kill_and_restart)
        gap = np.diff(record["tick"]).max()
        spans = ((20.0, KILL_TIME), (KILL_TIME, RESTART_TIME), (RESTART_TIME, DURATION))
        rows = [
            [tracking_error(r, *span).tolist() for span in spans] for r in (undisturbed, record)
        ]
        out["tracking"].append(rows)
        out["controller"].append([*said.splitlines(), f"gap in the ticks: {gap:.1f} s"])
    return out


def kill_and_restart(running: ClosedLoop) -> None:
    """Kill the identifier at one time of the flight and start it at another."""
    with Clock() as clock:
        clock.wait_until(KILL_TIME)
        running.processes["identifier"].kill()
        running.processes["identifier"].wait()
        clock.wait_until(RESTART_TIME)
        running.start("identifier")


class Clock:
    """Time of the flight, from /clock."""

    def __enter__(self) -> Clock:
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from rosgraph_msgs.msg import Clock as ClockMessage

        self._context = Context()
        self._context.init(args=[])
        node = Node("flight_clock", context=self._context, use_global_arguments=False)
        node.create_subscription(ClockMessage, "/clock", self._keep, 1)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(node)
        self._first: float | None = None
        self._now = 0.0
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._context.try_shutdown()

    def _keep(self, message: Any) -> None:
        now = message.clock.sec + 1e-9 * message.clock.nanosec
        self._first = now if self._first is None else self._first
        self._now = now - self._first

    def wait_until(self, flight_time: float) -> None:
        end = time.monotonic() + FLIGHT_TIMEOUT
        while self._now < flight_time and time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.1)


def restart_lines(found: dict[str, Any]) -> Iterator[str]:
    yield "rms tracking error, deg/s (p / q / r)      undisturbed           killed and restarted"
    for rows in found["tracking"]:
        for title, plain, hit in zip(("before", "without it", "after"), *rows, strict=True):
            texts = ["{:.2f} / {:.2f} / {:.2f}".format(*row) for row in (plain, hit)]
            yield f"{title:12} {texts[0]:>40} {texts[1]:>28}"
    yield from found["controller"][0]


# --- latency ---------------------------------------------------------------------------------

STAMP = struct.Struct("<iI")
STAMP_OFFSET = 4
"""Of a serialized message that begins with a header, after the encapsulation header."""

LATENCY_TIME = 40.0
WARM_UP = 5.0
IMU_RATES = (100.0, 200.0)
WAITS = (0.05, 0.02)
"""Settings of `input_wait`, s."""


def latency(_: int) -> dict[str, Any]:
    out = {}
    for rate, wait in itertools.product(IMU_RATES, WAITS):
        loop = Loop(
            LATENCY_TIME,
            lock_step=False,
            parameters={
                "simulated_plant": {"rate": f"{rate}"},
                "identifier": {"input_wait": f"{wait}"},
            },
        )
        ages: dict[str, list[float]] = {}
        dropped: dict[str, str] = {}
        fly(loop, lambda running, ages=ages, dropped=dropped: listen(running, ages, dropped))
        found: dict[str, Any] = {
            topic: {
                "p50": float(np.percentile(values, 50)),
                "p99": float(np.percentile(values, 99)),
                "count": len(values),
            }
            for topic, values in ages.items()
        }
        out[f"{rate:g} Hz, {1e3 * wait:g} ms"] = {"ages": found, "dropped": dropped}
    return out


def listen(running: ClosedLoop, ages: dict[str, list[float]], dropped: dict[str, str]) -> None:
    """Collect the age of each message on its arrival here, ms, and what the identifier dropped."""
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node
    from sensor_msgs.msg import Imu, JointState

    context = Context()
    context.init(args=[])
    node = Node("listener", context=context, use_global_arguments=False)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    begin: list[float] = []

    def keep(topic: str) -> Callable[[bytes], None]:
        def take(data: bytes) -> None:
            seconds, nanoseconds = STAMP.unpack_from(data, STAMP_OFFSET)
            begin.append(time.monotonic()) if not begin else None
            if time.monotonic() - begin[0] > WARM_UP:
                ages.setdefault(topic, []).append(
                    (time.time_ns() - seconds * 10**9 - nanoseconds) * 1e-6
                )

        return take

    def take_diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            dropped.update({v.key: v.value for v in status.values if ": dropped" in v.key})

    node.create_subscription(DiagnosticArray, "/diagnostics", take_diagnostics, 10)
    for topic, kind in (
        ("imu/data", Imu), ("command", JointState), ("identifier/coefficients_named", JointState),
    ):  # fmt: skip
        node.create_subscription(kind, topic, keep(topic), 50, raw=True)
    while running.processes["simulated_plant"].poll() is None:
        executor.spin_once(timeout_sec=0.1)
    executor.shutdown()
    context.try_shutdown()


def latency_lines(found: dict[str, Any]) -> Iterator[str]:
    yield "| Imu, input_wait | from its stamp to | p50, ms | p99, ms | messages |"
    yield "|---|---|---|---|---|"
    for case, told in found.items():
        for topic, values in told["ages"].items():
            yield (
                f"| {case} | `{topic}` | {values['p50']:.1f} | {values['p99']:.1f} | "
                f"{values['count']} |"
            )
        yield f"| {case} | dropped | {told['dropped']} | | |"


PROGRAMS = {
    "cold": (cold, cold_lines),
    "restart": (restart, restart_lines),
    "latency": (latency, latency_lines),
}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", choices=tuple(PROGRAMS))
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args(arguments)
    os.chdir(ROOT)
    measure, lines = PROGRAMS[options.name]
    BUILD.mkdir(parents=True, exist_ok=True)
    found = measure(options.seeds)
    (BUILD / f"{options.name}.json").write_text(json.dumps(found, indent=1))
    print("\n".join(lines(found)))


if __name__ == "__main__":
    main()
