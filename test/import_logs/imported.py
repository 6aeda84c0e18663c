# SPDX-License-Identifier: Apache-2.0
"""A simulated flight as the content of logs, and the content of imported bags."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import programs
from excerpts import decoded
from flying import plant_flight

from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.import_logs.cli import main
from uav_ident_ros.messages.types import header_ns
from uav_ident_ros.simulation.inputs import ColouredNoise
from uav_ident_ros.simulation.noise import Measurements, Sensors, measure


def flight(duration: float = 10.0, **sensors: Any) -> Measurements:
    """Measure a plant of the paper's structure under multisines, in the autopilots' axes."""
    flown = plant_flight(duration, actuator_rate=50.0, force=ColouredNoise(0.3, 0.5))
    usual = {"gyro_noise": 0.01, "accelerometer_noise": 0.05, "convention": "frd"}
    return measure(flown, Sensors(**{**usual, **sensors}), 3)


def contents(path: Path) -> SimpleNamespace:
    """Return the samples of an imported bag by the project's reader: stamps in ns, values."""
    found = decoded(path)
    imu, commands, airspeed = (
        [message for _, message in found.get(topic, ())]
        for topic in ("/imu/data", "/actuators", "/airspeed")
    )

    def vectors(field: str) -> np.ndarray:
        return np.array([[getattr(getattr(m, field), axis) for axis in "xyz"] for m in imu])

    return SimpleNamespace(
        imu_t_ns=np.array([header_ns(m) for m in imu]),
        rates=vectors("angular_velocity"),
        specific_force=vectors("linear_acceleration"),
        frame_ids={m.header.frame_id for m in imu},
        actuator_t_ns=np.array([header_ns(m) for m in commands]),
        actuators=np.array([m.position for m in commands]),
        names=list(commands[0].name),
        airspeed=np.array([m.twist.linear.x for m in airspeed]),
        **{name: [(t, m.data) for t, m in found.get(f"/{name}", ())] for name in ("armed", "mode")},
    )


def mixing(values: dict[str, Any]) -> np.ndarray:
    """Return the mixing matrix of the parameters, (4, channels)."""
    return np.array([values[f"actuators.mixing.{u}"] for u in ("de", "dr", "da", "dth")])


@dataclass
class Imported:
    """An imported log: the folder of the bag, and the command's output as one line."""

    folder: Path
    printed: str

    @cached_property
    def bag(self) -> SimpleNamespace:
        return contents(self.folder)

    @cached_property
    def values(self) -> dict[str, Any]:
        """Parameters written beside the bag."""
        return dict(load_parameters(self.folder / "identifier.yaml", "/identifier"))

    def __iter__(self) -> Iterator[Any]:
        return iter((self.bag, self.values, self.printed))


class Importer:
    """Importer of logs, each into a separate bag; `log` is the last log."""

    def __init__(self, folder: Path, capsys: Any) -> None:
        self.folder, self._capsys = folder, capsys
        self.log, self._count = folder, 0

    def __call__(self, log: Path | str, *options: str, status: int = 0) -> Imported:
        self.log, self._count = Path(log), self._count + 1
        bag = self.folder / f"bag_{self._count}"
        ended = main([str(log), "--output", str(bag), *options])
        printed = self._capsys.readouterr()
        assert ended == status, printed.err
        return Imported(bag, " ".join(str(printed.out).split()))

    def refused(self, log: Path | str, *options: str) -> str:
        """Import a log that is refused; return the error line."""
        arguments = [str(log), "--output", str(self.folder / "refused"), *options]
        line = programs.refusal(main, arguments, self._capsys)
        assert line.startswith("import_log: ")
        return line
