# SPDX-License-Identifier: Apache-2.0
"""The closed loop as processes, without launch: plant, identifier, controller, rate reference.

``scripts/closed_loop --fault '60: aileron effect 0.5'`` flies one flight and prints the tracking
error, also if the aircraft was lost. A new aircraft is first trimmed, excited and identified, which
takes some ten seconds.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from uav_ident_ros.commandline import INTERRUPTED, USAGE_ERROR, OneLineParser, given_path
from uav_ident_ros.control import LAWS
from uav_ident_ros.identification.structure import FloatArray
from uav_ident_ros.node.waiting import Progress
from uav_ident_ros.process import NodeProcess, own_domain
from uav_ident_ros.simulation.airframe import SUFFIX, airframe, airframe_names
from uav_ident_ros.simulation.faults import parse_fault
from uav_ident_ros.simulation.flight import SimulationError, check_positive
from uav_ident_ros.simulation.preparation import CONFIG, prepare, write

ROOT = CONFIG.parents[1]
PREPARED = ROOT / "build" / "aircraft"
"""Folder of the aircraft identified for the loop, with a folder for each speed and content of the
files."""

MODULES = {
    "identifier": "uav_ident_ros.node",
    "controller": "uav_ident_ros.controller_example",
    "rate_reference": "uav_ident_ros.simulation.rate_reference",
    "simulated_plant": "uav_ident_ros.simulation.plant_node",
}
"""Modules of the processes, by name."""

BEFORE = 30.0
"""Latest beginning of the evaluation before the fault, s."""

AFTER = (0.0, 5.0, 10.0, 20.0, math.inf)
"""Limits of the evaluated intervals after the fault, s."""

STANDSTILL = 120.0
"""Time without progress after which a flight is given up, s: twice the plant's longest wait, that
for the other nodes at the start."""


@dataclass(frozen=True)
class Loop:
    """One flight of the closed loop."""

    duration: float = 120.0  # s
    faults: tuple[str, ...] = ()  # As in `uav_ident_ros.simulation.faults`, with times
    mode: str = "adaptive"  # Of the controller: ``adaptive`` or ``fixed``
    # Whether ``verdict/usable`` decides on the use of coefficients; else their sigmas alone
    use_verdict: bool = True
    cold: bool = False  # Whether the identifier starts without initial coefficients
    excite: float = 0.0  # Time of the request for excitation, s; 0 for none
    seed: int = 0  # Seed of noise, gusts and manoeuvres
    lock_step: bool = True  # In lock-step, or in real time
    # Parameter file of all nodes; ``NAME_coefficients.yaml`` is beside it
    file: Path = CONFIG / "c172p.yaml"
    # More parameters, by process: ``{"simulated_plant": {"rate": "200.0"}}``
    parameters: Mapping[str, Mapping[str, object]] = field(default_factory=dict)

    def parameters_of(self, process: str, record: Path) -> dict[str, object]:
        """Return a process's parameters beyond those of the file; the plant writes `record`."""
        coefficients = self.file.with_name(f"{self.file.stem}_coefficients.yaml")
        own: dict[str, dict[str, object]] = {
            "identifier": {
                "use_sim_time": self.lock_step,
                **({} if self.cold else {"initial_coefficients_file": coefficients}),
            },
            "controller": {
                "mode": self.mode,
                "nominal_file": coefficients,
                "use_verdict": self.use_verdict,
                **({} if self.lock_step else {"coefficients_delay": 0.0, "reference_delay": 0.0}),
            },
            "rate_reference": {"seed": self.seed},
            "simulated_plant": {
                "duration": float(self.duration),
                "seed": self.seed,
                "lock_step": self.lock_step,
                "excite_at": float(self.excite),
                "faults": "[" + ", ".join(f"'{text}'" for text in (*self.faults, "")) + "]",
                "record_file": record,
            },
        }
        return {**own[process], **self.parameters.get(process, {})}


class ClosedLoop:
    """The running processes, as a context manager that ends them."""

    def __init__(
        self,
        loop: Loop,  # The flight
        folder: Path,  # For logs, record and state files; each flight starts without earlier state
    ) -> None:
        self.loop, self.folder = loop, folder
        self.record_file = folder / "flight.npz"
        self.processes: dict[str, NodeProcess] = {}

    def __enter__(self) -> ClosedLoop:
        self.record_file.unlink(missing_ok=True)
        for name in MODULES:
            self.start(name)
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        for process in self.processes.values():
            process.end()

    def start(self, name: str) -> None:
        """Start or restart one of `MODULES`."""
        self.processes[name] = NodeProcess(
            MODULES[name],
            self.folder / f"{name}.log",
            self.loop.parameters_of(name, self.record_file),
            file=self.loop.file,
            home=self.folder,
        )

    def log(self, name: str) -> str:
        """Return the output of a process up to now."""
        return self.processes[name].log

    def _progress(self) -> int:
        """Return a number that changes with every sample: the plant touches the record's file."""
        return self.record_file.stat().st_mtime_ns if self.record_file.exists() else 0

    def wait(self) -> dict[str, FloatArray]:
        """Wait until the plant has ended or the aircraft is lost; return its record."""
        plant, progress = self.processes["simulated_plant"], Progress(0)
        while plant.poll() is None:
            for name, process in self.processes.items():
                if name != "identifier" and process.poll() not in (None, 0):
                    raise SimulationError(f"{name} ended: {_last_line(self.log(name))}")
            if progress.unchanged_for(self._progress()) > STANDSTILL:
                line = _last_line(self.log("simulated_plant"))
                raise SimulationError(f"the flight has stood still for {STANDSTILL:g} s: {line}")
            time.sleep(0.1)
        if plant.returncode and not (self._progress() and self.record_file.stat().st_size):
            raise SimulationError(f"simulated_plant: {_last_line(self.log('simulated_plant'))}")
        with np.load(self.record_file) as archive:
            return dict(archive)


def _last_line(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "it printed nothing"


def tracking_error(record: Mapping[str, FloatArray], start: float, end: float) -> FloatArray:
    """Return the rms of true rates minus reference, `start` to `end` (s), shape (3,), deg/s."""
    inside = (record["time"] >= start) & (record["time"] < end)
    error = (record["rates"] - record["reference"])[inside]
    return np.asarray(np.degrees(np.sqrt(np.nanmean(error**2, axis=0))))


def report(record: Mapping[str, FloatArray], fault_time: float) -> Iterator[str]:
    """Yield the lines of the report on a flight's tracking error."""
    yield "rms of true rates minus reference, deg/s        p      q      r"
    duration = float(record["time"][-1])
    edges = [min(BEFORE, 0.5 * fault_time), *(min(fault_time + t, duration) for t in AFTER)]
    for start, end in pairwise(edges):
        if not end > start:
            continue
        p, q, r = tracking_error(record, start, end)
        yield f"  {start:5.0f} s to {end:5.0f} s {'':22} {p:6.2f} {q:6.2f} {r:6.2f}"
    if np.isfinite(lost := float(record["lost"][0])):
        yield f"the aircraft was lost at {lost:.1f} s, {lost - fault_time:.1f} s after the fault"
    if len(record["usable"]):
        yield f"coefficients usable in {100.0 * np.mean(record['usable']):.0f} % of the ticks"


def prepared_file(
    aircraft: str,  # Its name, or the path of its file
    speed: float | None,  # True airspeed in place of the file's, m/s
) -> Path:
    """Return an aircraft's `Loop.file`; trim, excite and identify it first if there is none."""
    if aircraft in shipped() and speed is None:
        return CONFIG / f"{aircraft}.yaml"
    frame = airframe(aircraft, speed)
    if aircraft.endswith(SUFFIX):  # the loop may be flown from another folder
        aircraft = str(Path(aircraft).resolve())
    model = [path.read_bytes() for path in sorted(Path(frame.model).rglob("*.xml"))]
    identity = hashlib.sha256(repr((aircraft, frame, model)).encode()).hexdigest()[:8]
    file = PREPARED / f"{frame.name}_{frame.speed:.1f}_{identity}" / f"{frame.name}.yaml"
    if not file.exists():
        print(f"identifying {frame.name} at {frame.speed:.1f} m/s: {frame.description}", flush=True)
        write(prepare(aircraft, speed), file.parent)
    return file


def shipped() -> list[str]:
    """Return the names of the aircraft with a `Loop.file` in this package."""
    end = "_coefficients"
    return sorted(path.stem.removesuffix(end) for path in CONFIG.glob(f"*{end}.yaml"))


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = OneLineParser(prog="scripts/closed_loop", description=__doc__)
    add = parser.add_argument
    add("--aircraft", default="c172p", metavar="NAME",
        help=f"{', '.join(dict.fromkeys((*shipped(), *airframe_names())))}, or the path of a "
             "file like theirs (default: c172p); it is identified first, once")  # fmt: skip
    add("--speed", type=float, metavar="M/S", help="true airspeed (default: the aircraft's own)")
    add("--duration", type=float, default=120.0, help="s (default: 120)")
    add("--fault", action="append", default=[],
        help="'60: aileron effect 0.5'; may be repeated")  # fmt: skip
    add("--turbulence", type=int, default=0, metavar="LEVEL", help="0 (calm) to 7 (default: 0)")
    add("--mode", choices=("adaptive", "fixed"), default="adaptive")
    add("--law", choices=tuple(LAWS), default="incremental")
    add("--ignore-verdict", action="store_true",
        help="use the newest coefficients, each as far as its sigma allows")  # fmt: skip
    add("--cold", action="store_true", help="no initial coefficients")
    add("--excite", type=float, default=0.0, metavar="S",
        help="request excitation at S, s (docs/excitation.md)")  # fmt: skip
    add("--seed", type=int, default=0)
    add("--real-time", action="store_true", help="with the wall clock, not in step")
    add("--output", type=given_path, help="folder for the logs and the record")
    return parser


def loop_from(options: argparse.Namespace) -> Loop:
    """Return the flight of the options; identify the aircraft first if needed."""
    check_positive(options, "duration")
    check_positive(options, "seed", or_zero=True)
    faults = list(options.fault)
    if options.turbulence:
        faults.append(f"0: turbulence {options.turbulence}")
    for text in faults:
        fault, end = parse_fault(text), options.duration
        if not 0.0 <= fault.time < end:
            raise SimulationError(
                f"fault '{text}' needs a time before the end of the flight, at {end:g} s: "
                f"'{0.5 * end:g}: {fault}'"
            )
    return Loop(
        options.duration, tuple(faults), options.mode, not options.ignore_verdict,
        options.cold, options.excite, options.seed, not options.real_time,
        prepared_file(options.aircraft, options.speed), {"controller": {"law": options.law}},
    )  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly one flight; return the exit status: 1 if the aircraft was lost, 2 if it did not fly."""
    options = make_parser().parse_args(arguments)
    try:
        loop = loop_from(options)
        times = [parse_fault(text).time for text in options.fault]
        domain = nullcontext() if os.environ.get("ROS_DOMAIN_ID") else own_domain()
        with domain, tempfile.TemporaryDirectory() as scratch:
            folder = options.output or Path(scratch)
            folder.mkdir(parents=True, exist_ok=True)
            with ClosedLoop(loop, folder) as running:
                record = running.wait()
                print(running.log("controller"), end="")
                print(running.log("simulated_plant"), end="")
            for line in report(record, min(times, default=0.5 * loop.duration)):
                print(line)
    except (SimulationError, OSError) as error:
        print(f"closed_loop: {error}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        return INTERRUPTED
    return int(np.isfinite(record["lost"][0]))


if __name__ == "__main__":
    sys.exit(main())
