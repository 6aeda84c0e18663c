# SPDX-License-Identifier: Apache-2.0
"""The closed loop over DDS: plant, identifier, controller and reference as processes."""

import os
import signal
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from programs import Capture, wait_for
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import String

from uav_ident_ros.client.subscription import TOPIC
from uav_ident_ros.commandline import INTERRUPTED
from uav_ident_ros.guest import Guest
from uav_ident_ros.process import NodeProcess, own_domain
from uav_ident_ros.ros import latched
from uav_ident_ros.simulation import airframe, closed_loop
from uav_ident_ros.simulation.closed_loop import ClosedLoop, Loop, main, tracking_error
from uav_ident_ros.simulation.flight import SimulationError

pytest.importorskip("jsbsim", reason="JSBSim is a development extra")

FAULT = 3.5
SAMPLED = {"simulated_plant": {"rate": "50.0"}}
SHORT = Loop(
    duration=4.0,
    use_verdict=False,
    faults=(f"{FAULT}: aileron effect 0.5",),
    parameters=SAMPLED,
)
"""A flight on identified coefficients, with a fault at the end."""

TIMEOUT = 200.0


Flown = tuple[dict[str, np.ndarray], dict[str, str]]
"""The record, and the output of each process."""


def fly(loop: Loop, folder: Path, during: Callable[[ClosedLoop], None] | None = None) -> Flown:
    folder.mkdir()
    with ClosedLoop(loop, folder) as running:
        if during is not None:
            during(running)
        record = running.wait()
    return record, {name: running.log(name) for name in running.processes}


def land(running: ClosedLoop) -> None:
    """End the flight and keep its record."""
    running.processes["simulated_plant"].send_signal(signal.SIGINT)


def printed(running: ClosedLoop, name: str, words: str) -> bool:
    return wait_for(lambda: words in running.log(name), TIMEOUT)


@pytest.mark.parametrize("given", ["83", None])
@pytest.mark.parametrize(
    ("error", "status"), [(SimulationError("not flown"), 2), (KeyboardInterrupt(), INTERRUPTED)]
)
def test_a_flight_has_its_own_domain_unless_one_is_given_and_leaves_no_traceback(
    error: BaseException, status: int, given: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    domains: list[str | None] = []

    def started(*_: object) -> None:
        domains.append(os.environ.get("ROS_DOMAIN_ID"))
        raise error

    monkeypatch.setattr(closed_loop, "ClosedLoop", started)
    if given:
        monkeypatch.setenv("ROS_DOMAIN_ID", given)
    else:
        monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    assert closed_loop.main([]) == status
    assert domains == [given] if given else domains[0] in map(str, range(1, 102))


def test_an_aircraft_is_identified_once_and_again_after_an_edit_of_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared: list[str] = []

    def write(aircraft: str, folder: Path) -> None:
        prepared.append(aircraft)
        folder.mkdir(parents=True)
        (folder / "mine.yaml").touch()

    monkeypatch.setattr(closed_loop, "prepare", lambda aircraft, speed: aircraft)
    monkeypatch.setattr(closed_loop, "write", write)
    monkeypatch.setattr(closed_loop, "PREPARED", tmp_path / "prepared")
    monkeypatch.chdir(tmp_path)
    text = (airframe.FOLDER / "c172p.yaml").read_text()
    Path("mine.yaml").write_text(text)
    first = closed_loop.prepared_file("mine.yaml", None)
    assert closed_loop.prepared_file("mine.yaml", None) == first
    assert closed_loop.prepared_file(str(tmp_path / "mine.yaml"), None) == first
    assert prepared == [str(tmp_path / "mine.yaml")]  # flown from any folder
    Path("mine.yaml").write_text(text.replace("model: c172p", "model: pa28"))
    assert closed_loop.prepared_file("mine.yaml", None) != first
    Path("other/mine").mkdir(parents=True)
    Path("other/mine.yaml").write_text(text.replace("model: c172p", "model: mine"))
    Path("other/mine/mine.xml").touch()
    second = closed_loop.prepared_file("other/mine.yaml", None)
    assert second != first
    Path("other/mine/mine.xml").write_text("<!-- heavier -->")
    assert closed_loop.prepared_file("other/mine.yaml", None) not in (first, second)
    assert len(prepared) == 4


class Plant:
    """Stands in for the process of a plant that flies, or stands still, for some checks."""

    def __init__(self, record: Path, checks: int, flies: bool) -> None:
        self.log, self.returncode = "it flies\n", 0
        self._record, self._left, self._flies = record, checks, flies

    def poll(self) -> int | None:
        self._left -= 1
        if self._left == 0:
            np.savez(self._record, lost=[np.nan])
        elif self._flies:
            self._record.touch()
        return 0 if self._left <= 0 else None


def test_a_slow_flight_is_not_given_up_while_it_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(closed_loop, "STANDSTILL", 0.5)
    moving, still = (ClosedLoop(SHORT, tmp_path) for _ in range(2))
    for running, flies in ((moving, True), (still, False)):
        plant = Plant(running.record_file, 15, flies)
        running.processes = {"simulated_plant": plant}  # type: ignore[dict-item]
    assert np.isnan(moving.wait()["lost"]).all()
    still.record_file.unlink()
    with pytest.raises(SimulationError, match=r"stood still for 0.5 s: it flies"):
        still.wait()


def test_flights_are_equal_on_any_machine_until_the_excitation_starts(
    tmp_path: Path,
) -> None:
    """The second flight has paused processes, and excitation after two seconds."""

    def interrupt(running: ClosedLoop) -> None:
        """Pause the controller and the identifier for 0.4 s during the flight."""
        assert printed(running, "controller", "identified")
        assert running._progress()
        for name in ("controller", "identifier"):
            running.processes[name].send_signal(signal.SIGSTOP)
            time.sleep(0.4)
            running.processes[name].send_signal(signal.SIGCONT)

    # the coefficients in use have surely arrived: a busy machine may lag by 20 samples
    loop = replace(SHORT, parameters={**SAMPLED, "controller": {"coefficients_delay": "0.4"}})
    plain, logs = fly(loop, tmp_path / "plain")
    assert "; 0 samples without an answer" in logs["simulated_plant"]
    assert "aileron effect 0.5" in logs["simulated_plant"]
    assert "flying on identified coefficients" in logs["controller"]
    assert tracking_error(plain, 1.5, FAULT).max() < 5.0
    assert not plain["excitation"].any()

    record, logs = fly(replace(loop, excite=2.0), tmp_path / "excited", interrupt)
    assert "excitation is running" in logs["simulated_plant"]
    requested = record["excitation"]
    started = float(record["time"][requested.any(axis=1)][0])
    assert 2.0 < started < 3.0
    before = record["time"] < started
    for name in ("rates", "measured", "reference", "outputs", "surfaces"):
        np.testing.assert_array_equal(record[name][before], plain[name][before])
    whole = record["time"] < FAULT
    requested = requested[whole]
    answer = (record["outputs"] - plain["outputs"])[whole, :3]
    for k in range(3):  # the feedback attenuates the excitation and does not reverse it
        share = float(requested[:, k] @ answer[:, k] / (requested[:, k] @ requested[:, k]))
        assert 0.2 < share < 1.5
    assert tracking_error(record, 2.5, FAULT).max() < 10.0


def test_a_flight_survives_a_killed_identifier_and_takes_faults_by_topic(tmp_path: Path) -> None:
    def kill_and_restart(running: ClosedLoop) -> None:
        assert printed(running, "controller", "identified")
        running.processes["identifier"].kill()
        running.processes["identifier"].wait()
        assert printed(running, "simulated_plant", "going on without")
        before = running.log("controller").count("on identified")
        running.start("identifier")
        assert wait_for(lambda: running.log("controller").count("on identified") > before, TIMEOUT)
        publish_faults(running, "flaps fall off", "rudder jams 0.02")
        land(running)

    loop = replace(SHORT, duration=600.0, faults=())
    record, logs = fly(loop, tmp_path / "flight", kill_and_restart)
    lines = [line.split("]: ")[1] for line in logs["controller"].splitlines()]
    lost = lines.index("flying on last good coefficients: the coefficients are more than 0.5 s old")
    assert lines[lost - 1] == lines[lost + 1] == "flying on identified coefficients"
    assert "the identifier is back" in logs["simulated_plant"]
    gap = np.argmax(np.diff(record["tick"]))
    start, end = record["tick"][gap], record["tick"][gap + 1]
    assert end - start > 0.5
    assert tracking_error(record, start, end).max() < 5.0
    assert "'flaps fall off' is none of" in logs["simulated_plant"]
    assert record["surfaces"][-1, 1] == pytest.approx(-0.0010884456 + 0.02, abs=1e-6)


def publish_faults(running: ClosedLoop, *commands: str) -> None:
    """Publish faults to the plant, and continue for some samples."""
    with closing(Guest("pilot")) as pilot:
        publisher = pilot.node.create_publisher(String, "simulated_plant/fault", 10)
        assert pilot.spin_for(TIMEOUT, lambda: publisher.get_subscription_count() > 0)
        for command in commands:
            publisher.publish(String(data=command))
        assert printed(running, "simulated_plant", commands[-1])
        flown: list[Imu] = []
        speeds: list[TwistStamped] = []
        for kind, topic, received in ((Imu, "imu/data", flown), (TwistStamped, "airspeed", speeds)):
            pilot.node.create_subscription(kind, topic, received.append, qos_profile_sensor_data)
        assert pilot.spin_for(TIMEOUT, lambda: len(flown) > 20 and len(speeds) > 1)
        assert speeds[-1].twist.linear.x == pytest.approx(53.0, abs=6.0)


def test_the_controller_publishes_commands_once_coefficients_are_offered(tmp_path: Path) -> None:
    given, module = {"coefficients_delay": 0.3}, "uav_ident_ros.controller_example"
    with (
        own_domain(),
        NodeProcess(module, tmp_path / "log", given),
        closing(Guest("identifier")) as guest,
    ):

        def offered() -> bool:
            return bool(guest.node.count_publishers("command"))

        assert guest.spin_for(TIMEOUT, lambda: bool(guest.node.count_subscribers("imu/data")))
        assert not guest.spin_for(0.3, offered)
        guest.node.create_publisher(JointState, TOPIC, latched(1))
        assert guest.spin_for(5.0, offered)


def test_a_process_that_does_not_start_ends_the_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without = {
        k: v for k, v in closed_loop.MODULES.items() if k in ("controller", "simulated_plant")
    }
    monkeypatch.setattr(closed_loop, "MODULES", without)
    wrong = replace(SHORT, parameters={"controller": {"law": "hope"}})
    with pytest.raises(SimulationError, match=r"controller ended: .*'hope'"):
        fly(wrong, tmp_path / "flight")


def test_on_fixed_coefficients_the_aircraft_is_lost_and_its_record_is_kept(
    tmp_path: Path, capsys: Capture
) -> None:
    fault = "2: aileron effect -1"  # not survivable on fixed coefficients
    arguments = ["--duration", "60", "--mode", "fixed", "--fault", fault]
    with own_domain():
        assert main([*arguments, "--output", str(tmp_path)]) == 1
    printed = capsys.readouterr().out
    assert "fault at 2.0" in printed
    assert "rms of true rates minus reference" in printed
    with np.load(tmp_path / "flight.npz") as archive:
        record = dict(archive)
    lost = float(record["lost"][0])
    assert 2.0 < lost < 10.0
    assert record["time"][-1] == pytest.approx(lost, abs=0.05)
    assert f"the aircraft was lost at {lost:.1f} s" in printed
    (row,) = (
        line.split()
        for line in printed.splitlines()
        if line.split()[:5] == ["1", "s", "to", "2", "s"]
    )
    error = tracking_error(record, 1.0, 2.0)
    assert error.max() < 5.0
    np.testing.assert_allclose([float(v) for v in row[5:]], error, atol=0.005)
    log = (tmp_path / "controller.log").read_text(encoding="utf-8")
    assert "flying on nominal coefficients" in log and "identified" not in log
    assert len(record["tick"]) > 60  # the identifier still runs, and is recorded
