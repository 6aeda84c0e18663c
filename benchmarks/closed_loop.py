# SPDX-License-Identifier: Apache-2.0
"""The closed loop on the identified model, measured: ``python benchmarks/closed_loop.py NAME``.

cold       no initial coefficients: identification in normal flight alone; JSBSim's c172p, every
           node a process, in lock-step
restart    the identifier killed (-9) in flight and started again
latency    from the stamp of an Imu sample to the command and to the coefficients, real time

Tables go to the terminal, figures to build/closed_loop/. ``fault_campaign.py`` flies the faults.
"""

import itertools
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import bench
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, JointState

from uav_ident_ros.guest import Guest
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.messages.types import header_ns, stamp_ns
from uav_ident_ros.process import own_domain
from uav_ident_ros.simulation.closed_loop import ClosedLoop, Loop, tracking_error

DURATION = 100.0

FLIGHT_TIMEOUT = 600.0
ATTEMPTS = 3

Record = dict[str, FloatArray]


def fly(loop: Loop, during: Callable[[ClosedLoop], None] | None = None) -> tuple[Record, str]:
    """Fly once in a domain of its own; return the record and the controller's output.

    The flight is repeated if a node did not answer in time, because the machine is too busy or
    another program uses the domain.
    """
    for _ in range(ATTEMPTS):
        with (
            tempfile.TemporaryDirectory() as folder,
            own_domain(),
            ClosedLoop(loop, Path(folder)) as running,
        ):
            if during is not None:
                during(running)
            record = running.wait()
            printed = running.log("simulated_plant")
            if during is not None or "going on" not in printed:
                return record, running.log("controller")
        print(f"again, because of:\n{printed}", file=sys.stderr)
    raise SystemExit(f"no undisturbed flight in {ATTEMPTS} attempts")


# --- cold ------------------------------------------------------------------------------------


def cold(_: int) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for start in ("cold", "with initial coefficients"):
        record, printed = fly(Loop(DURATION, cold=start == "cold"))
        names = [str(name) for name in record["names"]]
        last = {
            name: [float(record[key][-1, i]) for key in ("values", "sigma")]
            for i, name in enumerate(names)
        }
        out[start] = {
            "coefficients": last,
            "fit": record["fit"][-1].tolist(),
            "usable, % of ticks": 100.0 * float(np.mean(record["usable"])),
            "controller": printed.splitlines(),
            "tracking, deg/s": tracking_error(record, 30.0, DURATION).tolist(),
        }
    return out


def cold_lines(found: dict[str, Any]) -> Iterator[str]:
    shown = ("pdot/p", "pdot/da", "qdot/q", "qdot/de", "rdot/r", "rdot/dr", "pdot/dth", "qdot/pr")
    cells = (
        ["{:.2f} ± {:.2f}".format(*run["coefficients"][name]) for run in found.values()]
        for name in shown
    )
    rows = ((f"`{name}`", *row) for name, row in zip(shown, cells, strict=True))
    yield from bench.table(("coefficient", *found), rows)
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
        undisturbed, _printed = fly(Loop(DURATION, seed=seed))
        record, printed = fly(Loop(DURATION, seed=seed), kill_and_restart)
        gap = np.diff(record["tick"]).max()
        spans = ((20.0, KILL_TIME), (KILL_TIME, RESTART_TIME), (RESTART_TIME, DURATION))
        rows = [
            [tracking_error(r, *span).tolist() for span in spans] for r in (undisturbed, record)
        ]
        out["tracking"].append(rows)
        out["controller"].append([*printed.splitlines(), f"gap in the ticks: {gap:.1f} s"])
    return out


def kill_and_restart(running: ClosedLoop) -> None:
    """Kill the identifier in flight and restart it later."""
    times: list[int] = []
    guest = Guest("flight_clock")
    guest.node.create_subscription(Clock, "/clock", lambda m: times.append(stamp_ns(m.clock)), 1)

    def wait_until(flight_time: float) -> None:
        due = flight_time * 1e9
        guest.spin_for(FLIGHT_TIMEOUT, lambda: bool(times) and times[-1] - times[0] >= due)

    try:
        wait_until(KILL_TIME)
        running.processes["identifier"].kill()
        running.processes["identifier"].wait()
        wait_until(RESTART_TIME)
        running.start("identifier")
    finally:
        guest.close()


def restart_lines(found: dict[str, Any]) -> Iterator[str]:
    yield "rms tracking error, deg/s (p / q / r)      undisturbed           killed and restarted"
    for rows in found["tracking"]:
        for title, plain, hit in zip(("before", "without it", "after"), *rows, strict=True):
            texts = ["{:.2f} / {:.2f} / {:.2f}".format(*row) for row in (plain, hit)]
            yield f"{title:12} {texts[0]:>40} {texts[1]:>28}"
    yield from found["controller"][0]


# --- latency ---------------------------------------------------------------------------------

LATENCY_TIME = 40.0
WARM_UP = 5.0
IMU_RATES = (100.0, 200.0)
WAITS = (0.05, 0.02)
"""Values of `input_wait`, s."""


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
        fly(loop, partial(listen, ages=ages, dropped=dropped))
        found: dict[str, Any] = {
            topic: {
                **{f"p{q}": float(np.percentile(values, q)) for q in (50, 99)},
                "count": len(values),
            }
            for topic, values in ages.items()
        }
        out[f"{rate:g} Hz, {1e3 * wait:g} ms"] = {"ages": found, "dropped": dropped}
    return out


def listen(running: ClosedLoop, ages: dict[str, list[float]], dropped: dict[str, str]) -> None:
    """Collect the age of each message on arrival, ms, and the identifier's dropped samples."""
    begin: list[float] = []

    def take(topic: str, message: Any) -> None:
        now = time.monotonic()
        begin.append(now) if not begin else None
        if now - begin[0] > WARM_UP:
            ages.setdefault(topic, []).append((time.time_ns() - header_ns(message)) * 1e-6)

    def take_diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            dropped.update({v.key: v.value for v in status.values if ": dropped" in v.key})

    guest = Guest("listener")
    subscribe = guest.node.create_subscription
    subscribe(DiagnosticArray, "/diagnostics", take_diagnostics, 10)
    for topic, kind in (
        ("imu/data", Imu), ("command", JointState), ("identifier/coefficients_named", JointState),
    ):  # fmt: skip
        subscribe(kind, topic, partial(take, topic), 50)
    while running.processes["simulated_plant"].poll() is None:
        guest.spin_for(0.1)
    guest.close()


def latency_lines(found: dict[str, Any]) -> Iterator[str]:
    rows = []
    for case, given in found.items():
        for topic, v in given["ages"].items():
            rows.append((case, f"`{topic}`", f"{v['p50']:.1f}", f"{v['p99']:.1f}", f"{v['count']}"))
        rows.append((case, "dropped", f"{given['dropped']}", "", ""))
    head = ("Imu, input_wait", "from its stamp to", "p50, ms", "p99, ms", "messages")
    return bench.table(head, rows)


PROGRAMS = {
    "cold": (cold, cold_lines),
    "restart": (restart, restart_lines),
    "latency": (latency, latency_lines),
}


def main() -> None:
    parser = bench.parser(__doc__, seeds=3)
    parser.add_argument("name", choices=tuple(PROGRAMS))
    options = parser.parse_args()
    os.chdir(bench.ROOT)
    measure, lines = PROGRAMS[options.name]
    found = measure(options.seeds)
    bench.keep(bench.BUILD / "closed_loop" / f"{options.name}.json", found)
    print("\n".join(lines(found)))


if __name__ == "__main__":
    main()
