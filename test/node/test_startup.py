# SPDX-License-Identifier: Apache-2.0
"""Start and stop: wrong parameters are refused in one line, signals end the node cleanly."""

import json
import signal
from pathlib import Path

from programs import PATIENCE, StartNode, handled, python, wait_for

from uav_ident_ros.identification.settings import declarations

FILE = "/**:\n  ros__parameters:\n"

WRONG_PARAMETERS = [
    ("updat_rate:=20.0", "there is no parameter 'updat_rate': did you mean 'update_rate'?"),
    ("update_rate=20.0", "parameter 'update_rate=20.0': write NAME:=VALUE"),
    ("update_rate:=20", "'update_rate' is 20: that is an integer: write 20.0"),
    ("filter.cutoff:=0.1", "'filter.cutoff' is 0.1: allowed is 1 to 200 rad/s"),
    ("structure:=basline", "did you mean 'baseline'?"),
    ("imu.type:=sensor_msgs/Imu", "did you mean 'sensor_msgs/msg/Imu'?"),
    ("armed.type:=std_msgs/Bool", "allowed are \"\", std_msgs/msg/Bool, mavros_msgs/msg/State"),
    ("actuators.trim:=[1.0,2.0]", "'actuators.trim' has 2 values: 4 are needed"),
    ("actuators.trim:=[1,0.5]", "write every number of a list with a decimal point"),
    ("use_sim_time:=1", "'use_sim_time' is 1: write true or false"),
    ("qos_overrides./imu/dat.subscription.depth:=9",
     "did you mean 'qos_overrides./imu/data.subscription.depth'?"),
    ("qos_overrides./imu/data.subscription.reliability:=best", "reliable, best_effort"),
    ("initial_coefficients_file:=none.yaml", "'none.yaml': there is no such file"),
]  # fmt: skip

WRONG_FILES = [
    (FILE + "    actuators: {trim: [1, 0.5]}\n", "line 3: the values of a list"),
    (FILE + "    update_rate: 20\n", "that is an integer: write 20.0"),
    (FILE + "    imu: {typ: sensor_msgs/msg/Imu}\n", "did you mean 'imu.type'?"),
    ("{", "line 1"),
    ("/uav_ident:\n  ros__parameters:\n    update_rate: 10.0\n",
     "has nothing for node '/identifier': its sections are /uav_ident; write '/identifier:'"),
    # the format of `ros2 param dump` without a namespace
    ("/identifier:\n  ros__parameters:\n    update_rate: 10.0\n",
     "has nothing for node '/drone1/identifier'", "-r", "__ns:=/drone1"),
    ("", ".yaml': there is no such file"),
]  # fmt: skip

WRONG_OF_OTHERS = [
    ("controller_example", "law:=pid", "'law' is 'pid': allowed are incremental, inversion"),
    ("controller_example", "rate_gain:=[5.0]", "'rate_gain' has 1 values: 3 are needed"),
    ("controller_example", "mode:=fixed", "'nominal_file' must name the coefficients"),
    ("controller_example", "delay:=-0.1", "'delay' is -0.1: allowed is 0 s or more"),
    ("controller_example", "nominal_file:=none.yaml", "'none.yaml': there is no such file"),
    ("simulation.rate_reference", "hold:=[1.0]", "'hold' has 1 values: 2 are needed"),
    ("simulation.rate_reference", "seed:=-1", "'seed' is -1: allowed is 0 or more"),
    ("simulation.rate_reference", "airspeed:=.inf", "'airspeed' is inf: write a finite number"),
    ("simulation.plant_node", "airspeed_noise:=.nan", "'airspeed_noise' is nan: write a finite"),
    ("simulation.plant_node", "rate:=0.0", "rate is 0.0: it must be positive"),
    ("simulation.plant_node", "aircraft:=ufo", "'ufo' is not set up here: use one of"),
]

HAIL = """
import os, signal, time
from uav_ident_ros.node.ending import ENDING_SIGNALS, Ending
Ending()
parent = os.getpid()
if (child := os.fork()) == 0:
    while os.getppid() == parent:
        for number in ENDING_SIGNALS:
            os.kill(parent, number)
for _ in range(60_000):
    Ending().close()
os.kill(child, signal.SIGKILL)
print("done")
"""

CALLS = """
import contextlib, importlib, io, json, sys
found = []
for module, arguments in json.load(sys.stdin):
    main = importlib.import_module(f"uav_ident_ros.{module}").main
    errors, printed = io.StringIO(), io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(printed):
        status = main([module, *arguments])
    found.append((status, errors.getvalue(), printed.getvalue()))
json.dump(found, sys.stdout)
"""


def called(*cases: tuple[str, list[str]]) -> list[tuple[int, str, str]]:
    """Call programs with arguments; return status, errors and output of each."""
    run = python("-c", CALLS, input=json.dumps(cases), timeout=PATIENCE, check=True)
    assert run.stderr == "", "rcl prints nothing by itself"
    return json.loads(run.stdout)


def test_wrong_parameters_are_refused_in_one_line_with_the_fix(tmp_path: Path) -> None:
    """The cases are parameters, parameter files and stray arguments, with status 2."""
    own = "node.__main__"
    cases = [(own, ["flight.yaml"], "--ros-args --params-file FILE")]
    wrong = [(own, *case) for case in WRONG_PARAMETERS] + WRONG_OF_OTHERS
    cases += [(module, ["--ros-args", "-p", given], words) for module, given, words in wrong]
    for given in ("imu/data=/gyro", "imu/data:=", ":=/gyro"):
        words = f"remapping '{given}': write FROM:=TO"
        cases.append((own, ["--ros-args", "-r", given], words))
    for number, (text, words, *more) in enumerate(WRONG_FILES):
        path = tmp_path / f"{number}.yaml"
        if text:
            path.write_text(text, encoding="utf-8")
        cases.append((own, ["--ros-args", "--params-file", str(path), *more], words))
    found = called(*(case[:2] for case in cases))
    names = {own: "identifier", "simulation.plant_node": "simulated_plant"}
    for (module, arguments, words), (status, errors, printed) in zip(cases, found, strict=True):
        assert (status, printed) == (2, ""), arguments
        program = names.get(module, module.rpartition(".")[2])
        assert errors.startswith(f"{program}: "), arguments
        assert errors.count("\n") == 1 and words in errors, arguments


MISSPELT = """
import rclpy
from uav_ident_ros.controller_example import ControllerExample
rclpy.init(args=["--ros-args", "-p", "mod:=fixed", "-p", "imu.type:=of another node"])
ControllerExample().destroy_node()
rclpy.shutdown()
"""


def test_a_misspelt_parameter_of_another_node_is_named() -> None:
    """It is no refusal: a section /** holds the parameters of several nodes."""
    done = python("-c", MISSPELT, check=True)
    assert "there is no parameter 'mod': did you mean 'mode'?" in done.stderr
    assert "imu.type" not in done.stderr


HELPS = {
    "node.__main__": "actuators.mixing.de = [1.0, 0.0, 0.0, 0.0]",
    "simulation.plant_node": 'aircraft = "c172p"',
    "simulation.rate_reference": "airspeed = 53.0",
    "controller_example": 'mode = "adaptive"',
}


def test_help_is_printed_and_nothing_runs() -> None:
    found = called(*((module, ["--help"]) for module in HELPS))
    for module, (status, errors, text) in zip(HELPS, found, strict=True):
        assert (status, errors) == (0, ""), module
        assert text.startswith("usage: ") and HELPS[module] in text, module
    assert all(f"\n  {setting.name} = " in found[0][2] for setting in declarations())


def test_repeated_signals_end_the_node_cleanly(start_node: StartNode) -> None:
    """Signals come from the terminal, from launch, and repeatedly from the user."""
    node = start_node()
    assert wait_for(lambda: "no message on '/imu/data' yet" in node.log), node.log
    while node.poll() is None:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGINT):
            node.send_signal(number)
    assert node.wait(PATIENCE) == 0, node.log
    assert "Traceback" not in node.log


def test_no_signal_between_two_handlers_leaves_a_traceback() -> None:
    """Many ends under continuous signals: formerly one in ten thousand left a traceback."""
    done = python("-c", HAIL)
    assert (done.returncode, done.stdout) == (0, "done\n"), done.stderr
    assert "Traceback" not in done.stderr


def test_a_signal_during_start_up_ends_the_node(start_node: StartNode) -> None:
    """The signal arrives while the node loads its modules."""
    node = start_node()
    assert wait_for(lambda: handled(node.pid, signal.SIGTERM))
    assert node.end(signal.SIGTERM) == 0
    assert "Traceback" not in node.log


def test_hangup_ends_the_node_and_the_log_names_the_parameter_section(
    start_node: StartNode, tmp_path: Path
) -> None:
    """SIGTERM and SIGINT: test_memory.py."""
    path = tmp_path / "mine.yaml"
    path.write_text("/**/identifier:\n  ros__parameters:\n" + 2 * "    update_rate: 10.0\n")
    node = start_node(file=path)
    assert wait_for(lambda: f"parameters of '{path}', section /**/identifier" in node.log), node.log
    assert wait_for(lambda: f"'{path}' gives 'update_rate' more than once" in node.log), node.log
    assert wait_for(lambda: "'airspeed.reference' is the default, 20 m/s" in node.log)
    assert wait_for(lambda: "no message on '/imu/data' yet" in node.log), node.log
    assert node.end(signal.SIGHUP) == 0
    assert "Traceback" not in node.log
