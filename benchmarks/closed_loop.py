# SPDX-License-Identifier: Apache-2.0
"""The identified model in a control loop, measured: ``python benchmarks/closed_loop.py NAME``.

tracking   a rate reference followed with identified and with fixed coefficients, healthy and
           after a fault; JSBSim's c172p, every node a process, in step
cold       the same without initial coefficients: what normal flight alone identifies
restart    the identifier killed (-9) in flight and started again
latency    from the stamp of an Imu sample to the command and to the coefficients, real time

Tables go to the terminal, figures to build/closed_loop/, with --picture the pictures to
docs/images/.
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
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import uav_ident_ros  # noqa: F401  (first: it limits the threads of NumPy)
from uav_ident_ros.domain import own_domain
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.simulation.closed_loop import ClosedLoop, Loop, tracking_error

ROOT = Path(__file__).resolve().parents[1]
BUILD = ROOT / "build" / "closed_loop"
IMAGES = ROOT / "docs" / "images"

FAULT_TIME = 60.0
DURATION = 100.0
WINDOWS = ((-30.0, 0.0), (0.0, 5.0), (5.0, 10.0), (10.0, 20.0), (20.0, 40.0))
"""Stretches that are compared, s after the fault."""

CASES: dict[str, tuple[str, ...]] = {
    "healthy": (),
    "aileron effect halved": (f"{FAULT_TIME}: aileron effect 0.5",),
    "elevator effect halved, pitch inertia +30 %": (
        f"{FAULT_TIME}: elevator effect 0.5",
        f"{FAULT_TIME}: pitch inertia 1.3",
    ),
}
AXIS = {"aileron effect halved": 0, "elevator effect halved, pitch inertia +30 %": 1}
MODES: dict[str, Loop] = {
    "fixed": Loop(DURATION, mode="fixed"),
    "adaptive": Loop(DURATION),
    "adaptive, by sigma": Loop(DURATION, heed_verdict=False),
}
"""The controllers. 'By sigma' ignores the verdict and trusts each coefficient by its sigma."""

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


def relative_to_healthy(record: Record, healthy: Record, axis: int) -> list[float]:
    """Tracking error over that of the healthy flight in the same stretches."""
    out = []
    for start, end in WINDOWS:
        span = (FAULT_TIME + start, FAULT_TIME + end)
        out.append(
            float(tracking_error(record, *span)[axis] / tracking_error(healthy, *span)[axis])
        )
    return out


# --- tracking --------------------------------------------------------------------------------


def tracking(seeds: int, picture: bool) -> dict[str, Any]:
    records: dict[tuple[str, str, int], Record] = {}
    for seed in range(seeds):
        for mode, loop in MODES.items():
            for case, faults in CASES.items():
                record, _ = fly(replace(loop, faults=faults, seed=seed))
                np.savez_compressed(BUILD / f"{mode}, {case}, {seed}.npz", **record)
                records[mode, case, seed] = record
                print(f"flown: {case}, {mode}, seed {seed}", file=sys.stderr, flush=True)
    if picture:
        draw_tracking({key[:2]: record for key, record in records.items() if key[2] == 0})
    return {
        case: {
            mode: [
                relative_to_healthy(records[mode, case, s], records[mode, "healthy", s], axis)
                for s in range(seeds)
            ]
            for mode in MODES
        }
        for case, axis in AXIS.items()
    } | {
        "healthy, deg/s": {
            mode: [
                tracking_error(records[mode, "healthy", s], FAULT_TIME - 30.0, DURATION).tolist()
                for s in range(seeds)
            ]
            for mode in MODES
        }
    }


def tracking_lines(found: dict[str, Any]) -> Iterator[str]:
    titles = [f"{start:g} to {end:g} s" for start, end in WINDOWS]
    for case in AXIS:
        yield f"| {case} | " + " | ".join(titles) + " |"
        yield "|---" * (len(titles) + 1) + "|"
        for mode, rows in found[case].items():
            middle, low, high = (f(rows, axis=0) for f in (np.median, np.min, np.max))
            cells = [
                f"{m:.2f} ({a:.2f} to {b:.2f})" for m, a, b in zip(middle, low, high, strict=True)
            ]
            yield f"| {mode} | " + " | ".join(cells) + " |"
        yield ""
    for mode, rows in found["healthy, deg/s"].items():
        p, q, r = np.mean(rows, axis=0)
        yield f"healthy, {mode}: {p:.2f} / {q:.2f} / {r:.2f} deg/s rms (p, q, r)"


def draw_tracking(records: dict[tuple[str, str], Record]) -> None:
    """Rates and references around each fault, and the coefficient that changed."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 8.5), layout="constrained")
    axes = figure.subplots(3, 2, sharex="col")
    for column, (case, axis) in enumerate(AXIS.items()):
        for row, mode in enumerate(("fixed", "adaptive")):
            draw_rates(
                axes[row, column], records[mode, case], axis, f"{mode}: {'pqr'[axis]}, deg/s"
            )
        name = ("pdot/da", "qdot/de")[axis]
        draw_coefficient(axes[2, column], records["adaptive", case], name)
        axes[0, column].set_title(case, fontsize=10)
        axes[2, column].set_xlabel("time, s")
        axes[2, column].set_xlim(FAULT_TIME - 15.0, FAULT_TIME + 30.0)
    axes[0, 0].legend(fontsize=8, loc="upper left")
    save_picture(figure, "closed_loop.png")


def draw_rates(axes: Any, record: Record, axis: int, label: str) -> None:
    axes.plot(
        record["time"], np.degrees(record["reference"][:, axis]), "k", lw=0.8, label="reference"
    )
    axes.plot(record["time"], np.degrees(record["rates"][:, axis]), "C3", lw=0.8, label="true rate")
    axes.axvline(FAULT_TIME, color="0.6", ls=":")
    axes.set_ylabel(label)


def draw_coefficient(axes: Any, record: Record, name: str) -> None:
    index = list(record["names"]).index(name)
    value, sigma = record["values"][:, index], record["sigma"][:, index]
    axes.fill_between(record["tick"], value - sigma, value + sigma, color="C0", alpha=0.2, lw=0)
    axes.plot(record["tick"], value, "C0", lw=1.0)
    unusable = record["usable"] == 0.0
    axes.fill_between(
        record["tick"], 0, 1, where=unusable, color="0.9", transform=axes.get_xaxis_transform(),
        zorder=0, lw=0, label="verdict: not usable",
    )  # fmt: skip
    axes.axvline(FAULT_TIME, color="0.6", ls=":")
    size = 1.3 * abs(value[record["tick"] > FAULT_TIME - 15.0]).max()
    axes.set_ylim(*sorted((0.0, size * np.sign(np.median(value)))))
    axes.set_ylabel(f"{name}, 1/s²")
    axes.legend(fontsize=8, loc="upper right")


def save_picture(figure: Any, name: str) -> None:
    """Save as a small PNG: a palette, so that the clone stays small."""
    import io

    from PIL import Image

    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=90)
    with Image.open(buffer) as picture:
        small = picture.convert("RGB").quantize(64, dither=Image.Dither.NONE)
        small.save(IMAGES / name, optimize=True)


# --- cold ------------------------------------------------------------------------------------


def cold(seeds: int, _: bool) -> dict[str, Any]:
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


def restart(seeds: int, _: bool) -> dict[str, Any]:
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


def latency(_seeds: int, _picture: bool) -> dict[str, Any]:
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
    "tracking": (tracking, tracking_lines),
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
    parser.add_argument("--picture", action="store_true", help="renew docs/images/closed_loop.png")
    options = parser.parse_args(arguments)
    os.chdir(ROOT)
    measure, lines = PROGRAMS[options.name]
    BUILD.mkdir(parents=True, exist_ok=True)
    found = measure(options.seeds, options.picture)
    (BUILD / f"{options.name}.json").write_text(json.dumps(found, indent=1))
    print("\n".join(lines(found)))


if __name__ == "__main__":
    main()
