# SPDX-License-Identifier: Apache-2.0
"""`replay` of many bags and configurations: a separate outcome and folder for each."""

import itertools
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from excerpts import BAGS, PARAMETERS, excerpt, parameter_file, replay, summary
from programs import PATIENCE, Capture, Terminal, python, wait_for
from repository import ROOT

from uav_ident_ros.bags.reading import BagError
from uav_ident_ros.commandline import NOT_USABLE, USABLE
from uav_ident_ros.offline import NO_RESULT, job, main
from uav_ident_ros.offline.command import WORST_FIT, mean_fit, overview, percent, ranked, ranking
from uav_ident_ros.offline.find import find_bags, names_of
from uav_ident_ros.offline.fleet import read_flights
from uav_ident_ros.offline.job import Job, Outcome
from uav_ident_ros.offline.parallel import DONE_FILE
from uav_ident_ros.offline.run import Bar

REPLAY = [sys.executable, "-m", "uav_ident_ros", "replay"]


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create a folder of flights, a short one, a broken one, results and other files."""
    folder = tmp_path_factory.mktemp("logs")
    excerpt(folder / "monday" / "flight", 4.0)
    excerpt(folder / "tuesday" / "flight", 1.0)
    excerpt(folder / "tuesday" / "later", 2.0, begin=5.0)
    (folder / "broken.mcap").write_bytes(b"not a bag")
    (folder / "notes.txt").write_text("hello")
    (folder / ".trash").mkdir()
    (folder / ".trash" / "old.mcap").write_bytes(b"")
    excerpt(folder / "replay_flight" / "estimates", 1.0)  # a result of an earlier replay
    (folder / "replay_flight" / "summary.json").write_text("{}")
    return folder


# --- which bags --------------------------------------------------------------------------------


def test_a_bag_is_distinguished_from_a_folder_of_bags(tmp_path: Path) -> None:
    flight = excerpt(tmp_path / "flight", 0.1)
    for bag in (flight, flight / "flight.mcap", tmp_path / "nowhere"):
        assert find_bags(bag) == [bag]
    (flight / "metadata.yaml").unlink()
    assert find_bags(flight) == [flight]  # one file without metadata: killed recorder
    (flight / "flight.mcap").rename(flight / "flight_0.mcap")
    (flight / "flight_1.mcap").write_bytes(b"")
    assert find_bags(flight) == [flight]  # the numbered files of one recording
    (flight / "other_0.mcap").write_bytes(b"")
    assert [bag.name for bag in find_bags(flight)] == [
        "flight_0.mcap", "flight_1.mcap", "other_0.mcap"
    ]  # fmt: skip
    (tmp_path / "empty").mkdir()
    assert find_bags(tmp_path / "empty") == []


def test_every_bag_has_a_unique_output_name() -> None:
    paths = ["a/x", "b/x", "c/y.mcap", "d/a/x", "y.db3/z"]
    assert names_of([Path(path) for path in paths]) == ["a_x", "b_x", "y", "a_x_2", "z"]


# --- many bags ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def replayed(logs: Path, warm: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """Return the output folder of a replay of all, and the finished process."""
    output = tmp_path_factory.mktemp("output")
    return output, python(*REPLAY[1:], *arguments(logs, warm, output, "--jobs", "2"))


def arguments(logs: Path, file: Path, output: Path, *more: str) -> list[str]:
    return [str(logs), "--params-file", str(file), "--output", str(output), *more]


def test_a_bad_bag_does_not_stop_the_others(replayed: tuple[Path, Any]) -> None:
    output, done = replayed
    assert done.returncode == NO_RESULT
    folders = sorted(path.name for path in output.iterdir() if path.is_dir())
    assert folders == ["broken", "later", "monday_flight", "tuesday_flight"]
    assert [file.name for file in (output / "broken").iterdir()] == ["replayed.json"]
    assert summary(output / "monday_flight")["usable"]
    assert not summary(output / "tuesday_flight")["usable"]
    (line,) = done.stderr.splitlines()
    assert re.match(
        r"replay: broken: bag '.*broken\.mcap' cannot be read: .* is no MCAP file", line
    )
    rows = {line.split()[0]: line for line in done.stdout.splitlines() if line}
    assert rows["monday_flight"].endswith("  usable")
    assert "  not usable: at rest: no rate moves" in rows["tuesday_flight"]
    assert "  no result: bag " in rows["broken"]
    assert "4 bags: 2 usable, 1 not usable, 1 no result" in done.stdout
    assert f"\nwritten to {output}{os.sep}; table: {output / 'flights.csv'}" in done.stdout


def test_parameter_files_that_are_not_read_are_named(tmp_path: Path) -> None:
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
        (tmp_path / day / "flight.mcap").touch()
        (tmp_path / day / "identifier.yaml").touch()
    done = python(*REPLAY[1:], str(tmp_path), "--output", str(tmp_path / "out"))
    unread = "replay: 2 bags have a parameter file beside them, which was not read, as "
    assert f"{unread}{tmp_path / 'monday' / 'identifier.yaml'}: give one of all" in done.stderr


def test_parallel_replays_equal_single_ones(
    logs: Path, warm: Path, replayed: tuple[Path, Any], tmp_path: Path
) -> None:
    assert replay(logs / "monday" / "flight", tmp_path / "alone", by=warm) == USABLE
    for name in ("coefficients.yaml", "estimates/estimates.mcap"):
        together = replayed[0] / "monday_flight" / name
        assert together.read_bytes() == (tmp_path / "alone" / name).read_bytes()
    together, alone = summary(replayed[0] / "monday_flight"), summary(tmp_path / "alone")
    assert (together.pop("bag"), alone.pop("bag")) == ("monday_flight", "flight")
    assert together == alone


def test_a_killed_process_affects_its_own_bag_alone(logs: Path, tmp_path: Path) -> None:
    script = (
        "import os, signal, sys\n"
        "from uav_ident_ros.offline import main, parallel\n"
        "work = parallel.work\n"
        "def deadly(job):\n"
        "    if job.name == 'monday_flight':\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "    return work(job)\n"
        "if __name__ == '__main__':\n"
        "    parallel.work = deadly\n"
        "    main()\n"
    )
    (tmp_path / "deadly.py").write_text(script)
    bags = [str(logs / day / "flight") for day in ("monday", "tuesday")]
    done = python(str(tmp_path / "deadly.py"), *bags, "--output", str(tmp_path), "--jobs", "2")
    assert re.search(
        r"^monday_flight .* no result: .*: the process that read it was ended\n"
        r"tuesday_flight .* not usable: ", done.stdout, re.MULTILINE,
    )  # fmt: skip


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupt_ends_every_process(number: signal.Signals, tmp_path: Path) -> None:
    command = [*REPLAY, *[str(BAGS / "multisine")] * 3, "--jobs", "2", "--output", str(tmp_path)]
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    # the processes are starting or running
    assert wait_for(lambda: len(children(process.pid)) >= 2)
    # a terminal sends Ctrl-C to the whole group, `kill` and the end of a session to one process
    (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
    output, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert "bags:" not in output
    assert "Traceback" not in errors
    assert wait_for(lambda: gone(process.pid))


def children(pid: int) -> list[str]:
    """Return the child processes of all threads of a process."""
    lists = Path(f"/proc/{pid}/task").glob("*/children")
    return [child for tasks in lists for child in tasks.read_text().split()]


def gone(group: int) -> bool:
    """Return whether a group of processes has ended."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


def test_an_empty_folder_and_a_pipe_are_refused_without_stopping_others(
    logs: Path, tmp_path: Path, capsys: Capture
) -> None:
    (tmp_path / "empty").mkdir()
    assert main([str(tmp_path / "empty")]) == NO_RESULT
    words = r"replay: folder '.*empty' has no bags: neither rosbag2 folders nor \.mcap"
    assert re.match(words, capsys.readouterr().err)
    os.mkfifo(tmp_path / "pipe.mcap")
    bags = [tmp_path / "empty", tmp_path / "pipe.mcap", logs / "tuesday" / "flight"]
    output = ["--output", str(tmp_path / "out"), "--jobs", "1"]
    assert main([*map(str, bags), *output]) == NO_RESULT
    captured = capsys.readouterr()
    assert "replay: empty: bag " in captured.err
    assert "pipe.mcap' is neither a file on a disk nor a folder" in captured.err
    assert "3 bags: 1 not usable, 2 no result" in captured.out


# --- the table of flights ----------------------------------------------------------------------


def contents(output: Path) -> tuple[str, ...]:
    return tuple(sorted((output / "flights.csv").read_text().splitlines()))


def test_the_table_has_a_row_for_each_flight_and_coefficient(
    logs: Path, replayed: tuple[Path, Any]
) -> None:
    output, _ = replayed
    rows = read_flights(output)
    assert read_flights(output / "flights.parquet") == rows
    flights = {(row.aircraft, row.flight) for row in rows}
    assert flights == {
        ("monday", "monday_flight"), ("tuesday", "tuesday_flight"), ("tuesday", "later"),
        (logs.name, "broken"),
    }  # fmt: skip
    (failed,) = [row for row in rows if row.flight == "broken"]
    assert (failed.verdict, failed.coefficient, failed.value) == ("no result", "", None)
    assert "is no MCAP file" in failed.reason
    one = [row for row in rows if row.flight == "later"]
    content = summary(output / "later")
    assert {row.coefficient: row.value for row in one} == {
        name: entry["value"] for name, entry in content["coefficients"].items()
    }
    assert one[0].start_ns == content["first_tick_ns"]
    assert one[0].fit_q == content["prediction_fit"]["last_40_percent"]["model"]["q"]
    assert len({row.bag_hash for row in rows}) == 4
    assert len({row.settings_hash for row in rows}) == 1


def test_finished_replays_are_not_repeated_unless_settings_differ(
    logs: Path, warm: Path, replayed: tuple[Path, Any], tmp_path: Path, capsys: Capture
) -> None:
    output = tmp_path / "out"
    again = arguments(logs, warm, output, "--jobs", "1")
    shutil.copytree(replayed[0], output)
    times = {file: file.stat().st_mtime_ns for file in output.rglob("estimates.mcap")}
    # one result file is truncated, another missing
    (output / "later" / DONE_FILE).unlink()
    cut = output / "tuesday_flight" / DONE_FILE
    cut.write_text(cut.read_text()[:40])
    assert main(again) == 2
    assert re.search(
        r"4 bags: .*1 no result; 2 of them as replayed before", capsys.readouterr().out
    )
    for file, before in times.items():
        done_again = file.stat().st_mtime_ns != before
        assert done_again == bool({"later", "tuesday_flight"} & set(file.parts)), file
    assert contents(output) == contents(replayed[0])
    # other settings need a new replay
    other = tmp_path / "other.yaml"
    other.write_text(warm.read_text() + "    filter.cutoff: 20.0\n")
    assert main([*again, "--params-file", str(other)]) == 2
    assert "as replayed before" not in capsys.readouterr().out
    # the new result does not count as the first one
    assert main(again) == 2
    assert "as replayed before" not in capsys.readouterr().out


def test_a_cluster_gives_the_same_table(
    logs: Path, warm: Path, replayed: tuple[Path, Any], tmp_path: Path
) -> None:
    """One worker of a Dask cluster is killed: another worker repeats its flights."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        command = arguments(logs, warm, tmp_path, "--scheduler", cluster.scheduler_address)
        process = subprocess.Popen([*REPLAY, *command], cwd=ROOT)
        with distributed.Client(cluster) as client:
            busy: set[str] = set()
            while process.poll() is None and not busy:
                busy = {address for address, tasks in client.processing().items() if tasks}
                time.sleep(0.02)
        workers = [w for w in cluster.workers.values() if w.worker_address in busy and w.process]
        for worker in workers[:1]:
            os.kill(worker.process.pid, signal.SIGKILL)
        assert process.wait(300.0) == 2
    assert contents(tmp_path) == contents(replayed[0])


# --- many configurations -----------------------------------------------------------------------


def test_configurations_are_ranked_on_one_bag(
    logs: Path, warm: Path, tmp_path: Path, capsys: Capture
) -> None:
    good = parameter_file(tmp_path / "good.yaml", estimator="least_squares")
    late = parameter_file(tmp_path / "late.yaml", actuators__delay=0.15)
    compared = ("--compare", str(late), str(good))
    assert replay(logs / "monday" / "flight", tmp_path / "out", *compared, by=warm) == USABLE
    printed = capsys.readouterr().out
    assert printed.startswith("flight: 2 configurations, by their 1-second prediction fit")
    first, second, holding = (line for line in printed.splitlines() if re.match(r" +[12h]", line))
    assert re.match(r" 1 good +\d\d\.\d +\d\d\.\d +\d\d\.\d +\d\d\.\d +0\.000  usable", first)
    assert re.match(r" 2 late +.* 0\.150  ", second)
    assert holding.strip().startswith("holding the rates")
    # each extends the parameter file, and has a separate folder
    for name, estimator in (("good", "least_squares"), ("late", "instrumental_variable")):
        settings = summary(tmp_path / "out" / name)["settings"]
        assert settings["estimator"] == estimator
        assert settings["actuators.type"] == "sensor_msgs/msg/JointState"


def test_a_refused_configuration_is_no_result(logs: Path, tmp_path: Path, capsys: Capture) -> None:
    wrong = parameter_file(tmp_path / "wrong.yaml", update_rate=20)
    compared = ("--compare", str(wrong), str(PARAMETERS))
    assert replay(logs / "tuesday" / "flight", tmp_path / "out", *compared) == NO_RESULT
    captured = capsys.readouterr()
    assert re.search(r"^replay: wrong: .*'update_rate' is 20", captured.err)
    assert re.search(r"^ 1 identifier .* not usable", captured.out, re.MULTILINE)
    assert re.search(r"^ 2 wrong( +-){5}  no result: ", captured.out, re.MULTILINE)


def outcome(name: str, status: int, model: tuple[float | None, ...]) -> Outcome:
    fit = {
        "model": dict(zip("pqr", model, strict=True)),
        "hold": {"p": -20.0, "q": None, "r": -10.0},
    }
    content = {"prediction_fit": {"last_40_percent": fit}, "doubt": "why", "delay": 0.0}
    return Outcome(Job(Path(name), name, Path(name)), status, summary=content)


def test_ranking_has_usable_ones_first_and_limits_the_weight_of_a_bad_axis() -> None:
    usable = outcome("usable", USABLE, (40.0, 40.0, 40.0))
    better = outcome("better", NOT_USABLE, (90.0, 90.0, -1e5))
    worse = outcome("worse", NOT_USABLE, (20.0, 20.0, -1e9))
    silent = outcome("silent", NOT_USABLE, (None, None, None))
    failed = Outcome(Job(Path("x"), "failed", Path("x")), NO_RESULT, ("line one\n  line two",))
    assert mean_fit(better) == pytest.approx((180.0 + WORST_FIT) / 3.0)
    assert mean_fit(silent) == mean_fit(failed) == WORST_FIT
    everything = [failed, silent, worse, better, usable]
    assert [o.job.name for o in ranked(everything)] == [
        "usable", "better", "worse", "silent", "failed"
    ]  # fmt: skip
    table = ranking("flight", everything)
    assert "<-1000" in table
    assert "line one" in table
    assert "line two" not in table
    assert overview(everything).endswith("5 bags: 1 usable, 3 not usable, 1 no result")
    assert [str(percent(value)) for value in (1.04, None, -1000.0)] == ["1.0", "-", "<-1000"]


# --- options -----------------------------------------------------------------------------------


def test_help_is_printed_without_importing_numpy_or_rosbags() -> None:
    script = (
        "import sys\nfrom uav_ident_ros.offline import main\n"
        "try: main(['--help'])\nexcept SystemExit: print(sorted(sys.modules))"
    )
    shown_text = python("-c", script)
    assert shown_text.stdout.startswith("usage: replay")
    assert "'numpy'" not in shown_text.stdout and "'rosbags'" not in shown_text.stdout


def test_an_internal_error_is_the_status_of_no_result(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    def broken(*arguments: object, **options: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("uav_ident_ros.offline.job.write_results", broken)
    arguments = [str(logs / "tuesday" / "flight"), "--output", str(tmp_path)]
    assert main(arguments) == NO_RESULT  # not 1, the status of a model that is not usable
    assert "ZeroDivisionError" in capsys.readouterr().err
    with pytest.raises(ZeroDivisionError):
        job.replay(Job(logs / "tuesday" / "flight", "x", tmp_path))


def test_a_closed_pipe_does_not_change_the_status(logs: Path, tmp_path: Path) -> None:
    bag = logs / "tuesday" / "flight"
    command = [*REPLAY, str(bag), "--output", str(tmp_path)]
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, cwd=ROOT, check=False)
    os.close(writer)
    assert done.returncode == NOT_USABLE
    assert b"Traceback" not in done.stderr


# --- progress ----------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2])
def test_one_bag_and_many_have_one_progress_bar(count: int, tmp_path: Path) -> None:
    bags = [str(excerpt(tmp_path / "bag", 20.0))] * count  # Some draws of the bar, 0.1 s apart
    command = [*REPLAY, *bags, "--output", str(tmp_path / "out"), "--jobs", "1"]
    nowhere = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL}
    with closing(Terminal(command, 100, **nowhere)) as terminal:  # for the error stream alone
        terminal.read_until("to the end of what is shown", math.inf)
        shown = terminal.received
        assert terminal.process.wait() in (USABLE, NOT_USABLE), shown
    shares = [int(share) for share in re.findall(r"(\d+)%", shown)]
    assert shares == sorted(shares)
    assert shares[0] == 0 and shares[-1] >= 50
    assert (" messages" in shown, " replays" in shown) == (count == 1, count > 1)


def test_progress_without_a_terminal_has_few_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    now = itertools.count(0.0, 10.0)  # each call of the clock advances ten seconds
    monkeypatch.setattr("tqdm.std.time", lambda: next(now))
    assert list(Bar(range(8))) == list(range(8))
    shares = [int(share) for share in re.findall(r"(\d+)%", capsys.readouterr().err)]
    assert shares == sorted(shares)
    assert 2 <= len(shares) < 8


def test_a_package_that_does_not_fit_another_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: str) -> None:
        raise ImportError("numpy.core.multiarray failed to import")

    monkeypatch.setattr(job, "import_module", broken)
    with pytest.raises(BagError, match=r"'report' cannot be imported: numpy\.core\.multi"):
        job.optional("report")
