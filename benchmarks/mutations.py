# SPDX-License-Identifier: Apache-2.0
"""Whether a test notices each constant: ``python benchmarks/mutations.py [MODULE ...]``.

Every number that a module of the core declares by a name in capitals is halved and doubled in turn,
in a copy of the repository, and the quick tests of that module are run. A constant that no test
notices is one that nobody can defend: give it a test, or do without it.
"""

from __future__ import annotations

import argparse
import ast
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CORE = Path("uav_ident_ros") / "identification"
COPIED = ("uav_ident_ros", "test", "benchmarks", "config", "pyproject.toml")

TESTS: dict[str, tuple[str, ...]] = {
    "gates": ("test_gates.py",),
    "drops": ("test_stamps.py", "test_properties.py"),
    "running_fit": ("test_supervision.py",),
    "model": ("test_estimators.py", "test_conditioning.py"),
    "identifier": ("test_estimators.py", "test_resume.py"),
}
"""Quick tests of a module, in test/identification, where it is not test_MODULE.py alone."""

FACTORS = (0.5, 2.0)
LONGEST = 900.0
"""Time after which a run counts as noticed, s: a constant that makes the tests hang is."""


@dataclass(frozen=True)
class Constant:
    """A number with a name."""

    module: str  # Module of the core, with a dot for a folder
    name: str  # Its name
    # line, column, end_line, end_column: Where its value stands in the source
    line: int
    column: int
    end_line: int
    end_column: int


def path_of(module: str) -> Path:
    """Return the file of a module of the core."""
    return CORE / Path(*module.split(".")).with_suffix(".py")


def constants(module: str) -> Iterator[Constant]:
    """Yield the numbers that a module declares by names in capitals."""
    tree = ast.parse((ROOT / path_of(module)).read_text(encoding="utf-8"))
    for node in tree.body:
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        value = getattr(node, "value", None)
        if not isinstance(target, ast.Name) or not target.id.isupper() or value is None:
            continue
        if _is_number(value):
            yield Constant(
                module, target.id, value.lineno, value.col_offset,
                value.end_lineno or value.lineno, value.end_col_offset or 0,
            )  # fmt: skip


def _is_number(node: ast.expr) -> bool:
    """Whether an expression is made of numbers alone."""
    numbers = [n for n in ast.walk(node) if isinstance(n, ast.Constant)]
    others = (ast.Constant, ast.UnaryOp, ast.BinOp, ast.operator, ast.unaryop)
    plain = all(isinstance(n, others) for n in ast.walk(node))
    return bool(numbers) and plain and all(type(n.value) in (int, float) for n in numbers)


def mutated(source: str, constant: Constant, factor: float) -> str:
    """Return the source with the constant multiplied; whole numbers stay whole."""
    lines = source.splitlines(keepends=True)
    first, last = constant.line - 1, constant.end_line - 1
    before, after = lines[first][: constant.column], lines[last][constant.end_column :]
    inside = "".join(lines[first : last + 1])
    value = inside[constant.column : len(inside) - len(after)]
    product = f"type({value})({value} * {factor})"
    return "".join([*lines[:first], f"{before}{product}{after}", *lines[last + 1 :]])


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
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
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
                if options.constants and constant.name not in options.constants:
                    continue
                missed = []
                for factor in FACTORS:
                    (folder / path_of(module)).write_text(mutated(source, constant, factor))
                    if not tests or not notices(folder, tests):
                        missed.append(f"x {factor:g}")
                (folder / path_of(module)).write_text(source)
                tried, unnoticed = tried + 1, unnoticed + bool(missed)
                said = f"NOT NOTICED {', '.join(missed)}" if missed else "noticed"
                print(f"{module}.{constant.name}: {said}", flush=True)
    print(f"{tried} constants, {unnoticed} of them unnoticed")
    return int(unnoticed > 0)


if __name__ == "__main__":
    sys.exit(main())
