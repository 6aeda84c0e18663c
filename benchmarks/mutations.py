# SPDX-License-Identifier: Apache-2.0
"""Mutation test of the core's constants: ``python benchmarks/mutations.py [MODULE ...]``.

A module is named from the package, such as ``control.laws``; ``control`` stands for all in it.

In a copy of the repository each number with a name in capitals is halved, then doubled, and the
quick tests of its module run. A constant whose change no test detects needs a test, or must go.
Numbers computed from others, and those in `GIVEN`, do not count; ``--list`` lists the rest.
"""

import ast
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import bench
from bench import ROOT

PACKAGE = Path("uav_ident_ros")
CORE, CONTROL = FOLDERS = ("identification", "control")
COPIED = ("uav_ident_ros", "test", "benchmarks", "scripts", "config", "pyproject.toml")

TESTS: dict[str, tuple[str, ...]] = {
    "gates": ("test_gates.py",),
    "model": ("test_model.py", "test_estimators.py", "test_conditioning.py"),
    "samples": (
        "test_samples.py",
        "test_sampling.py",
        "test_speed.py",
        "test_properties.py",
    ),
    "prior": ("test_prior.py", "test_resume.py", "test_rigid_body.py"),
    "residuals": ("test_noise.py", "test_feedback.py", "test_confirmation.py"),
    "sampling": ("test_sampling.py",),
    "information": ("test_estimators.py",),
    "waveforms": ("test_excitation.py", "test_excitation_run.py"),
    "scales": (
        "test_model.py",
        "test_change.py",
        "test_injected.py",
        "test_noise.py",
        "test_model_error.py",
        "test_gates.py",
        "test_supervision.py",
        "test_estimators.py",
        "test_flow.py",
    ),
    "settings": ("test_settings.py", "test_injected.py"),
    "identifier": ("test_model.py", "test_estimators.py", "test_resume.py"),
    "controller": ("test_laws.py",),
    "sideslip": ("test_laws.py",),
    "effectiveness": ("test_choice.py",),
}
"""Quick tests of a module in its folder of test/, if not just test_MODULE.py."""

GIVEN = {
    "units": {"GRAVITY", "NS", "NS_PER_S"},
    "what a number or a stamp can hold": {
        "LATEST_STAMP", "LEAST_RESIDUAL", "NO_TICK", "NEGLIGIBLE", "POWERLESS", "UNKNOWN",
    },
    "rounding": {"ROUNDING"},
    "mathematics": {
        "DOUBLET_PEAK", "EULER_LIMIT", "EXTRA", "FAILED_PREDICTION", "FEWEST_BLOCKS",
        "EFFECT_HYPOTHESES", "HYPOTHESES", "LARGEST_ANGLE", "LARGEST_DEFLECTION", "ORDER",
        "PASSED", "REVERSED",
    },
    "rigid bodies": {"PRODUCT_SIGMA"},
    "the definition of a wrong derivative, off by half": {"OTHER_EFFECTS"},
    "shapes by their names": {"PULSES", "SENSOR_AXES", "SHAPES"},
    "a unique solution, whatever their size": {"REST"},
    "memory, not results": {"BLOCK"},
    "the definition of the score": {
        "HORIZONS", "INPUT_TIMEOUT", "LARGEST_RATE", "LARGEST_STEP_NS", "LAST_PART", "MAX_GAP",
        "SETTLED_NS",
    },
}  # fmt: skip
"""Names of numbers that are no choice, by their origin."""

FACTORS = (0.5, 2.0)
LONGEST = 900.0
"""Time limit of the tests, s: a change that makes them hang counts as detected."""


def path_of(module: str) -> Path:
    """Return the file of a module."""
    return PACKAGE / Path(*module.split(".")).with_suffix(".py")


def constants(module: str) -> Iterator[str]:
    """Yield the names of a module's chosen numbers, in capitals."""
    given = set().union(*GIVEN.values())
    for name, node in _declared((ROOT / path_of(module)).read_text(encoding="utf-8")).items():
        assert node.value is not None
        inner = list(ast.walk(node.value))
        names = {n.id for n in inner if isinstance(n, ast.Name)}
        types = {type(n.value) for n in inner if isinstance(n, ast.Constant)}
        follows = any(n.isupper() or n == "slice" for n in names)
        if types & {int, float} and not follows and name not in given:
            yield name


def _declared(source: str) -> dict[str, ast.Assign | ast.AnnAssign]:
    """Return the declarations of names in capitals, with or without a type."""
    found: dict[str, ast.Assign | ast.AnnAssign] = {}
    for node in ast.parse(source).body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        for name in target.elts if isinstance(target, ast.Tuple) else [target]:
            # names with an underscore are indices of tables
            if isinstance(name, ast.Name) and name.id.isupper() and name.id[0] != "_":
                found[name.id] = node
    return found


SCALED = (
    "(lambda v: {{k: e * {by} for k, e in v.items()}} if isinstance(v, dict) else "
    "tuple(e * {by} for e in v) if isinstance(v, tuple) else "
    "type(v)(v * {by}) if isinstance(v, int | float) else v * {by})({name})"
)
"""Code that multiplies a number, or every number of a table; integers stay integers."""


def mutated(source: str, constant: str, factor: float) -> str:
    """Return the source with a factor on the declaration of a constant."""
    node = _declared(source)[constant]
    lines = source.splitlines(keepends=True)
    assert node.end_lineno is not None and node.end_col_offset is not None
    end = len("".join(lines[: node.end_lineno - 1])) + node.end_col_offset
    changed = f"; {constant} = {SCALED.format(by=factor, name=constant)}"
    return source[:end] + changed + source[end:]


def noticing(folder: Path, tests: Sequence[str]) -> str:
    """Return the first test that fails in a copy of the repository; empty if none does."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LONGEST
        )
    except subprocess.TimeoutExpired:
        return f"no end in {LONGEST:g} s"
    failed = re.search(r"^(?:FAILED|ERROR) test/\w+/(.+?)(?: - |$)", done.stdout, re.M)
    if failed:
        return failed[1]
    return "" if done.returncode == 0 else f"pytest ended with status {done.returncode}"


def tests_of(module: str) -> tuple[str, ...]:
    """Return the quick tests of a module, possibly none."""
    folder, *_, name = module.split(".")
    found = [Path("test") / folder / test for test in TESTS.get(name, (f"test_{name}.py",))]
    return tuple(str(test) for test in found if (ROOT / test).exists())


def modules_of(folder: str) -> list[str]:
    """Return the names of all modules in a folder of the package, and below it."""
    every = sorted((ROOT / PACKAGE / folder).rglob("*.py"))
    return [".".join(p.relative_to(ROOT / PACKAGE).with_suffix("").parts) for p in every]


def stale() -> list[str]:
    """Return the names in `TESTS` and `GIVEN` that no module and no test has."""
    paths = [path_of(module) for folder in FOLDERS for module in modules_of(folder)]
    declared: set[str] = set()
    for path in paths:
        declared |= set(_declared((ROOT / path).read_text(encoding="utf-8")))
    files = {test for tests in TESTS.values() for test in tests}
    there = {path.name for name in FOLDERS for path in (ROOT / "test" / name).glob("test_*.py")}
    modules = {path.stem for path in paths}
    return sorted({*TESTS} - modules | files - there | set().union(*GIVEN.values()) - declared)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the mutations; return the exit status, 1 if one is not detected."""
    parser = bench.parser(__doc__)
    parser.add_argument("modules", nargs="*", default=[CORE], help=f"modules ({CORE})")
    parser.add_argument("--constants", nargs="+", help="these alone")
    parser.add_argument("--list", action="store_true", help="list the constants, change none")
    options = parser.parse_args(arguments)
    modules = [
        module
        for name in options.modules
        for module in (modules_of(name) if name in FOLDERS else [name])
    ]
    if gone := stale():
        print(f"TESTS and GIVEN have names that do not exist: {', '.join(gone)}; correct them")
        return 1
    if options.list:
        found = {module: list(constants(module)) for module in modules}
        for module, names in found.items():
            print("\n".join(f"{module}.{name}" for name in names), end="\n" * bool(names))
        print(f"{sum(map(len, found.values()))} constants")
        return 0
    unnoticed = tried = 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for name in COPIED:
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            copy(ROOT / name, folder / name)
        for module in modules:
            source, tests = (ROOT / path_of(module)).read_text(encoding="utf-8"), tests_of(module)
            names = [n for n in constants(module) if n in (options.constants or [n])]
            if names and tests and (failing := noticing(folder, tests)):
                print(f"{module}: {failing} fails before anything is changed: it tells nothing")
                return 1
            for constant in names:
                missed = False
                for factor in FACTORS:
                    (folder / path_of(module)).write_text(mutated(source, constant, factor))
                    by = noticing(folder, tests) if tests else ""
                    missed = missed or not by
                    print(f"{module}.{constant} x {factor:g}: {by or 'NOT NOTICED'}", flush=True)
                (folder / path_of(module)).write_text(source)
                tried, unnoticed = tried + 1, unnoticed + missed
    print(f"{tried} constants, {unnoticed} of them unnoticed")
    return int(unnoticed > 0)


if __name__ == "__main__":
    sys.exit(main())
