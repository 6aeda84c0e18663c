# SPDX-License-Identifier: Apache-2.0
"""Whether a test notices each constant: ``python benchmarks/mutations.py [MODULE ...]``.

Every number that a module of the core declares by a name in capitals is halved and doubled in turn,
in a copy of the repository, and the quick tests of that module are run. A constant that no test
notices is one that nobody can defend: give it a test, or do without it.
"""

import ast
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import bench
from bench import ROOT

CORE = Path("uav_ident_ros") / "identification"
COPIED = ("uav_ident_ros", "test", "benchmarks", "config", "pyproject.toml")

TESTS: dict[str, tuple[str, ...]] = {
    "gates": ("test_gates.py",),
    "intake": ("test_stamps.py", "test_properties.py"),
    "running_fit": ("test_supervision.py",),
    "model": ("test_estimators.py", "test_conditioning.py"),
    "samples": ("test_samples.py", "test_sampling.py", "test_speed.py"),
    "parallel_model": ("test_injected.py",),
    "scales": ("test_estimators.py", "test_gates.py", "test_noise.py", "test_supervision.py"),
    "identifier": ("test_estimators.py", "test_resume.py"),
}
"""Quick tests of a module, in test/identification, where it is not test_MODULE.py alone."""

FACTORS = (0.5, 2.0)
LONGEST = 900.0
"""Time after which a run counts as noticed, s: a constant that makes the tests hang is."""


def path_of(module: str) -> Path:
    """Return the file of a module of the core."""
    return CORE / Path(*module.split(".")).with_suffix(".py")


def constants(module: str) -> Iterator[str]:
    """Yield the numbers that a module declares by names in capitals."""
    for name, value in _declared(ast.parse((ROOT / path_of(module)).read_text(encoding="utf-8"))):
        numbers = [n for n in ast.walk(value) if isinstance(n, ast.Constant)]
        others = (ast.Constant, ast.UnaryOp, ast.BinOp, ast.operator, ast.unaryop)
        plain = all(isinstance(n, others) for n in ast.walk(value))
        if numbers and plain and all(type(n.value) in (int, float) for n in numbers):
            yield name


def _declared(tree: ast.Module) -> Iterator[tuple[str, ast.expr]]:
    for node in tree.body:
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        value = getattr(node, "value", None)
        if isinstance(target, ast.Name) and target.id.isupper() and value is not None:
            yield target.id, value


def mutated(source: str, constant: str, factor: float) -> str:
    """Return the source with a constant multiplied; whole numbers stay whole."""
    value = dict(_declared(ast.parse(source)))[constant]
    text = ast.get_source_segment(source, value)
    assert text is not None
    lines = source.splitlines(keepends=True)
    begin = len("".join(lines[: value.lineno - 1])) + value.col_offset
    product = f"type({text})({text} * {factor})"
    return f"{source[:begin]}{product}{source[begin + len(text) :]}"


def notices(folder: Path, tests: Sequence[str]) -> bool:
    """Whether a test fails in a copy of the repository."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, timeout=LONGEST
        )
    except subprocess.TimeoutExpired:
        return True
    return done.returncode != 0


def tests_of(module: str) -> tuple[str, ...]:
    """Return the quick tests of a module; none if it has none."""
    name = module.rpartition(".")[2]
    names = TESTS.get(name, (f"test_{name}.py",))
    found = [Path("test") / "identification" / test for test in names]
    return tuple(str(test) for test in found if (ROOT / test).exists())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the mutations; the status is 1 if one goes unnoticed."""
    parser = bench.parser(__doc__)
    parser.add_argument("modules", nargs="*", help="modules of the core (all)")
    parser.add_argument("--constants", nargs="+", help="these alone")
    options = parser.parse_args(arguments)
    every = [p.relative_to(ROOT / CORE) for p in sorted((ROOT / CORE).rglob("*.py"))]
    modules = options.modules or [".".join(p.with_suffix("").parts) for p in every]
    unnoticed = tried = 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for name in COPIED:
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            copy(ROOT / name, folder / name)
        for module in modules:
            source, tests = (ROOT / path_of(module)).read_text(encoding="utf-8"), tests_of(module)
            for constant in constants(module):
                if options.constants and constant not in options.constants:
                    continue
                missed = []
                for factor in FACTORS:
                    (folder / path_of(module)).write_text(mutated(source, constant, factor))
                    if not tests or not notices(folder, tests):
                        missed.append(f"x {factor:g}")
                (folder / path_of(module)).write_text(source)
                tried, unnoticed = tried + 1, unnoticed + bool(missed)
                printed = f"NOT NOTICED {', '.join(missed)}" if missed else "noticed"
                print(f"{module}.{constant}: {printed}", flush=True)
    print(f"{tried} constants, {unnoticed} of them unnoticed")
    return int(unnoticed > 0)


if __name__ == "__main__":
    sys.exit(main())
