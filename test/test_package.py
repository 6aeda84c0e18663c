# SPDX-License-Identifier: Apache-2.0
"""The installed package: metadata, dependencies, entry points, file headers."""

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
from itertools import chain
from pathlib import Path

import pytest
import yaml
from programs import python
from repository import ROOT, console_scripts, setup_arguments

from uav_ident_ros.commandline import BROKEN_PIPE, COMMANDS, INTERRUPTED, USAGE_ERROR, run
from uav_ident_ros.node.memory import FINISH_WITHIN
from uav_ident_ros.process import own_domain

PACKAGE = "uav_ident_ros"
SPDX = "SPDX-License-Identifier: Apache-2.0"

# import name -> rosdep key, where the two differ
ROSDEP_KEYS = {"yaml": "python3-yaml"} | {
    name: f"python3-{name}"
    for name in ("hypothesis", "jinja2", "markupsafe", "matplotlib", "numpy", "pytest", "rich",
                 "scipy", "tqdm")
}  # fmt: skip
# Development extras without a rosdep key: imported only inside functions, so that the module
# loads without them. lz4 and zstandard are dependencies of mcap.
OPTIONAL = {
    "PIL", "distributed", "jsbsim", "lz4", "orangebox", "padasip", "pymavlink",
    "pyulog", "zstandard",
}  # fmt: skip
# Packages of the ground tools that apt lacks: extras of setup.py, never in package.xml.
PIP_ONLY = {"bokeh", "mcap", "pyarrow", "rosbags"}
# Packages that a companion computer may lack: the node must never import them. PyYAML is not
# among them, since rclpy imports it.
OFFLINE_ONLY = {"jinja2", "markupsafe", "matplotlib", "rich", "scipy", "tqdm"} | PIP_ONLY | OPTIONAL


def manifest() -> ET.Element:
    return ET.parse(ROOT / "package.xml").getroot()


def dependencies(*tags: str) -> set[str]:
    return {str(element.text) for tag in tags for element in manifest().iter(tag)}


def project_files() -> list[Path]:
    """Return the files under version control, and new files that are not ignored."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listing = subprocess.run(command, cwd=ROOT, capture_output=True, check=False)
    if listing.returncode:
        pytest.skip("this is no checkout of git")
    paths = [ROOT / name for name in listing.stdout.decode().split("\0") if name]
    return [path for path in paths if path.is_file()]


def imports(path: Path, *, lazy: bool) -> Iterator[str]:
    """Yield the dotted names that a file imports, those inside functions too if `lazy`."""
    pending: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.module and not node.level, f"{path} has a relative import"
            # `from package import module` also imports a module
            yield from (node.module, *(f"{node.module}.{alias.name}" for alias in node.names))
        if lazy or not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            pending.extend(ast.iter_child_nodes(node))


def third_party(path: Path, *, lazy: bool) -> set[str]:
    tops = {name.split(".")[0] for name in imports(path, lazy=lazy)}
    return tops - set(sys.stdlib_module_names) - {PACKAGE, "__future__"}


def loaded_with(*modules: str) -> set[Path]:
    """Return the package's files that are loaded with some of its modules."""
    own = f"[m.__file__ for n, m in sys.modules.items() if n.partition('.')[0] == '{PACKAGE}']"
    code = f"import sys, {', '.join(modules)}; print(*{own}, sep='\\n')"
    return {Path(line) for line in python("-c", code, check=True).stdout.splitlines()}


RUNTIME_FILES = sorted((ROOT / PACKAGE).rglob("*.py")) + sorted((ROOT / "launch").glob("*.py"))


def test_shared_files_are_found_in_an_installation(tmp_path: Path):
    """The demo and the closed loop use them."""
    installed = tmp_path / "lib" / "python3.12" / "site-packages" / PACKAGE / "share.py"
    installed.parent.mkdir(parents=True)
    shutil.copy(ROOT / PACKAGE / "share.py", installed)
    find = runpy.run_path(str(installed))["shared"]
    with pytest.raises(FileNotFoundError, match="'bags/multisine' is not installed"):
        find("bags/multisine")
    bag = tmp_path / "share" / PACKAGE / "bags" / "multisine"
    bag.mkdir(parents=True)
    assert find("bags/multisine") == bag


def test_names_licences_and_versions_agree():
    arguments, version = setup_arguments(), setup_arguments()["version"]
    assert re.fullmatch(r"\d+\.\d+\.\d+", version)
    assert manifest().findtext("version") == version
    assert importlib.import_module(PACKAGE).__version__ == version
    assert importlib.metadata.version(PACKAGE) == version
    headings = re.findall(r"^## \[(\d.*?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert headings[0] == version
    assert manifest().findtext("name") == arguments["name"] == PACKAGE
    assert manifest().findtext("license") == arguments["license"] == "Apache-2.0"
    assert manifest().get("format") == "3"
    assert manifest().findtext("export/build_type") == "ament_python"
    licence = (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert "Version 2.0, January 2004" in licence
    assert "END OF TERMS AND CONDITIONS" in licence


def test_bloom_can_read_the_manifest_and_the_changelog():
    """Bloom reads both with catkin_pkg; `catkin_prepare_release` renames the label."""
    package = pytest.importorskip("catkin_pkg.package", reason="comes with colcon-ros")
    warnings: list[str] = []
    read = package.parse_package(str(ROOT), warnings=warnings)
    read.validate(warnings=warnings)
    assert not warnings
    rst = (ROOT / "CHANGELOG.rst").read_text(encoding="utf-8")
    label = importlib.import_module("catkin_pkg.package_version").get_forthcoming_label(rst)
    released = re.findall(r"^(\d+\.\d+\.\d+) \(\d{4}-\d\d-\d\d\)$", rst, re.MULTILINE)
    assert label == "Forthcoming" or read.version in released


def test_the_workflow_calls_existing_files():
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


def test_the_documented_systemd_unit_matches_the_node():
    """systemd must wait for the state file, and must not restart after wrong parameters."""
    text = (ROOT / "docs" / "live.md").read_text(encoding="utf-8")
    unit = configparser.ConfigParser()
    unit.optionxform = str
    unit.read_string(text.split("```ini\n")[1].split("```")[0])
    service = unit["Service"]
    assert int(service["RestartPreventExitStatus"]) == USAGE_ERROR
    assert float(service["TimeoutStopSec"]) > FINISH_WITHIN
    assert service["ExecStart"].count(f"lib/{PACKAGE}/identifier") == 1
    assert "identifier" in console_scripts()


def test_entry_points_shadow_nothing():
    """That they are callable: the tests of Ctrl-C and of a closed pipe call each."""
    scripts = console_scripts()
    assert {"identifier", "replay", "simulate"} <= set(scripts)  # of the public contract
    # a name that is a keyword cannot be a module, and .venv/bin must not hide a program
    assert not {"import", "watch", "test", "python"} & set(scripts)


@pytest.mark.parametrize(
    ("name", "called", "arguments"),
    [
        ("simulate", "simulation.cli.flight_from", ["--output", "flight"]),
        ("import_log", "import_logs.cli.read_log", ["flight.ulg"]),
        ("fleet", "offline.fleet_command.fleet_of", ["flights.csv"]),
        ("replay", "offline.command.find_bags", ["flight"]),
    ],
)
def test_ctrl_c_ends_a_command_without_a_traceback(
    name: str, called: str, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(f"{PACKAGE}.{called}", interrupt)
    assert run(name, arguments) == INTERRUPTED


@pytest.mark.parametrize("name", COMMANDS)
def test_ctrl_c_during_the_imports_leaves_no_traceback(name: str) -> None:
    """They take a second: those of the command, and those of NumPy that all have."""
    assert console_scripts()[name] == f"{PACKAGE}.commandline:{name}"
    code = (
        "import os, signal, sys\n"
        "class Interrupt:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'numpy': os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Interrupt())\n"
        f"from {PACKAGE}.commandline import {name}; sys.exit({name}(['x']))"
    )
    done = python("-c", code)
    assert (done.returncode, done.stderr) == (INTERRUPTED, "")


NODES = [name for name in console_scripts() if name not in COMMANDS]
PRINT = (
    "from uav_ident_ros.offline import fleet_command\n"
    "fleet_command.main = lambda _: print('a table') or 0\n"
)


@pytest.mark.parametrize(("name", "before"), [("fleet", PRINT), *((name, "") for name in NODES)])
def test_the_end_of_a_reader_of_a_pipe_leaves_no_traceback(name: str, before: str) -> None:
    """As of ``identifier --help | head``."""
    module, _, function = console_scripts()[name].partition(":")
    code = f"{before}import sys; from {module} import {function}; sys.exit({function}())"
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as stdout:
        command = [sys.executable, "-c", code, "--help"]
        done = subprocess.run(command, cwd=ROOT, stdout=stdout, stderr=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (BROKEN_PIPE, b"")


def test_pip_requirements_exclude_ros():
    """The PyPI names of rclpy are excluded: apt ROS cannot satisfy them."""
    arguments = setup_arguments()
    extras = arguments["extras_require"]
    everything = [*arguments["install_requires"], *chain.from_iterable(extras.values())]
    assert not [name for name in everything if name.startswith("ros-")]
    assert "pytest" in extras["test"]  # by this name colcon selects pytest


def test_manifest_lists_the_imported_packages():
    folders = (ROOT / "test", ROOT / "benchmarks", ROOT / "scripts")
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


def test_manifest_names_only_packages_of_apt():
    """Bloom cannot package a pip key, and rosdep may not call pip on Ubuntu 24.04."""
    keys = dependencies("depend", "build_depend", "exec_depend", "test_depend")
    # mcap-ros2-support is a pip key on Ubuntu 24.04 (rosdistro, rosdep/python.yaml)
    assert not {key for key in keys if key.endswith("-pip") or key == "mcap-ros2-support"}
    extras = setup_arguments()["extras_require"]
    assert "rosbags" in extras["import_log"]
    assert set(extras["replay"]) >= PIP_ONLY


def test_core_imports_numpy_alone():
    files = sorted((ROOT / PACKAGE / "identification").rglob("*.py"))
    foreign = {path.name: third_party(path, lazy=True) - {"numpy"} for path in files}
    assert files and not {name: found for name, found in foreign.items() if found}
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in files]
    reached = loaded_with(*(name.removesuffix(".__init__") for name in names)) - set(files)
    assert reached == {ROOT / PACKAGE / "__init__.py"}


@pytest.mark.parametrize(
    "module",
    ["node.identifier_node", "offline.inputs", "import_logs.writing", "simulation.preparation"],
)
def test_whoever_checks_parameters_has_the_message_types(module: str):
    """The core alone, which reads no messages, takes any type."""
    assert ROOT / PACKAGE / "messages" / "types.py" in loaded_with(f"{PACKAGE}.{module}")


def test_messages_and_the_client_import_no_ros():
    files = loaded_with(f"{PACKAGE}.messages.feed", f"{PACKAGE}.client")
    assert ROOT / PACKAGE / "messages" / "published.py" in files
    assert not [path for path in files if third_party(path, lazy=False) - {"numpy"}]


def test_node_runs_without_the_offline_packages():
    files = loaded_with(f"{PACKAGE}.node.identifier_node")
    assert ROOT / PACKAGE / "node" / "identifier_node.py" in files
    offending = {path.name: third_party(path, lazy=True) & OFFLINE_ONLY for path in files}
    assert not {name: found for name, found in offending.items() if found}


def test_the_node_and_the_offline_tools_do_not_import_each_other():
    offline = {"bags", "offline", "report"}
    for module in ("node", *offline):
        files = (ROOT / PACKAGE / module).rglob("*.py")
        imported = {n for path in files for n in imports(path, lazy=True) if n.startswith(PACKAGE)}
        reached = {name.split(".")[1] for name in imported if "." in name}
        assert reached, module
        assert not reached & (offline if module == "node" else {"node"}), module


def test_shared_files_are_installed():
    installed = {name for _, names in setup_arguments()["data_files"] for name in names}
    expected = {
        path.relative_to(ROOT).as_posix()
        for top in ("config", "launch", "bags")
        for path in project_files()
        if path.relative_to(ROOT).parts[0] == top and not path.name.startswith(".")
    }
    assert expected | {"package.xml", f"resource/{PACKAGE}"} <= installed


def test_files_beside_the_modules_are_installed():
    patterns = setup_arguments()["package_data"][PACKAGE]
    installed = {path for pattern in patterns for path in (ROOT / PACKAGE).glob(pattern)}
    beside = {p for p in project_files() if p.is_relative_to(ROOT / PACKAGE) and p.suffix != ".py"}
    assert beside == {path for path in installed if path.is_file()}


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
    header = re.compile(rf"(#!.*\n)?# {SPDX}\n")
    assert not [p for p in paths if not header.match(p.read_text(encoding="utf-8"))]


def test_no_file_holds_a_path_of_this_machine():
    machine = [str(path) for path in (ROOT, Path.home()) if len(path.parts) > 1]
    forbidden = re.compile(
        rb"(?<![\w.<])(?:"  # </root> is no path
        + b"|".join([rb"/(?:home|Users)/\w+", *(re.escape(name).encode() for name in machine)])
        + rb")(?![\w-])"
    )
    found = {path: forbidden.search(path.read_bytes()) for path in project_files()}
    assert not {path: match for path, match in found.items() if match}


def test_locks_fix_every_version():
    for name in ("dev", "ros"):
        lines = (ROOT / "requirements" / f"{name}.txt").read_text().splitlines()
        pins = [line for line in lines if line and not line.startswith("#")]
        assert pins
        assert not [line for line in pins if not re.match(r"[\w.-]+==[\w.]+( ;|$)", line)]


def test_concurrent_programs_have_separate_ros_domains() -> None:
    before = os.environ["ROS_DOMAIN_ID"]
    with own_domain() as first, own_domain() as second:
        assert first != second
        assert before not in (str(first), str(second))  # held by this process
        assert os.environ["ROS_DOMAIN_ID"] == str(second)
    assert os.environ["ROS_DOMAIN_ID"] == before
