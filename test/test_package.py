# SPDX-License-Identifier: Apache-2.0
"""The package as others install it: metadata, dependencies, entry points, file headers."""

from __future__ import annotations

import ast
import configparser
import importlib
import importlib.metadata
import os
import re
import runpy
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from repository import ROOT, console_scripts, setup_arguments

from uav_ident_ros.client import Coefficients
from uav_ident_ros.domain import own_domain
from uav_ident_ros.messages.streams import STREAMS
from uav_ident_ros.node.saving import FINISH_WITHIN
from uav_ident_ros.node.startup import USAGE_ERROR
from uav_ident_ros.simulation import closed_loop

PACKAGE = "uav_ident_ros"
SPDX = "SPDX-License-Identifier: Apache-2.0"

# import name -> rosdep key, where the two differ
ROSDEP_KEYS = {
    "hypothesis": "python3-hypothesis",
    "jinja2": "python3-jinja2",
    "markupsafe": "python3-markupsafe",
    "matplotlib": "python3-matplotlib",
    "numpy": "python3-numpy",
    "pytest": "python3-pytest",
    "rich": "python3-rich",
    "scipy": "python3-scipy",
    "tqdm": "python3-tqdm",
    "yaml": "python3-yaml",
}
# Development extras without a rosdep key: allowed only inside a function, so that the module
# loads without them. lz4 and zstandard come with mcap.
OPTIONAL = {
    "PIL",
    "distributed",
    "jsbsim",
    "lz4",
    "orangebox",
    "padasip",
    "pyarrow",
    "pymavlink",
    "pyulog",
    "zstandard",
}
# What the tools for the ground need and apt does not have: extras of setup.py, never package.xml.
PIP_ONLY = {"bokeh", "mcap", "rosbags"}
# What a companion computer need not have: the node must never import these. PyYAML is not
# among them: rclpy itself imports it.
OFFLINE_ONLY = {"jinja2", "markupsafe", "matplotlib", "rich", "scipy", "tqdm"} | PIP_ONLY | OPTIONAL


def manifest() -> ET.Element:
    return ET.parse(ROOT / "package.xml").getroot()


def dependencies(*tags: str) -> set[str]:
    return {str(element.text) for tag in tags for element in manifest().iter(tag)}


def project_files() -> list[Path]:
    """Return the files under version control and those about to be; without git, all visible."""
    listing = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        check=False,
    )
    if listing.returncode == 0:
        paths = [ROOT / name for name in listing.stdout.decode().split("\0") if name]
    else:
        skipped = {"build", "install", "log"}
        paths = [
            path
            for path in ROOT.rglob("*")
            if not any(
                part.startswith(".") or part in skipped or part.endswith(".egg-info")
                for part in path.relative_to(ROOT).parts
            )
        ]
    return [path for path in paths if path.is_file() and "__pycache__" not in path.parts]


def imports(path: Path, *, lazy: bool) -> Iterator[str]:
    """Yield the dotted names that a file imports, those inside functions too if `lazy`."""
    pending: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            origin = node.module or ""
            if node.level:
                above = path.relative_to(ROOT).parts[: -node.level]
                origin = ".".join([*above, *filter(None, [node.module])])
            yield origin
            # `from package import module` names a module, too
            yield from (f"{origin}.{alias.name}" for alias in node.names)
        is_function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        is_typing = isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")
        if lazy or not (is_function or is_typing):
            pending.extend(ast.iter_child_nodes(node))


def third_party(path: Path, *, lazy: bool) -> set[str]:
    tops = {name.split(".")[0] for name in imports(path, lazy=lazy)}
    return tops - set(sys.stdlib_module_names) - {PACKAGE, "__future__"}


def loaded_with(module: str) -> set[Path]:
    """Return the package's files that importing `module` loads, by their import statements."""
    found: set[Path] = set()
    pending = [module]
    while pending:
        name = pending.pop()
        if name.split(".")[0] != PACKAGE:
            continue
        base = ROOT.joinpath(*name.split("."))
        for path in (base.with_suffix(".py"), base / "__init__.py"):
            if path.is_file() and path not in found:
                found.add(path)
                pending.extend(imports(path, lazy=False))
        pending.append(name.rpartition(".")[0])
    return found


RUNTIME_FILES = sorted((ROOT / PACKAGE).rglob("*.py")) + sorted((ROOT / "launch").glob("*.py"))


def test_shared_files_are_found_where_it_is_installed(tmp_path: Path):
    """The demo and the closed loop run from an installation too."""
    installed = tmp_path / "lib" / "python3.12" / "site-packages" / PACKAGE / "share.py"
    installed.parent.mkdir(parents=True)
    shutil.copy(ROOT / PACKAGE / "share.py", installed)
    find = runpy.run_path(str(installed))["shared"]
    with pytest.raises(FileNotFoundError, match="'bags/multisine' is not installed"):
        find("bags/multisine")
    bag = tmp_path / "share" / PACKAGE / "bags" / "multisine"
    bag.mkdir(parents=True)
    assert find("bags/multisine") == bag


def test_versions_agree():
    version = setup_arguments()["version"]

    assert re.fullmatch(r"\d+\.\d+\.\d+", version)
    assert manifest().findtext("version") == version
    assert importlib.import_module(PACKAGE).__version__ == version
    assert importlib.metadata.version(PACKAGE) == version
    headings = re.findall(r"^## \[(\d.*?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert headings[0] == version


def test_bloom_can_read_the_manifest_and_the_changelog():
    """With catkin_pkg, which bloom reads both with; `catkin_prepare_release` renames the label."""
    package = pytest.importorskip("catkin_pkg.package", reason="comes with colcon-ros")
    warnings: list[str] = []
    read = package.parse_package(str(ROOT), warnings=warnings)
    read.validate(warnings=warnings)
    assert not warnings
    rst = (ROOT / "CHANGELOG.rst").read_text(encoding="utf-8")
    label = importlib.import_module("catkin_pkg.package_version").get_forthcoming_label(rst)
    released = re.findall(r"^(\d+\.\d+\.\d+) \(\d{4}-\d\d-\d\d\)$", rst, re.MULTILINE)
    assert label == "Forthcoming" or read.version in released


def test_the_workflow_runs_what_is_here():
    """Every script and executable that the public forge's workflow calls exists."""
    (path,) = (ROOT / ".github" / "workflows").glob("*.yml")
    jobs = yaml.safe_load(path.read_text())["jobs"]
    commands = "\n".join(step.get("run", "") for job in jobs.values() for step in job["steps"])
    scripts = re.findall(r"^(?:scripts|\.ci)/\S+", commands, re.MULTILINE)
    assert {"scripts/setup", "scripts/test", ".ci/run"} == set(scripts)
    assert all((ROOT / name).is_file() for name in scripts)
    assert set(re.findall(rf"ros2 run {PACKAGE} (\w+)", commands)) <= set(console_scripts())
    for name in re.findall(rf"ros2 launch {PACKAGE} (\S+)", commands):
        assert (ROOT / "launch" / name).is_file()


def test_the_unit_of_the_documentation_fits_the_node():
    """systemd must wait for the state file, and must not start again what was started wrongly."""
    text = (ROOT / "docs" / "live.md").read_text(encoding="utf-8")
    unit = configparser.ConfigParser()
    unit.optionxform = str
    unit.read_string(text.split("```ini\n")[1].split("```")[0])
    service = unit["Service"]
    assert int(service["RestartPreventExitStatus"]) == USAGE_ERROR
    assert float(service["TimeoutStopSec"]) > FINISH_WITHIN
    assert service["ExecStart"].count(f"lib/{PACKAGE}/identifier") == 1
    assert "identifier" in console_scripts()


def test_names_and_licences_agree():
    arguments = setup_arguments()

    assert manifest().findtext("name") == arguments["name"] == PACKAGE
    assert manifest().findtext("license") == arguments["license"] == "Apache-2.0"
    assert manifest().get("format") == "3"
    assert manifest().findtext("export/build_type") == "ament_python"
    licence = (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert "Version 2.0, January 2004" in licence
    assert "END OF TERMS AND CONDITIONS" in licence


def test_entry_points_are_callable_and_shadow_nothing():
    scripts = console_scripts()
    assert {"identifier", "replay", "simulate"} <= set(scripts)  # the contract's
    # a name that is a keyword cannot be a module, and .venv/bin must not hide a program
    assert not {"import", "watch", "test", "python"} & set(scripts)
    for target in scripts.values():
        module, _, function = target.partition(":")
        assert callable(getattr(importlib.import_module(module), function)), target


def test_pip_requirements_leave_ros_alone():
    """The PyPI names of rclpy must stay out: with apt ROS they cannot be satisfied."""
    arguments = setup_arguments()
    everything = list(arguments["install_requires"])
    for extra in arguments["extras_require"].values():
        everything += extra

    assert not [name for name in everything if name.startswith("ros-")]
    # colcon runs pytest because of this very name
    assert "pytest" in arguments["extras_require"]["test"]


def test_manifest_lists_what_is_imported():
    folders = (ROOT / "test", ROOT / "benchmarks")
    helpers = {path.stem for folder in folders for path in folder.rglob("*.py")}
    helpers |= {"test", "setuptools"}
    runtime = dependencies("depend", "exec_depend")
    for paths, ours, listed in (
        (RUNTIME_FILES, set(), runtime),
        (sorted((ROOT / "test").rglob("*.py")), helpers, runtime | dependencies("test_depend")),
    ):
        for path in paths:
            needed = third_party(path, lazy=True) - OPTIONAL - PIP_ONLY - ours
            assert {ROSDEP_KEYS.get(name, name) for name in needed} <= listed, path


def test_development_extras_are_imported_lazily():
    assert not [path for path in RUNTIME_FILES if third_party(path, lazy=False) & OPTIONAL]


def test_manifest_names_only_what_apt_has():
    """Bloom makes no deb of a pip key, and on Ubuntu 24.04 rosdep may not call pip at all."""
    keys = dependencies("depend", "build_depend", "exec_depend", "test_depend")
    # mcap-ros2-support is a pip key on Ubuntu 24.04 (rosdistro, rosdep/python.yaml)
    assert not {key for key in keys if key.endswith("-pip") or key == "mcap-ros2-support"}
    extras = setup_arguments()["extras_require"]
    assert "rosbags" in extras["import_log"]
    assert set(extras["replay"]) >= PIP_ONLY


def test_core_imports_numpy_alone():
    files = sorted((ROOT / PACKAGE / "identification").rglob("*.py"))
    assert files
    foreign = {path.name: third_party(path, lazy=True) - {"numpy"} for path in files}
    assert not {name: found for name, found in foreign.items() if found}
    reached = loaded_with(f"{PACKAGE}.identification") - set(files)
    assert reached <= {ROOT / PACKAGE / "__init__.py"}


def test_node_runs_without_the_offline_packages():
    files = loaded_with(f"{PACKAGE}.node.identifier_node")
    assert ROOT / PACKAGE / "node" / "identifier_node.py" in files
    offending = {path.name: third_party(path, lazy=True) & OFFLINE_ONLY for path in files}
    assert not {name: found for name, found in offending.items() if found}


def test_shared_files_are_installed():
    installed = {name for _, names in setup_arguments()["data_files"] for name in names}
    expected = {
        path.relative_to(ROOT).as_posix()
        for top in ("config", "launch", "bags")
        for path in project_files()
        if path.relative_to(ROOT).parts[0] == top and not path.name.startswith(".")
    }
    assert expected | {"package.xml", f"resource/{PACKAGE}"} <= installed


def needs_header(path: Path) -> bool:
    if path.suffix in {".py", ".sh", ".cfg", ".toml", ".in"}:
        return True
    if path.suffix in {".yaml", ".yml"} and path.relative_to(ROOT).parts[0] != "bags":
        return True
    with path.open("rb") as stream:
        return stream.read(2) == b"#!"


def test_every_source_file_names_its_licence():
    paths = [path for path in project_files() if needs_header(path)]
    assert ROOT / "setup.py" in paths
    missing = []
    for path in paths:
        lines = path.read_text(encoding="utf-8").splitlines()
        first = lines[1:2] if lines and lines[0].startswith("#!") else lines[:1]
        if first != [f"# {SPDX}"]:
            missing.append(str(path.relative_to(ROOT)))
    assert not missing


def test_no_file_holds_a_path_of_this_machine():
    machine = [str(path) for path in (ROOT, Path.home()) if len(path.parts) > 1]
    forbidden = re.compile(
        rb"(?<![\w.<])(?:"  # </root> is no path
        + b"|".join([rb"/(?:home|Users)/\w+", *(re.escape(name).encode() for name in machine)])
        + rb")(?![\w-])"
    )
    found = {
        str(path.relative_to(ROOT)): match.group().decode()
        for path in project_files()
        if (match := forbidden.search(path.read_bytes()))
    }
    assert not found


def test_locks_fix_every_version():
    for name in ("dev", "ros"):
        lines = (ROOT / "requirements" / f"{name}.txt").read_text().splitlines()
        pins = [line for line in lines if line and not line.startswith("#")]
        assert pins
        assert not [line for line in pins if not re.match(r"[\w.-]+==[\w.]+( ;|$)", line)]


LAUNCH_FILES = sorted((ROOT / "launch").glob("*.launch.py"))
CLOSED_LOOP_LAUNCH = ROOT / "launch" / "closed_loop.launch.py"
OF_THE_IDENTIFIER = [path for path in LAUNCH_FILES if path != CLOSED_LOOP_LAUNCH]
"""Those that start the identifier alone."""


def launch_calls(path: Path, name: str) -> list[ast.Call]:
    return [
        node
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "id", None) == name
    ]


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_launch_arguments_are_declared_and_used(path: Path):
    """Without launch installed: every declared argument is read, and none that is undeclared."""
    calls = launch_calls(path, "DeclareLaunchArgument")
    declared = [ast.literal_eval(call.args[0]) for call in calls]
    used = {ast.literal_eval(call.args[0]) for call in launch_calls(path, "LaunchConfiguration")}

    assert len(declared) == len(set(declared))
    assert set(declared) == used
    assert {"params_file", "namespace", "log_level"} <= used
    for call in calls:
        assert any(word.arg == "description" for word in call.keywords)


@pytest.mark.parametrize("path", OF_THE_IDENTIFIER, ids=lambda path: path.name)
def test_launch_can_rename_every_input(path: Path):
    """Each remap's left side is a topic of the node, its right side an argument of that default."""
    (node,) = launch_calls(path, "Node")
    (remappings,) = (word.value for word in node.keywords if word.arg == "remappings")
    arguments = {
        ast.literal_eval(pair.elts[0]): ast.literal_eval(pair.elts[1].args[0])
        for pair in remappings.elts
    }
    assert set(arguments) == {stream.topic for stream in STREAMS}
    defaults = {
        ast.literal_eval(call.args[0]): word.value
        for call in launch_calls(path, "DeclareLaunchArgument")
        for word in call.keywords
        if word.arg == "default_value"
    }
    for topic, argument in arguments.items():
        # a bag's topics do not follow the node's namespace
        assert ast.literal_eval(defaults[argument]).removeprefix("/") == topic


@pytest.mark.parametrize("path", OF_THE_IDENTIFIER, ids=lambda path: path.name)
def test_launch_file_starts_what_the_package_installs(path: Path):
    (node,) = launch_calls(path, "Node")
    constants = constants_of(path)
    values = {word.arg: word.value for word in node.keywords}
    executable = values["executable"]
    name = constants[executable.id] if isinstance(executable, ast.Name) else executable.value
    assert name in console_scripts()
    assert constants["PACKAGE"] == PACKAGE
    assert constants["DEFAULT_PARAMS"] == "identifier.yaml"  # defaults, not a vehicle's or paper's
    assert (ROOT / "config" / constants["DEFAULT_PARAMS"]).is_file()


def test_launch_of_a_bag():
    """Without launch installed: the clock, the topics that are recorded, the end."""
    path = ROOT / "launch" / "replay.launch.py"
    constants = constants_of(path)
    assert float(constants["CLOCK_RATE"]) == 200.0
    source = path.read_text()
    recorded = ast.literal_eval(source.split("RECORDED = f")[1].splitlines()[0])
    pattern = recorded.replace("{NODE}", constants["NODE"])
    for topic in ("/identifier/coefficients_named", "/drone1/identifier/coefficients"):
        assert re.search(pattern, topic)
    assert re.search(pattern, "/diagnostics")
    for topic in ("/imu/data", "/clock", "/rosout", "/other/diagnostics_agg"):
        assert not re.search(pattern, topic)
    commands = [ast.unparse(call) for call in launch_calls(path, "ExecuteProcess")]
    assert len(commands) == 2
    assert all("FindExecutable(name='ros2'), 'bag'" in command for command in commands)
    (player,) = [command for command in commands if "'play'" in command]
    assert "'--clock', LaunchConfiguration('clock_rate')" in player
    # what follows an option without a value would be taken for it
    assert player.index("LaunchConfiguration('bag')") < player.index("'--clock'")
    assert "'state_file': 'none'" in ast.unparse(launch_calls(path, "Node")[0])


def test_launch_of_the_closed_loop():
    """Without launch installed: its nodes, and that its parameter file has a section for each."""
    calls = launch_calls(CLOSED_LOOP_LAUNCH, "node")
    started = {ast.literal_eval(call.args[0]): ast.literal_eval(call.args[1]) for call in calls}
    (faults,) = (
        value
        for call in calls
        if isinstance(call.args[2], ast.Dict)
        for key, value in zip(call.args[2].keys, call.args[2].values, strict=True)
        if isinstance(key, ast.Constant) and key.value == "faults"
    )
    # launch_ros joins the pieces, reads the text as YAML, and needs exactly the type
    assert ast.unparse(faults.keywords[0]) == "value_type=list[str]"
    for fault in ("", "60: aileron effect 0.5"):
        pieces = [
            piece.value if isinstance(piece, ast.Constant) else fault
            for piece in faults.args[0].elts
        ]
        assert yaml.safe_load("".join(pieces)) == [fault]
    assert set(started) <= set(console_scripts())
    assert set(started.values()) == set(closed_loop.MODULES)
    constants = constants_of(CLOSED_LOOP_LAUNCH)
    folder = ROOT / "config" / "closed_loop"
    sections = yaml.safe_load((folder / constants["PARAMS"]).read_text())
    # a node refuses a file that has nothing for it
    assert {key.rpartition("/")[2] for key in sections} == set(started.values())
    assert Coefficients.from_file(folder / constants["COEFFICIENTS"]).known.any()


def constants_of(path: Path) -> dict[str, Any]:
    """Return a file's module-level literal assignments, without running it."""
    return {
        node.targets[0].id: ast.literal_eval(node.value)
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Name)
        and isinstance(node.value, ast.Constant)
    }


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_launch_description_builds(path: Path):
    pytest.importorskip("launch_ros", reason="launch comes with apt ROS only")
    launch = importlib.import_module("launch")
    description = runpy.run_path(str(path))["generate_launch_description"]()
    assert isinstance(description, launch.LaunchDescription)
    assert "params_file" in {argument.name for argument in description.get_launch_arguments()}


def launched(*arguments: str, launch_file: str) -> subprocess.CompletedProcess[str]:
    """Run a launch file; skip where there is no `ros2` that knows this package."""
    if (
        shutil.which("ros2") is None
        or subprocess.run(
            ["ros2", "pkg", "prefix", PACKAGE], capture_output=True, check=False
        ).returncode
    ):
        pytest.skip("there is no ros2 with this package here")
    command = ["ros2", "launch", PACKAGE, launch_file, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_launch_ends_aloud_without_its_parameter_file(path: Path, tmp_path: Path):
    """launch_ros itself warns, and starts the node on its defaults."""
    missing = tmp_path / "none.yaml"
    arguments = [f"params_file:={missing}"]
    if path.name == "replay.launch.py":
        arguments.append(f"bag:={tmp_path}")
    run = launched(*arguments, launch_file=path.name)
    assert run.returncode == 1
    assert f"params_file '{missing}': there is no such file" in run.stdout + run.stderr
    assert "process started" not in run.stdout + run.stderr


def test_launch_ends_with_a_dead_process(tmp_path: Path):
    """The identifier refuses the file with status 2; launch says so by its own."""
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("/uav_ident:\n  ros__parameters:\n    update_rate: 10.0\n")
    run = launched(f"params_file:={wrong}", launch_file="identifier.launch.py")
    assert run.returncode == 1
    assert "ended with status 2" in run.stdout + run.stderr


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_launch_checks_before_it_starts(path: Path):
    """Without launch installed: what is started before an error would be left behind."""
    (function,) = (
        node
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef) and node.name == "generate_launch_description"
    )
    entries = [ast.unparse(item) for item in function.body[-1].value.args[0].elts]
    check = next(i for i, entry in enumerate(entries) if entry.startswith("files_exist("))
    watch = next(i for i, entry in enumerate(entries) if entry.startswith("*fails_with("))
    processes = [i for i, entry in enumerate(entries) if re.fullmatch(r"\*?[a-z]+", entry)]
    assert processes
    assert max(check, watch) < min(processes)
    watched = {word.strip("*") for word in re.findall(r"\*?[a-z]+", entries[watch].split("(")[1])}
    assert {entries[i].strip("*") for i in processes} - {"end"} <= watched


def test_programs_side_by_side_get_domains_of_their_own() -> None:
    before = os.environ["ROS_DOMAIN_ID"]
    with own_domain() as first, own_domain() as second:
        assert first != second
        assert before not in (str(first), str(second))  # which this process holds
        assert os.environ["ROS_DOMAIN_ID"] == str(second)
    assert os.environ["ROS_DOMAIN_ID"] == before
