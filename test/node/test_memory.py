# SPDX-License-Identifier: Apache-2.0
"""The state file: start from it, its refusal with the reason, and the times of writing."""

import os
import re
import signal
import threading
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
import rclpy.logging
from estimates import estimate_of
from programs import PATIENCE, Capture, wait_for
from recordings import NODE, Fly, recording
from std_srvs.srv import Trigger

from uav_ident_ros.files.coefficients_file import (
    CoefficientsFileError,
    Notes,
    load_with_notes,
    save_coefficients,
)
from uav_ident_ros.identification.estimate import CoefficientSet, Estimate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.node import memory
from uav_ident_ros.node.memory import Memory, in_words, state_path

STRUCTURE = STRUCTURES["augmented"]
NOW = datetime(2026, 3, 1, 12, 0, 0, tzinfo=UTC)


def coefficients(value: float, structure: str = "augmented") -> CoefficientSet:
    mask = STRUCTURES[structure].mask
    return CoefficientSet(structure, mask * value, mask * 0.1 * abs(value), 5)


@pytest.fixture(autouse=True)
def long_time_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Extend the time limit: on a busy machine a file takes longer than the node's limit."""
    monkeypatch.setattr(memory, "ANSWER_WITHIN", 30.0)


class Vehicle:
    """An identifier with a memory, as in the node."""

    def __init__(self, path: Path, **settings: object) -> None:
        given = {name.replace("__", "."): value for name, value in settings.items()}
        own = {"state_file": str(path), "structure": STRUCTURE.name, **given}
        self.identifier = OnlineIdentifier(Settings.from_values(own))
        log = rclpy.logging.get_logger("test_memory")
        self.memory = Memory(self.identifier, NODE, log)
        self.memory.start(NOW)

    @property
    def values(self) -> np.ndarray:
        return self.identifier.coefficient_set().values

    def learn(self, value: float) -> None:
        """Set the coefficients as after a flight."""
        self.identifier.resume(coefficients(value))

    def estimate(self, *, usable: bool) -> Estimate:
        shown = self.identifier.coefficient_set()
        return estimate_of(shown.values, shown.sigma, t_ns=10**9, usable=usable)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state" / "identifier.yaml"


def write(path: Path, values: CoefficientSet, **notes: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    save_coefficients(values, path, Notes(**notes))


def test_every_node_has_a_separate_state_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_HOME", "/var/pilot/ros")
    folder = "/var/pilot/ros/uav_ident_ros"
    assert state_path(Settings(), "/identifier") == Path(f"{folder}/identifier.yaml")
    assert state_path(Settings(), "/a/identifier") == Path(f"{folder}/a.identifier.yaml")
    assert state_path(replace(Settings(), state_file="none"), "/identifier") is None


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda text: text[: len(text) // 2], "line "),
        (lambda text: re.sub("value: 2.0", "value: 2.0e9", text, count=1), "beyond 1e\\+06"),
        (
            lambda text: re.sub("saved: .*", "saved: 2026-01-01T00:00:00Z", text),
            "saved 60 days ago",
        ),
        (lambda text: text.replace('"[]"', '"[2.0, 1.0, 1.0, 1.0]"'), "'actuators.scale'"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_an_unusable_state_file_is_reported_and_kept_as_refused(
    path: Path, capfd: Capture, spoil: Callable[[str], str], reason: str
) -> None:
    write(path, coefficients(2.0), saved=NOW, learned_with={"actuators.scale": "[]"})
    spoiled = spoil(path.read_text())
    path.write_text(spoiled)
    vehicle = Vehicle(path)
    printed = capfd.readouterr().err
    assert re.search(f"starting cold: .*'{re.escape(str(path))}'.*{reason}", printed), printed
    assert not vehicle.values.any()
    vehicle.learn(1.0)
    assert vehicle.memory.save(vehicle.estimate(usable=True))[0]
    assert path.with_name("identifier.yaml.refused").read_text() == spoiled
    assert np.array_equal(load_with_notes(path)[0].values, vehicle.values)


@pytest.mark.parametrize(("days", "started"), [(1, True), (6, True), (8, False)])
@pytest.mark.parametrize("noted", [True, False])
def test_the_age_of_the_state_file_is_by_the_system_clock(
    path: Path, days: int, started: bool, noted: bool
) -> None:
    """The message time is 5 ns, as in simulated time, and has no effect."""
    moment = NOW - timedelta(days=days)
    write(path, coefficients(2.0), saved=moment if noted else None)
    # a file without `saved` has the time of its modification
    os.utime(path, times=(0.0 if noted else moment.timestamp(),) * 2)
    assert Vehicle(path).values.any() == started
    assert Vehicle(path, state_max_age=0.0).values.any(), "0 stands for never too old"


def test_a_state_file_of_the_future_is_used(path: Path, capfd: Capture) -> None:
    write(path, coefficients(2.0), saved=NOW + timedelta(days=1))
    assert Vehicle(path).values.any()
    printed = capfd.readouterr().err
    assert "the computer's clock is 24 h behind" in printed
    assert re.search(rf"started from '{re.escape(str(path))}'$", printed, re.MULTILINE)


def test_a_state_file_below_a_file_is_named_as_such(path: Path) -> None:
    path.parent.write_text("")
    vehicle = Vehicle(path)
    vehicle.learn(1.0)
    failed = (False, f"cannot write '{path}': '{path.parent}' is no folder")
    assert vehicle.memory.save(vehicle.estimate(usable=True), last=True) == failed


def test_without_a_state_file_nothing_is_written() -> None:
    vehicle = Vehicle(Path("none"))
    vehicle.learn(1.0)
    done, line = vehicle.memory.save(vehicle.estimate(usable=True))
    vehicle.memory.attend(vehicle.estimate(usable=True), now=100.0)
    vehicle.memory.finish(vehicle.estimate(usable=True))
    assert not done and "'state_file' is 'none'" in line
    assert not Path("none").exists()


def test_usable_coefficients_are_saved_periodically(path: Path) -> None:
    vehicle = Vehicle(path, save_period=10.0)
    vehicle.learn(1.0)
    vehicle.memory.attend(vehicle.estimate(usable=False), now=0.0)
    assert not path.exists()
    for now, value, wanted in ((1.0, 1.0, 1.0), (10.5, 2.0, 1.0), (11.5, 3.0, 3.0)):
        vehicle.learn(value)
        vehicle.memory.attend(vehicle.estimate(usable=True), now)
        assert wait_for(path.exists)
        held = load_with_notes(path)[0].values
        assert held[STRUCTURE.mask].max() == wanted


def test_unusable_coefficients_replace_usable_ones_only_after_a_reset(path: Path) -> None:
    vehicle = Vehicle(path)
    vehicle.memory.finish(vehicle.estimate(usable=False))
    assert not path.exists(), "nothing was learned"
    vehicle.learn(1.0)
    vehicle.memory.finish(vehicle.estimate(usable=False))
    assert load_with_notes(path)[1].usable is False
    vehicle.learn(2.0)
    vehicle.memory.finish(vehicle.estimate(usable=True))
    assert load_with_notes(path)[1].usable is True
    next_flight = Vehicle(path)
    next_flight.learn(3.0)
    next_flight.memory.finish(next_flight.estimate(usable=False))
    assert load_with_notes(path)[0].values.max() == 2.0
    next_flight.identifier.reset()
    next_flight.memory.forget()
    next_flight.memory.finish(next_flight.estimate(usable=False))
    assert load_with_notes(path)[0].values.max() == 2.0, "nothing was learned since"
    next_flight.learn(4.0)
    next_flight.memory.finish(next_flight.estimate(usable=False))
    assert load_with_notes(path)[0].values.max() == 4.0


def test_a_write_that_fails_late_leaves_nothing_to_protect(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answered, failed = threading.Event(), list[Path]()

    def fail_once(values: CoefficientSet, target: Path, notes: Notes) -> None:
        if failed:
            return save_coefficients(values, target, notes)
        failed.append(target)
        answered.wait(PATIENCE)
        raise CoefficientsFileError("the disk is full")

    monkeypatch.setattr(memory, "save_coefficients", fail_once)
    monkeypatch.setattr(memory, "ANSWER_WITHIN", 0.0)
    vehicle = Vehicle(path)
    vehicle.learn(1.0)
    assert vehicle.memory.save(vehicle.estimate(usable=True)) == (True, f"writing '{path}'")
    answered.set()
    vehicle.memory.finish(vehicle.estimate(usable=False))
    assert load_with_notes(path)[1].usable is False


def test_temporary_files_of_killed_processes_alone_are_removed(path: Path) -> None:
    write(path, coefficients(2.0), saved=NOW)
    ended, running = 2**22 + 1, os.getpid()  # the first is above every process number
    for process in (ended, running):
        path.with_name(f".identifier.yaml.{process}.tmp").write_text("half")
    Vehicle(path)
    left = sorted(p.name for p in path.parent.iterdir())
    assert left == [f".identifier.yaml.{running}.tmp", "identifier.yaml"]


def test_a_saved_servo_lag_is_used_at_the_start(path: Path) -> None:
    write(path, coefficients(1.0), saved=NOW, delay=0.0125, servo_lag=0.0473)
    vehicle = Vehicle(path, actuators__estimate_delay=True)
    assert (vehicle.identifier.delay, vehicle.identifier.lag) == (0.0125, 0.0473)
    vehicle.learn(2.0)
    assert vehicle.identifier.lag == 0.0, "what is not told is as set"


def test_time_spans_are_printed_in_a_suitable_unit() -> None:
    spans = (1.2, 90.0, 130.0, 7300.0, 200_000.0)
    words = ["1 s", "90 s", "2 min", "2 h", "2 days"]
    assert [in_words(timedelta(seconds=s)) for s in spans] == words


# --- through the node --------------------------------------------------------------------------


def test_the_node_starts_cold_from_a_damaged_file_and_warm_from_its_own(
    fly: Fly, ros_home: Path
) -> None:
    flight = recording("multisine", 5.0)
    path = ros_home / "uav_ident_ros" / "identifier.yaml"
    path.parent.mkdir(parents=True)
    path.write_text("format: uav_ident_ros/coefficients\nversion: 1\nstruct")
    node, player = fly(flight)
    assert f"starting cold: coefficients file '{path}': line 3" in node.log
    player.play_in_step(flight.messages)
    assert not np.any(player.outputs.coefficients[0].data)
    learned = player.outputs.coefficients[-1].data
    assert node.end(signal.SIGTERM) == 0
    assert f"saved to '{path}'" in node.log
    assert path.with_name("identifier.yaml.refused").exists()

    initial = ros_home / "initial.yaml"
    write(initial, coefficients(0.5))
    node, player = fly(flight, parameters={"initial_coefficients_file": str(initial)})
    assert f"started from '{path}', saved" in node.log
    player.play_in_step(flight.messages[:1500])
    assert player.outputs.coefficients[0].data == learned, "the state file wins"
    assert player.call(Trigger, "reset").success
    player.play_in_step(flight.messages[:1500])
    mask = STRUCTURE.mask.ravel()
    assert (np.array(player.outputs.coefficients[0].data)[mask] == 0.5).all()
