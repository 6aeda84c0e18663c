# SPDX-License-Identifier: Apache-2.0
"""The monitor beside the real node, over DDS: on a pipe, on a terminal, once."""

import contextlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from programs import PATIENCE, Capture, StartNode, Terminal, handled, refusal, wait_for
from recordings import Fly, Player, Recording, change, recording
from repository import ROOT

from uav_ident_ros.commandline import INTERRUPTED
from uav_ident_ros.monitor.cli import parser

MONITOR = [sys.executable, "-m", "uav_ident_ros", "monitor"]

SILENT = re.compile(
    r"^/identifier  waiting  not usable  last tick [\d.]+ s, none since$", re.MULTILINE
)
"""Start of the view after the end of the flight."""

StartMonitor = Callable[..., subprocess.Popen[str]]


class PlaybackEndError(Exception):
    """The condition of the playback is met."""


@pytest.fixture
def start_monitor() -> Iterator[StartMonitor]:
    """Start the monitor with its output in pipes or a file; end it after the test."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: str, output: Path | None = None) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [*MONITOR, *arguments],
            cwd=ROOT,
            stdout=output.open("w") if output else subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "COLUMNS": "80", "PYTHONIOENCODING": "utf-8"},
        )
        started.append(process)
        return process

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


class InParts:
    """A flight that is played in parts."""

    def __init__(self, flight: Recording, player: Player) -> None:
        self._flight, self._player = flight, player
        self._reached_ns = flight.messages[0].log_ns

    def until(self, enough: Callable[[], bool]) -> None:
        """Continue slowly: a busy machine takes long to start a process."""

        def check_time(t_ns: int) -> None:
            self._reached_ns = t_ns
            if enough():
                raise PlaybackEndError

        with contextlib.suppress(PlaybackEndError):
            rest = [m for m in self._flight.messages if m.log_ns >= self._reached_ns]
            self._player.play(rest, speed=0.3, on_time=check_time, in_step=True)

    def fly_on(self, seconds: float) -> None:
        """Continue for some seconds of the flight, in step."""
        begin, end = self._reached_ns, self._reached_ns + round(seconds * 1e9)
        self._player.play_in_step([m for m in self._flight.messages if begin <= m.log_ns < end])
        self._reached_ns = end


def test_the_verdict_follows_the_required_fit_and_the_end_of_the_flight(
    fly: Fly, start_monitor: StartMonitor, warm: Path, tmp_path: Path
) -> None:
    flight = recording("multisine", 50.0)
    start = warm.with_name("start.yaml")
    parameters = {"supervision.min_fit": "99.5", "initial_coefficients_file": start}
    _, player = fly(flight, parameters=parameters)
    played = InParts(flight, player)

    def once(*arguments: str) -> tuple[int, str]:
        """Play until the monitor ends; return its status and its output."""
        monitor = start_monitor("--once", *arguments)
        played.until(lambda: monitor.poll() is not None)
        shown, errors = monitor.communicate(timeout=PATIENCE)
        assert "Traceback" not in errors
        return monitor.returncode, shown

    played.fly_on(6.0)
    status, shown = once("--timeout", "60", "--node", "/identifier")
    assert status == 1
    assert shown.startswith("/identifier  learning  not usable  tick ")
    assert "needed: 100 %" in shown

    change(player, {"supervision.min_fit": -20.0})
    played.fly_on(4.0)  # noise costs the roll row one tick of its confirmation at 8.35 s
    status, shown = once("--timeout", "60", "--node", "/identifier")
    assert status == 0, shown
    assert shown.startswith("/identifier  converged  usable  tick ")
    newest = player.outputs.named[-1]
    da = list(newest.name).index("pdot/da")
    (row,) = re.findall(r"^da +([-+.\d]+) +([.\d]+) +(>?\d+) ", shown, re.MULTILINE)
    assert float(row[0]) == pytest.approx(newest.position[da], rel=0.05)
    assert float(row[1]) == pytest.approx(newest.effort[da], rel=0.3)
    assert re.search(r"rates +/imu/data +\d+\.\d Hz +age \d", shown)

    output = tmp_path / "shown"
    monitor = start_monitor("--node", "identifier/", output=output)

    def ticks() -> list[float]:
        found = re.findall(r"  tick ([\d.]+) s$", output.read_text(), re.MULTILINE)
        return [float(t) for t in found]

    played.until(lambda: len(ticks()) >= 3)
    # the verdict expires
    assert wait_for(lambda: bool(SILENT.search(output.read_text()))), output.read_text()[-2000:]
    monitor.send_signal(signal.SIGTERM)
    assert monitor.wait(PATIENCE) == 0
    assert "Traceback" not in monitor.stderr.read()
    assert ticks() == sorted(ticks())

    silent = start_monitor("--once", "--timeout", "8")
    shown, errors = silent.communicate(timeout=PATIENCE)
    assert silent.returncode == 1, shown + errors
    assert "waiting" in shown
    assert "none since" in shown


def test_once_without_a_node_or_messages_ends_with_an_error(start_monitor: StartMonitor) -> None:
    given = ((), ("--node", "/nowhere/identifier"))
    for monitor in [start_monitor("--once", "--timeout", "1", *options) for options in given]:
        shown, errors = monitor.communicate(timeout=PATIENCE)
        assert monitor.returncode == 3
        assert shown == ""
        assert errors.count("\n") == 1
        assert "for 1 s" in errors
        assert "run, with ROS_DOMAIN_ID" in errors


def test_an_interrupted_single_view_has_no_status_of_usable(start_monitor: StartMonitor) -> None:
    monitor = start_monitor("--once", "--timeout", "600", "--node", "/nowhere/identifier")
    assert wait_for(lambda: handled(monitor.pid, signal.SIGTERM))
    monitor.send_signal(signal.SIGINT)
    assert monitor.communicate(timeout=PATIENCE) == ("", "")
    assert monitor.returncode == INTERRUPTED


def test_several_identifiers_are_listed_and_one_is_chosen(
    start_node: StartNode, start_monitor: StartMonitor, tmp_path: Path
) -> None:
    nodes = [start_node(remappings={"__ns": f"/{name}"}) for name in ("one", "two")]
    assert all(wait_for(lambda node=node: "no message on" in node.log) for node in nodes)
    monitor = start_monitor("--once", "--timeout", "60")
    another = start_monitor("--once", "--timeout", "5", "--node", "/too/identifier")
    output = tmp_path / "shown"
    start_monitor("--node", "/two/identifier", output=output)
    shown, errors = monitor.communicate(timeout=PATIENCE)
    assert monitor.returncode == 2
    assert shown == ""
    assert errors.splitlines() == [
        "monitor: there are 2 identifiers: choose one with --node",
        "  /one/identifier",
        "  /two/identifier",
    ]
    shown, errors = another.communicate(timeout=PATIENCE)
    assert another.returncode == 3
    found = "monitor: no message of '/too/identifier' for 5 s; running: "
    assert errors == f"{found}/one/identifier, /two/identifier\n"
    assert wait_for(lambda: "no message on '/two/imu/data' yet" in output.read_text())
    assert "/two/identifier  waiting  not usable  no tick yet" in output.read_text()


def test_the_monitor_waits_for_a_node_and_restores_the_terminal(
    start_node: StartNode, start_monitor: StartMonitor
) -> None:
    with contextlib.closing(Terminal(MONITOR)) as terminal:
        assert terminal.read_until("looking for an identifier")
        start_node()
        assert terminal.read_until("no message on '/imu/data' yet")
        assert "\x1b[?1049h" in terminal.received  # the alternate screen, without a cursor
        assert "\x1b[?25l" in terminal.received
        terminal.process.send_signal(signal.SIGINT)
        assert terminal.read_until("\x1b[?1049l")
        assert terminal.process.wait(PATIENCE) == 0
        terminal.read_until("to the end of what was shown")
    assert "\x1b[?25h" in terminal.received
    assert "Traceback" not in terminal.received
    frame = re.sub(r"\x1b\[[?\d;]*[a-zA-Z]", "\n", terminal.received)
    drawn = frame[frame.index("/identifier") :]
    assert max(len(line) for line in drawn.splitlines()) <= 80

    # a terminal without cursor control gets blocks of text
    with contextlib.closing(
        Terminal(["env", "TERM=dumb", *MONITOR, "--node", "identifier"])
    ) as terminal:
        assert terminal.read_until("no message on '/imu/data' yet")
    assert "\x1b" not in terminal.received

    monitor = start_monitor("--plain", "--node", "/identifier")
    assert monitor.stdout.readline().startswith("/identifier")
    monitor.stdout.close()  # a closed pipe is no error
    assert monitor.wait(PATIENCE) == 0
    assert monitor.stderr.read() == ""
    monitor.stdout = None


@pytest.mark.parametrize(
    ("arguments", "printed"),
    [
        (("--node", "/"), "no node name"),
        (("--node", "drone 1"), "no node name"),
        (("--timeout", "-1"), "positive"),
        (("--timeout", "soon"), "positive"),
        (("--nod",), "expected one argument"),
        (("x",), "unrecognized"),
    ],
)
def test_a_wrong_command_line_is_refused_in_one_line(
    arguments: tuple[str, ...], printed: str, capsys: Capture
) -> None:
    assert printed in refusal(parser().parse_args, arguments, capsys)
