# SPDX-License-Identifier: Apache-2.0
"""The documentation agrees with the code: tables, links, commands, topics, examples."""

import doctest
import importlib
import json
import math
import os
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from equations import matrix
from estimates import as_message, estimate_of
from parameter_docs import TABLES, full_tables, renew
from programs import python
from repository import ROOT, console_scripts, launch_arguments, launch_entries

from uav_ident_ros.client import Refusal
from uav_ident_ros.files.parameter_file import load_parameters
from uav_ident_ros.identification import (
    delay,
    flow,
    gates,
    model,
    plausibility,
    prior,
    residuals,
    sampling,
    scales,
    speed,
)
from uav_ident_ros.identification.estimators import change, information
from uav_ident_ros.identification.identifier import START_LEAK_TIME, STRETCH_TIME
from uav_ident_ros.identification.model import GRAVITY
from uav_ident_ros.identification.settings import Settings, declarations
from uav_ident_ros.identification.structure import STRUCTURES

README = ROOT / "README.md"
PARAMETERS = ROOT / "docs" / "parameters.md"
INTERFACE = ROOT / "docs" / "interface.md"
LARGEST_README = 9_000
"""Limit in bytes: two screens."""

DOCS = sorted((ROOT / "docs").glob("*.md"))
PAGES = [
    README,
    *(ROOT / name for name in ("CHANGELOG.md", "CONTRIBUTING.md", "bags/README.md")),
    ROOT / "examples" / "README.md",
    *DOCS,
]
PACKAGE = ROOT / "uav_ident_ros"
# Top-level files and folders of this repository, in the notation of the pages.
OURS = re.compile(
    r"^(?:scripts|config|bags|docs|test|launch|benchmarks|uav_ident_ros|requirements|\.ci)/\S+$"
)


def page_id(path: Path) -> str:
    return str(path.relative_to(ROOT))


def text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def code_blocks(text: str, language: str = "") -> list[str]:
    """Return the fenced blocks of a language; those in lists are dedented."""
    found = re.findall(r"^( *)```(\w*)\n(.*?)^\1```$", text, re.DOTALL | re.MULTILINE)
    return [
        re.sub(f"^{indent}", "", body, flags=re.MULTILINE)
        for indent, label, body in found
        if label == language
    ]


def without_code(text: str) -> str:
    return re.sub(r"^ *```.*?^ *```$", "", text, flags=re.DOTALL | re.MULTILINE)


def command_lines(text: str) -> Iterator[str]:
    """Yield the lines of the blocks without a language, continuation lines joined."""
    for block in code_blocks(text):
        for line in block.replace("\\\n", " ").splitlines():
            if line.strip():
                yield line.strip()


# --- docstrings ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "module",
    [
        "client.excitation",
        "client.model",
        "client.source",
        "identification.estimators",
        "identification.identifier",
        "identification.prediction",
    ],
)
def test_the_examples_of_the_docstrings_run(module: str) -> None:
    """Those with a bag to read or write are skipped (`doctest: +SKIP`)."""
    failed, attempted = doctest.testmod(importlib.import_module(f"uav_ident_ros.{module}"))
    assert attempted
    assert not failed


# --- generated tables ------------------------------------------------------------------------


def test_generated_tables_are_in_step_and_hold_every_parameter() -> None:
    text = text_of(PARAMETERS)
    assert renew(text) == text, f"{page_id(PARAMETERS)} is out of step: run scripts/make_docs"
    for name in TABLES:
        assert f"<!-- generated: {name} -->" in text
    rows = full_tables()
    for setting in declarations():
        assert f"| `{setting.name}` |" in rows


# --- links, files and commands ---------------------------------------------------------------


def anchors(text: str) -> set[str]:
    """Return the anchors of the headings, by GitHub's rule."""
    headings = re.findall(r"^#+ (.*)$", without_code(text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_no_relative_link_is_dead(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", without_code(text_of(page))):
        if "://" in target:
            continue
        name, _, anchor = target.partition("#")
        linked = (page.parent / name).resolve() if name else page
        assert linked.exists(), f"{page_id(page)} links to '{target}'"
        if anchor:
            assert anchor in anchors(text_of(linked)), f"{page_id(page)} links to '{target}'"


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_every_named_file_exists(page: Path) -> None:
    text = text_of(page)
    words = re.findall(r"`([^`\n]+)`", without_code(text))
    words += [word for line in command_lines(text) for word in line.split()]
    for word in (part for phrase in words for part in phrase.split()):
        word = word.rstrip(".,:;")
        if OURS.match(word) and "*" not in word:
            assert (ROOT / word).exists(), f"{page_id(page)} names '{word}'"


@pytest.mark.parametrize("page", [README, *DOCS], ids=page_id)
def test_every_command_exists_with_its_options(page: Path) -> None:
    executables = console_scripts()
    for line in command_lines(text_of(page)):
        words = shlex.split(line, comments=True) if line.count("'") % 2 == 0 else line.split()
        if not words:
            continue
        if words[0].startswith(".venv/bin/"):
            name = words[0].removeprefix(".venv/bin/")
            assert name in executables, f"{page_id(page)}: there is no executable '{name}'"
            check_options(page, name, executables[name], words[1:])
        elif words[0].startswith("scripts/"):
            script = ROOT / words[0]
            assert os.access(script, os.X_OK), f"{page_id(page)}: '{words[0]}' cannot be run"
        elif words[:3] == ["ros2", "run", "uav_ident_ros"]:
            assert words[3] in executables
        elif words[:3] == ["ros2", "launch", "uav_ident_ros"]:
            declared = launch_arguments(launch_entries(ROOT / "launch" / words[3]))
            assert {word.split(":=")[0] for word in words[4:]} <= {m.args[0] for m in declared}


def check_options(page: Path, name: str, entry: str, words: list[str]) -> None:
    """Compare the options of a command with its help."""
    if name == "identifier":
        assert words[0] == "--ros-args"
        return
    known = help_of(entry)
    for word in words:
        if word.startswith("--"):
            assert re.search(rf"(?<!\S){word}(?![\w-])", known), f"{page_id(page)}: {name} {word}"


@cache
def help_of(entry: str) -> str:
    module, _, function = entry.partition(":")
    code = f"import sys; from {module} import {function}; sys.exit({function}())"
    return re.sub(r"[\[\],]", " ", python("-c", code, "--help", check=True).stdout)


def test_the_readme_lists_the_installed_executables() -> None:
    table = text_of(README).split("| executable |")[1].split("\n\n")[0]
    assert set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == set(console_scripts())


def test_the_readme_starts_with_two_commands_and_is_short() -> None:
    assert code_blocks(text_of(README))[0].split() == ["scripts/demo", "scripts/test"]
    assert len(text_of(README).encode()) < LARGEST_README


# --- topics and services ---------------------------------------------------------------------

QUERY_NODE = """
import json, rclpy
from uav_ident_ros.node.identifier_node import IdentifierNode
types = ["-p", "airspeed.type:=std_msgs/msg/Float64", "-p", "armed.type:=std_msgs/msg/Bool"]
rclpy.init(args=["--ros-args", *types, "-p", "state_file:=none"])
node = IdentifierNode()
mine = (node.get_name(), node.get_namespace())
found = {
    "topics": node.get_publisher_names_and_types_by_node(*mine)
    + node.get_subscriber_names_and_types_by_node(*mine),
    "services": node.get_service_names_and_types_by_node(*mine),
}
print("FOUND " + json.dumps(found))
node.destroy_node()
rclpy.shutdown()
"""
"""Program that prints the names and types of a real node with every optional input."""

HEADERS = {"topics": "| topic | type | QoS | content |", "services": "| service | type | effect |"}

# Topics and services of every rclpy node.
OF_EVERY_NODE = re.compile(r"^/(rosout|parameter_events|clock)$|parameter|type_description")


def listed(header: str) -> dict[str, str]:
    """Return full name and type of every row below a table header of the interface."""
    rows = {}
    for table in text_of(INTERFACE).split(header)[1:]:
        body = table.split("\n\n")[0]
        for name, msgtype in re.findall(r"^\| `([~/\w]+)` \| `([\w/]+)` \|", body, re.MULTILINE):
            full = name.replace("~", "/identifier") if name[0] in "~/" else f"/{name}"
            rows[full] = msgtype
    return rows


def test_the_interface_page_lists_the_topics_and_services_of_the_node() -> None:
    done = python("-c", QUERY_NODE, check=True)
    line = next(line for line in done.stdout.splitlines() if line.startswith("FOUND "))
    for kind, entries in json.loads(line.removeprefix("FOUND ")).items():
        found = {name: types[0] for name, types in entries if not OF_EVERY_NODE.search(name)}
        assert listed(HEADERS[kind]) == found


# --- examples --------------------------------------------------------------------------------


def test_every_parameter_file_of_the_pages_is_valid(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.yaml"
    blocks = [block for page in (README, *DOCS) for block in code_blocks(text_of(page), "yaml")]
    assert blocks
    for block in blocks:
        path.write_text(block, encoding="utf-8")
        values = dict(load_parameters(path, "/identifier"))
        values.pop("use_sim_time", None)
        assert Settings.from_values(values).values() != Settings().values(), block


def test_the_controller_of_the_readme_inverts_the_model_and_follows_the_verdict() -> None:
    (source,) = code_blocks(text_of(README), "python")
    namespace: dict[str, Any] = {}
    exec(compile(source, "README.md", "exec"), namespace)
    subscribed: list[Any] = []
    node = SimpleNamespace(
        create_subscription=lambda kind, topic, callback, qos: subscribed.append(callback)
    )
    inversion = namespace["Inversion"](node)
    structure = STRUCTURES["augmented"]
    coefficients = matrix(structure, {"pdot/da": 30.0, "qdot/de": -26.0, "rdot/dr": -2.0})

    def receive(t_ns: int, usable: bool) -> None:
        estimate = estimate_of(coefficients, t_ns=t_ns, usable=usable)
        subscribed[0](as_message(estimate, structure))

    receive(1, usable=False)
    with pytest.raises(Refusal, match="not usable"):
        inversion.inputs(1, np.zeros(3), np.array([3.0, 1.3, 0.1]))
    receive(2, usable=True)
    u = inversion.inputs(2, np.zeros(3), np.array([3.0, 1.3, 0.1]))
    np.testing.assert_allclose(u, [-0.05, -0.05, 0.1, 0.0])


# --- figures -----------------------------------------------------------------------------------


def test_the_algorithm_page_has_the_constants_of_the_code() -> None:
    text = " ".join(text_of(ROOT / "docs" / "algorithm.md").split())
    fast, slow, slowest = residuals.ANSWER_TIMES
    lightest, heaviest = (
        force / GRAVITY for force in (plausibility.SMALLEST_FORCE, plausibility.LARGEST_FORCE)
    )
    for figure in (
        f"Odds of {math.exp(residuals.CONFIRMED):.0f} to 1",
        f"(order {residuals.ORDER}, {scales.MEMORY:g} s)",
        f"faded over {fast:.2g}, {slow:.2g} and {slowest:.2g} s",
        f"more than {plausibility.SMALLEST_MEAN_RATE:g} rad/s on average, and less than "
        f"{plausibility.GRAVITY_LEFT:g} g is left",
        f"an input is beyond {plausibility.COUNTS:.0f} rad",
        f"below {lightest:g} or above {heaviest:g} g",
        f"for {plausibility.ENOUGH:g} s an input is never within {plausibility.LARGEST_TRIM:g} rad",
        f"one g over any {plausibility.FORCE_WINDOW:g} s",
        f"larger of {gates.NOISE_SWING:.1f} times the gyro's own noise and "
        f"{scales.REST_SWAY:g} rad/s: noise exceeds {scales.DOUBTLESS:.1f} sigma",
        f"median of the first {sampling.RATE_SAMPLES} intervals",
        f"limited to 1/{speed.LARGEST_SPEED_RATIO:g} ... {speed.LARGEST_SPEED_RATIO:g}",
        f"k = {flow.ATTITUDE_GAIN:g} 1/s",
        f"At {100 * flow.GRAVITY_BAND:g} % it does not count at all",
        f"largest variance over {gates.EXCITATION_TIME:g} s of its inputs",
        f"eigenvalue below {information.COLLINEAR_EIGENVALUE:.2f} name",
        f"{100 * information.MODEL_ERROR:g} % of the value**",
        f"Beyond {scales.OUTLYING:g} times the usual size",
        f"at most -g / {prior.LARGEST_LIFT_ANGLE:g}",
        f"serves for the first {scales.SHORT_MEMORY:g} s of learning",
        f"at most {START_LEAK_TIME:g} s for the first {scales.START_TIME:g} s of learning",
        f"added {STRETCH_TIME:g} s at a time",
        f"A rate beyond {model.LARGEST_RATE:g} rad/s",
        f"residuals of the last {change.WINDOW_TIME:g} s are tested",
        f"The delays are {1e3 * scales.STEP:g} ms apart",
        f"over the last {scales.BLOCKS} blocks",
        f"{1e3 * delay.SYSTEMATIC_ERROR:g} ms of systematic error",
        f"sigma is at most {1e3 * delay.SURE_SIGMA:g} ms, and at all sums "
        f"{1e3 * delay.APART * scales.STEP:g} ms away J exceeds its minimum by "
        f"{scales.DOUBTLESS**2:.0f}",
    ):
        assert figure in text


# --- architecture ----------------------------------------------------------------------------


def test_every_module_of_the_table_exists() -> None:
    table = text_of(ROOT / "docs" / "architecture.md").split("| layer |")[1].split("\n\n")[0]
    existing = {path.stem for path in PACKAGE.rglob("*.py")}
    cells = [row.split("|")[2] for row in table.splitlines()[2:]]
    named = set(re.findall(r"`(\w+)`", " ".join(cells)))
    assert named
    assert named <= existing
