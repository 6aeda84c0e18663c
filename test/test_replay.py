# SPDX-License-Identifier: Apache-2.0
"""`replay`: the core's estimates, the files of the contract, and one-line refusals."""

import itertools
import math
import os
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from excerpts import (
    ACTUATORS,
    BAGS,
    IMU,
    SECOND_NS,
    START_NS,
    Entry,
    decoded,
    excerpt,
    parameter_file,
    parameters,
    replay,
    summary,
    written,
)
from mcap.reader import make_reader
from programs import Capture, python, refusal
from rosbags.highlevel import AnyReader

from uav_ident_ros.bags import writing
from uav_ident_ros.bags.reading import Bag, BagError
from uav_ident_ros.client import Coefficients
from uav_ident_ros.commandline import NOT_USABLE
from uav_ident_ros.files.coefficients_file import load_coefficients
from uav_ident_ros.identification.estimate import Estimate
from uav_ident_ros.identification.identifier import OnlineIdentifier
from uav_ident_ros.identification.settings import Settings
from uav_ident_ros.identification.structure import STRUCTURES
from uav_ident_ros.messages.published import entry_names
from uav_ident_ros.messages.types import header_ns
from uav_ident_ros.offline import main
from uav_ident_ros.offline.inputs import choose_inputs
from uav_ident_ros.offline.job import Job, reserved
from uav_ident_ros.offline.parallel import work
from uav_ident_ros.offline.run import OfflineRun, run_over
from uav_ident_ros.offline.tables import duration_of, told, write_table

RESULTS = ["coefficients.yaml", "estimates", "summary.json", "table.txt"]
IMU_TYPE, NUMBER, FLAG = "sensor_msgs/msg/Imu", "std_msgs/msg/Float64", "std_msgs/msg/Bool"
ARRAY, JOINTS = writing.ARRAY, writing.JOINT_STATE
AIRSPEED = "/airspeed"


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the results of a replay of the first part of a committed bag."""
    folder = tmp_path_factory.mktemp("replayed")
    assert replay(excerpt(folder / "multisine", 34.0), folder / "results", "--plot") == 0
    return folder / "results"


def run_core(bag: Path, values: dict[str, Any]) -> tuple[OnlineIdentifier, list[Estimate]]:
    """Run the core over a bag with another bag reader; return it and its estimates."""
    identifier = OnlineIdentifier(Settings.from_values(values))
    estimates = []
    with AnyReader([bag]) as reader:
        for connection, log_ns, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            stamp_ns = header_ns(message) if hasattr(message, "header") else log_ns
            if connection.topic == IMU:
                w, a = message.angular_velocity, message.linear_acceleration
                identifier.add_rates(stamp_ns, (w.x, w.y, w.z), (a.x, a.y, a.z))
            elif connection.topic == AIRSPEED:
                identifier.add_airspeed(stamp_ns, message.data)
            else:
                values = message.position if hasattr(message, "position") else message.data
                identifier.add_actuators(stamp_ns, tuple(values))
            estimates += identifier.advance()
    return identifier, estimates


def published(output: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return log times and messages of a bag of estimates, by topic."""
    found = decoded(output / "estimates")
    return {topic.removeprefix("/identifier/"): entries for topic, entries in found.items()}


def with_airspeed() -> Any:
    """Return a change of an excerpt: an airspeed at every 10th sample, every 50th of them NaN."""
    count = itertools.count()

    def change(name: str, log_ns: int, message: Any) -> list[Entry]:
        entries = [(name, log_ns, message)]
        k = next(count) if name == IMU else -1
        if k < 0 or k % 10:
            return entries
        speed = math.nan if k % 500 == 0 else 20.0 + 5.0 * math.sin(0.002 * k)
        return [*entries, (AIRSPEED, log_ns, writing.plain(NUMBER, speed))]

    return change


@pytest.mark.parametrize(
    ("name", "rows", "airspeed"),
    [
        ("pulses", "pdot,qdot,rdot", ""),  # actuators without a stamp have their log time
        ("c172p", "pdot,qdot,rdot,ay,az", ""),
        ("multisine", "pdot,qdot,rdot", NUMBER),
    ],
)
def test_estimates_are_those_of_the_core_to_the_bit(
    name: str, rows: str, airspeed: str, tmp_path: Path, capsys: Capture
) -> None:
    """The default structure adds flow angles, attitude and two rows."""
    change = with_airspeed() if airspeed else None
    bag, output = excerpt(tmp_path / "bag", 4.0, name, change), tmp_path / "out"
    values = parameters(name, airspeed__type=airspeed, airspeed__reference=20.0)
    replay(bag, output, by=parameter_file(tmp_path / "p.yaml", **values))
    identifier, estimates = run_core(bag, values)
    structure, found = identifier.structure, published(output)
    assert {topic: entries[0][1].__msgtype__ for topic, entries in found.items()} == {
        "coefficients": "std_msgs/msg/Float64MultiArray",
        "coefficients_named": "sensor_msgs/msg/JointState",
        "predicted_rates": "geometry_msgs/msg/Vector3Stamped",
        "prediction_error": "geometry_msgs/msg/Vector3Stamped",
    }
    assert {len(messages) for messages in found.values()} == {len(estimates)}
    assert len(estimates) > 70
    for k, estimate in enumerate(estimates):
        at = {topic: messages[k][1] for topic, messages in found.items()}
        assert {messages[k][0] for messages in found.values()} == {estimate.t_ns}
        for topic in found.keys() - {"coefficients"}:
            assert header_ns(at[topic]) == estimate.t_ns
        shown = estimate.coefficients[: rows.count(",") + 1]
        assert at["coefficients"].data.tobytes() == shown.tobytes()
        assert at["coefficients_named"].name == list(entry_names(structure))
        read = Coefficients.from_message(at["coefficients_named"])
        assert read.values.tobytes() == estimate.coefficients.tobytes()
        assert read.sigma.tobytes() == estimate.sigma.tobytes()
        assert (read.usable, read.usable_rows) == (estimate.usable, estimate.usable_rows)
        assert read.fit.tolist() == estimate.fit.tolist()
        assert read.flow == estimate.flow
        assert not any(at["coefficients_named"].effort[-7:])  # sigmas of fits and verdicts are zero
        for topic in ("predicted_rates", "prediction_error"):
            vector = at[topic].vector
            assert [vector.x, vector.y, vector.z] == getattr(estimate, topic).tolist()
    labels = [d.label for d in at["coefficients"].layout.dim]
    assert labels == [rows, ",".join(structure.regressors)]
    assert at["predicted_rates"].header.frame_id == summary(output)["frame_id"]
    assert (estimate.flow is not None) == (name == "c172p")
    saved = load_coefficients(output / "coefficients.yaml")
    wanted = identifier.coefficient_set(estimates[-1].t_ns)
    assert saved.values.tobytes() == wanted.values.tobytes()
    assert saved.sigma.tobytes() == wanted.sigma.tobytes()
    if airspeed:
        assert np.abs(saved.values - estimates[-1].coefficients).max() > 1.0  # at another speed
        assert summary(output)["inputs"]["airspeed"] == {
            "topic": AIRSPEED, "type": airspeed, "received": 81, "dropped": {"not finite": 2}
        }  # fmt: skip
        printed = capsys.readouterr().out
        assert f"airspeed: /airspeed ({airspeed}), 81 messages, 2 not finite" in printed
        assert "coefficients at the reference airspeed, 20 m/s" in printed


def test_mcap_reader_finds_schemas_stamps_and_qos(replayed: Path) -> None:
    times: dict[str, list[int]] = {}
    with (replayed / "estimates" / "estimates.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        content = reader.get_summary()
        for schema, channel, message in reader.iter_messages():
            assert schema.encoding == "ros2msg" and schema.data and message.data
            assert message.publish_time == message.log_time
            times.setdefault(channel.topic, []).append(message.log_time)
    assert {c.message_encoding for c in content.channels.values()} == {"cdr"}
    for channel in content.channels.values():
        (profile,) = yaml.safe_load(channel.metadata["offered_qos_profiles"])
        assert profile["depth"] == (1 if "coefficients" in channel.topic else 10)
    (ticks,) = {tuple(log_ns) for log_ns in times.values()}
    assert set(np.diff(ticks)) == {SECOND_NS // 20}


def test_summary_and_coefficients_file_agree_with_the_truth(replayed: Path) -> None:
    content = summary(replayed)
    truth = yaml.safe_load((BAGS / "multisine" / "truth.yaml").read_text())["coefficients"]
    for name in ("pdot/p", "pdot/da", "qdot/q", "qdot/de", "rdot/r", "rdot/dr"):
        assert content["coefficients"][name]["value"] == pytest.approx(truth[name], rel=0.05)
    for windows in ("last_40_percent", "after_30_s"):
        fit = content["prediction_fit"][windows]
        assert fit["windows"] * 200 == fit["samples"]
        for axis in "pqr":
            assert fit["model"][axis] > 85.0
            assert fit["hold"][axis] < 0.0
    assert content["inputs"]["rates"]["received"] == 6801
    assert content["inputs"]["actuators"]["dropped"] == {}
    saved = load_coefficients(replayed / "coefficients.yaml", "augmented")
    assert saved.t_ns == content["last_tick_ns"]
    index = STRUCTURES["augmented"].index("pdot/da")
    assert saved.values[index] == content["coefficients"]["pdot/da"]["value"]
    picture = (replayed / "replay.png").read_bytes()
    assert picture.startswith(b"\x89PNG") and len(picture) > 20_000


def test_the_usable_share_is_printed_if_the_end_is_not_usable(replayed: Path) -> None:
    """Excited in turn, one surface is always unconfirmed at the last tick."""
    content = summary(replayed)
    rows = {"pdot": [], "qdot": [], "rdot": []}
    for _, message in published(replayed)["coefficients_named"]:
        values = dict(zip(message.name, message.position, strict=True))
        for row, flags in rows.items():
            flags.append(values[f"verdict/usable/{row}"])
    assert content["usable_share"] == {row: np.mean(flags) for row, flags in rows.items()}
    assert 0.0 < content["usable_share"]["pdot"] < 1.0
    assert "in the course" not in write_table(content)
    given = "usable in the course of the flight: pdot 44 %, qdot 0 %, rdot 3 % of the ticks"
    shares = {"pdot": 0.44, "qdot": 0.0, "rdot": 0.03}
    assert given in write_table(content | {"doubt": "still", "usable_share": shares})
    never = content | {"doubt": "still", "usable_share": dict.fromkeys(rows, 0.0)}
    assert "in the course" not in write_table(never)


def test_the_reason_of_the_verdict_is_printed_once_with_its_cure(replayed: Path) -> None:
    doubt, cure, other = "the delay is off by 60 ms", ", or estimate it", "the flight is short"
    advice = [{"name": "", "text": text} for text in (other, f"{doubt}{cure}")]
    content = summary(replayed) | {"state": "fault", "reason": doubt, "doubt": doubt}
    printed = write_table(content | {"advice": advice})
    assert "\nstate at the end: fault\n" in printed
    lines = " ".join(printed.split())
    assert lines.count(doubt) == 1
    assert f"): {doubt}{cure} " in lines
    assert lines.endswith(f"advice: {other}")
    both = content | {"doubt": f"qdot is weak; {doubt}; rdot is weak", "advice": advice}
    assert told(both) == (f"qdot is weak; {doubt}{cure}; rdot is weak", [other])
    later = write_table(content | {"advice": advice, "state": "paused", "reason": "not armed"})
    assert "\nstate at the end: paused (not armed)\n" in later


def test_printed_results(tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """The table has the fits; an unidentifiable delay has no sigma."""
    monkeypatch.chdir(tmp_path)
    short = excerpt(tmp_path / "short", 5.0, "pulses")
    given = parameter_file(
        tmp_path / "told.yaml", actuators__delay=0.03, actuators__estimate_delay=True
    )
    assert main([str(short), "--params-file", str(given)]) == NOT_USABLE
    printed = capsys.readouterr().out
    assert re.search(r"^coefficient +value +sigma +t-ratio  meaning$", printed, re.MULTILINE)
    assert "pdot/da " in printed
    assert "holding the rates" in printed
    assert "After 30 s, no window to score" in printed
    assert "\ndelay of the inputs: 0.030 s in use; none was found for sure\n" in printed
    assert sorted(os.listdir("replay_short")) == RESULTS
    assert summary(Path("replay_short"))["delay_confidence"] != "sure"


def test_parameters_beside_a_bag_are_named_if_none_are_given(
    tmp_path: Path, capsys: Capture
) -> None:
    short, output = excerpt(tmp_path / "my flight", 2.0, begin=4.0), str(tmp_path / "out")
    beside = parameter_file(short / "identifier.yaml", **parameters("multisine"))
    for bag in (short, next(short.glob("*.mcap"))):
        assert main([str(bag), "--output", output]) == NOT_USABLE
        assert f"{beside} was not read: give it as --params-file" in summary(Path(output))["notes"]
    beside.write_text(beside.read_text() + "    update_rate: 10.0\n    update_rate: 20.0\n")
    assert main([str(short), "--output", output, "--params-file", str(beside)]) == NOT_USABLE
    content = summary(Path(output))
    assert content["notes"] == []
    assert content["doubt"] == "1 s of learning, 30 s are needed for a verdict"
    warned = capsys.readouterr().err
    assert "gives 'update_rate' more than once in section '/**': 20.0, the last" in warned


def test_of_several_parameter_files_the_last_counts(tmp_path: Path) -> None:
    """As with the node, each file needs only its changes."""
    first = parameter_file(tmp_path / "a.yaml", **parameters("multisine", update_rate=10.0))
    second = parameter_file(tmp_path / "b.yaml", update_rate=25.0)
    replay(excerpt(tmp_path / "bag", 2.0), tmp_path, "--params-file", str(second), by=first)
    settings = summary(tmp_path)["settings"]
    assert (settings["update_rate"], settings["structure"]) == (25.0, "augmented")


OWN = {IMU: IMU_TYPE, ACTUATORS: ARRAY}
USUAL = {"rates": IMU, "actuators": ACTUATORS}
ASKED = "/identifier/excitation"
CHOICES: list[tuple[dict[str, str], dict[str, str], dict[str, str], dict[str, str]]] = [
    # topics and types of a bag, parameters, requested topics, topics read
    ({"/plane/imu": IMU_TYPE, "/plane/servos": ARRAY}, {}, {},
     {"rates": "/plane/imu", "actuators": "/plane/servos"}),
    ({"/imu_a": IMU_TYPE, "/imu_b": IMU_TYPE, ACTUATORS: ARRAY}, {}, {"rates": "/imu_b"},
     USUAL | {"rates": "/imu_b"}),
    (OWN | {"/pitot": NUMBER}, {"airspeed.type": ""}, {}, USUAL),
    (OWN | {"/pitot": NUMBER}, {"airspeed.type": NUMBER}, {}, USUAL | {"airspeed": "/pitot"}),
    # the option suffices: the topic has a type
    (OWN | {"/pitot": NUMBER}, {"airspeed.type": ""}, {"airspeed": "/pitot"},
     USUAL | {"airspeed": "/pitot"}),
    (OWN | {"/pitot_a": NUMBER, "/silent": NUMBER}, {"airspeed.type": NUMBER}, {},
     USUAL | {"airspeed": "/pitot_a"}),
    (OWN | {"/armed": FLAG}, {}, {}, USUAL),
    (OWN | {"/armed": FLAG}, {"armed.type": FLAG}, {}, USUAL | {"armed": "/armed"}),
    (OWN | {ASKED: JOINTS}, {}, {}, USUAL | {"excitation": ASKED}),
    (OWN | {ASKED: JOINTS, "/excitation": JOINTS}, {}, {}, USUAL | {"excitation": "/excitation"}),
    (OWN | {"/a/excitation": JOINTS, "/b/excitation": JOINTS}, {}, {}, USUAL),
]  # fmt: skip


@pytest.mark.parametrize(("topics", "values", "requested", "read"), CHOICES)
def test_topics_are_chosen_by_name_type_and_option(
    tmp_path: Path, topics: Any, values: Any, requested: Any, read: Any
) -> None:
    # a message on each topic but a silent one
    messages = [(topic, SECOND_NS, b"") for topic in topics if topic != "/silent"]
    with Bag(written(tmp_path / "bag", topics, messages)) as bag:
        inputs = choose_inputs(bag, values, requested)
    assert inputs.streams == read
    assert inputs.settings.actuators.type == ARRAY
    assert (inputs.settings.airspeed.type == NUMBER) == ("airspeed" in read)


def test_ambiguous_topics_are_listed(tmp_path: Path) -> None:
    def doubled(topic: str, log_ns: int, message: Any) -> list[Entry] | None:
        both = [("/imu_a", log_ns, message), ("/imu_b", log_ns, message)]
        return both if topic == IMU else None

    bag = excerpt(tmp_path / "doubled", 1.0, "pulses", doubled)
    with Bag(bag) as opened, pytest.raises(BagError) as caught:
        choose_inputs(opened, {})
    words, *listed = str(caught.value).splitlines()
    assert words.endswith("but 2 that could be it: choose one with --topic imu/data:=/imu_a")
    found = "(sensor_msgs/msg/Imu), 201 messages, 201 Hz"
    assert listed == [f"  /imu_a {found}", f"  /imu_b {found}"]


def test_a_contradicting_frame_is_a_fault(tmp_path: Path, capsys: Capture) -> None:
    def reframed(topic: str, log_ns: int, message: Any) -> None:
        if topic == IMU:
            message.header.frame_id = "map_ned"

    bag = excerpt(tmp_path / "bag", 1.0, "pulses", reframed)
    assert main([str(bag), "--output", str(tmp_path / "out")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("replay: fault: the Imu's frame_id 'map_ned' contradicts")
    assert "no tick came due: of 201 messages on '/imu/data' were dropped: 201 wrong" in lines[1]
    assert len(lines) == 2


@pytest.mark.parametrize("jump", [500, -500])
def test_no_window_spans_a_jump_of_the_time_base(jump: int, warm: Path, tmp_path: Path) -> None:
    half_ns = START_NS + 8 * SECOND_NS

    def jumping(topic: str, log_ns: int, message: Any) -> list[Entry]:
        if log_ns > half_ns:
            message.header.stamp.sec += jump
            log_ns += max(jump, 0) * SECOND_NS
        return [(topic, log_ns, message)]

    path = excerpt(tmp_path / "bag", 11.0, "multisine", jumping)
    run = run_over(path, parameters(), load_coefficients(warm.with_name("start.yaml")))
    assert len(run.restarts) == 1
    # the last 40 % begin 1.4 s before the jump; each of both parts lacks its last second
    fit = run.score()["last_40_percent"]
    assert 2.2 * 20 <= fit.windows <= 2.5 * 20
    assert (fit.model > 80.0).all()
    assert run.score()["after_30_s"].windows == 0
    content = {"ticks": len(run.estimates), "settings": {"update_rate": 20.0}}
    assert duration_of(content) == pytest.approx(11.0, abs=0.2)


@pytest.mark.parametrize("name", ["c172p", "multisine"])
def test_the_score_in_pieces_equals_that_of_the_whole(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = run_over(excerpt(tmp_path / "bag", 5.0, name), parameters(name))
    index = run.structure.free[-1]
    assert run.estimates.history(index)[1].tolist() == [e.sigma[index] for e in run.estimates]
    whole = run.score()
    monkeypatch.setattr("uav_ident_ros.offline.run.PIECE", 21)
    for selection, fit in run.score().items():
        np.testing.assert_allclose(fit.free, whole[selection].free, rtol=1e-9)
        np.testing.assert_allclose(fit.measured_force, whole[selection].measured_force, rtol=1e-9)
        assert (fit.windows, fit.samples) == (whole[selection].windows, whole[selection].samples)


BAD_INPUT = [
    # arguments after the bag, a line of the parameter file, the error
    ("--topic imu/data:=gyro", "", "has no topic '/gyro'; it has /actuators"),
    ("--topic actuators:=/x", "", "has no topic '/x'"),
    ("--topic airspeed:=/x", "", "has no topic '/x'"),
    ("--topic /a", "", "'/a' is not NAME:=TOPIC with a NAME among imu/data, actuators"),
    ("--topic gyro:=/a", "", "'gyro:=/a' is not NAME:=TOPIC"),
    ("--topic armed:=", "", "'armed:=' is not NAME:=TOPIC"),
    (f"--topic airspeed:={IMU}", "",
     "'/imu/data' is of type sensor_msgs/msg/Imu, but 'airspeed' may be std_msgs/msg/Float64,"),
    (f"--topic airspeed:={IMU}", f"airspeed.type: {NUMBER}", f", but 'airspeed.type' is '{NUMBER}"),
    ("", "airspeed.type: std_msgs/msg/Float64",
     "nor one of type std_msgs/msg/Float64; it has /actuators .* leave 'airspeed.type' empty"),
    ("", "imu: flu", "there are imu.type, imu.convention, imu.rpy, imu.lever_arm"),
    ("--params-file none.yaml", "", "'none.yaml': there is no such file"),
    ("", "a: [1", "parameter file 'params.yaml': line"),
    ("", "update_rat: 20.0", "did you mean 'update_rate'"),
    ("", "update_rate: 20", "'update_rate' is 20: .*20.0"),
    ("", "initial_coefficients_file: none.yaml", "file 'none.yaml': there is no such file"),
    ("", "actuators.field: x", "'actuators.field' is 'x'"),
    ("", "imu.type: sensor_msgs/Imu",
     "allowed are sensor_msgs/msg/Imu, .*; did you mean 'sensor_msgs/msg/Imu'"),
    ("--node /b --params-file other.yaml", "", "nothing for node '/b'"),
    ("--output text.txt", "", "cannot write into 'text.txt': Not a directory"),
    ("--output text.txt/results", "", "cannot write into 'text.txt/results': Not a directory"),
    ("''", "", "argument BAG: the path is empty"),
    ("--output kept", "", "'kept/estimates' exists and is no bag: it is left alone"),
    ("--nonsense", "", "unrecognized arguments: --nonsense"),
    ("--jobs 0", "", "'0' is not a number from 1 on"),
    ("--jobs many", "", "'many' is not a number from 1 on"),
    ("nowhere --compare text.txt", "", "--compare takes one bag"),
    ("nowhere --scheduler nonsense://x", "", "no Dask scheduler answers at 'nonsense://x'"),
]  # fmt: skip


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of one second of flight."""
    return excerpt(tmp_path_factory.mktemp("short") / "bag", 1.0, "pulses")


@pytest.mark.parametrize(("options", "line", "words"), BAD_INPUT)
def test_bad_input_is_refused_in_one_line_with_status_2(
    options: str,
    line: str,
    words: str,
    short: Path,
    tmp_path: Path,
    capsys: Capture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("text.txt").write_text("hello")
    Path("other.yaml").write_text("/a:\n  ros__parameters:\n    update_rate: 20.0\n")
    kept = Path("kept/estimates")
    kept.mkdir(parents=True)
    for name in ("estimates.mcap", "notes.txt"):
        (kept / name).touch()
    monkeypatch.setattr(OfflineRun, "score", None)  # every refusal comes before the work is done
    given = [str(short), *shlex.split(options)]
    if line:
        Path("params.yaml").write_text(f"/**:\n  ros__parameters:\n    {line}\n")
        given += ["--params-file", "params.yaml"]
    printed = refusal(main, given, capsys)
    assert printed.startswith("replay: ")
    assert re.search(words, printed), printed
    assert not Path("replay_bag").exists()
    assert sorted(os.listdir(kept)) == ["estimates.mcap", "notes.txt"]


def test_a_second_replay_into_a_folder_is_refused(
    short: Path, tmp_path: Path, capsys: Capture
) -> None:
    output = tmp_path / "out"
    given = [str(short), "--output", str(output)]
    words = f"another replay writes into '{output}': wait for its end, or choose another --output"
    with reserved(output):
        for arguments in (given, [str(short), *given], [*given, "--compare", "text.txt"]):
            assert refusal(main, arguments, capsys) == f"replay: {words}"
        assert work(Job(short, "bag", output)).warnings == (words,)
        assert not os.listdir(output)
    assert not output.exists()
    assert main(given) == NOT_USABLE


def test_without_actuators_there_is_a_table_but_no_score(tmp_path: Path, capsys: Capture) -> None:
    def late(topic: str, log_ns: int, message: Any) -> list[Entry]:
        # Actuators stamped by another clock are a fault, and unused.
        return [(topic, log_ns + (100 * SECOND_NS if topic == ACTUATORS else 0), message)]

    def other_clock(topic: str, log_ns: int, message: Any) -> None:
        if topic == ACTUATORS:
            message.header.stamp.sec -= 1000

    for name, change in (("pulses", late), ("multisine", other_clock)):
        bag = excerpt(tmp_path / name, 5.0, name, change)
        output = tmp_path / f"{name}_out"
        assert replay(bag, output, by=name) == NOT_USABLE
        fit = summary(output)["prediction_fit"]["last_40_percent"]
        assert fit["windows"] == 0
        assert fit["model"] == {"p": None, "q": None, "r": None}
        assert "no window to score" in capsys.readouterr().out
    assert summary(output)["inputs"]["actuators"]["dropped"].keys() == {"stamp far from the Imu's"}
    assert "different clocks" in summary(output)["fault"]


def test_the_estimated_delay_is_used_and_scored(tmp_path: Path) -> None:
    def delayed(topic: str, log_ns: int, message: Any) -> None:
        if topic == ACTUATORS:  # commands stamped 60 ms before they act
            early = message.header.stamp.sec * SECOND_NS + message.header.stamp.nanosec - 60_000_000
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(early, SECOND_NS)

    bag = excerpt(tmp_path / "bag", 41.0, "multisine", delayed)
    run = run_over(bag, parameters(actuators__estimate_delay=True))
    assert run.identifier.delay == pytest.approx(0.06, abs=0.015)
    fit = run.score()["last_40_percent"]
    assert (fit.model > 80.0).all()
    first_ns, last_ns = run.estimates[0].t_ns, run.estimates[-1].t_ns
    assert fit.windows == pytest.approx(20 * (0.4e-9 * (last_ns - first_ns) - 1.0), abs=2)


def test_excitation_messages_of_unknown_inputs_are_dropped(tmp_path: Path) -> None:
    def change(topic: str, log_ns: int, message: Any) -> list[Entry]:
        word = writing.joint_state(header_ns(message), ["flap"], [0.1])
        return [(topic, log_ns, message), ("/excitation", log_ns, word)]

    refusals = run_over(excerpt(tmp_path / "bag", 0.5, change=change), {}).refusals("excitation")
    assert refusals.dropped == {"wrong channels": refusals.received} and refusals.received > 50


@pytest.mark.parametrize(
    ("command", "package", "cure"),
    [
        ("replay bag bag", "rosbags", "apt does not have it"),
        ("replay bag bag", "mcap", "apt does not have it"),
        ("replay bag bag", "pyarrow", "pip install pyarrow"),
        ("import_log log", "rosbags", "apt does not have it"),
        ("simulate --output nowhere", "rosbags", "apt does not have it"),
        ("monitor", "rich", "install python3-rich from apt"),
    ],
)
def test_the_error_names_the_missing_package(command: str, package: str, cure: str) -> None:
    """This is the case of an installation from apt alone."""
    name, *given = command.split()
    code = (
        f"import sys; sys.modules['{package}'] = None\n"
        f"from uav_ident_ros.commandline import {name}; sys.exit({name}({given}))"
    )
    run = python("-c", code)
    assert run.returncode == 2
    assert run.stderr.startswith(f"{name}: the Python package '{package}' is missing: {cure}")
    assert run.stderr.count("\n") == 1
