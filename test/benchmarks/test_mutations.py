# SPDX-License-Identifier: Apache-2.0
"""The mutation run: it finds the constants, changes one at a time, and its tests exist."""

from pathlib import Path

import mutations
import pytest

LIMIT = 40
"""Largest number of constants of the core."""


def constants(module: str) -> set[str]:
    return {*mutations.constants(f"{mutations.CORE}.{module}")}


def test_constants_are_found_and_one_line_changes() -> None:
    found = constants("flow") | constants("scales") | constants("gates")
    assert {"ATTITUDE_GAIN", "IN_A_ROW"} <= found
    assert "IMU_SIGNALS" not in found  # not a number
    path = mutations.ROOT / mutations.path_of("identification.scales")
    source = path.read_text(encoding="utf-8")
    changed = mutations.mutated(source, "IN_A_ROW", 2.0)
    before, after = source.splitlines(), changed.splitlines()
    different = [(a, b) for a, b in zip(before, after, strict=True) if a != b]
    assert len(different) == 1
    assert different[0][1].startswith("IN_A_ROW = 5; ")
    namespace: dict[str, object] = {}
    exec(different[0][1], namespace)
    assert namespace["IN_A_ROW"] == 10


@pytest.mark.parametrize(
    ("declared", "changed"),
    [("A = 3.0", 1.5), ("A: float = 3.0", 1.5), ("A = 4", 2), ("B, A = 1, 8", 4),
     ('A = {"x": 1.0}', {"x": 0.5}), ("A = (2.0, 4.0)", (1.0, 2.0))],
)  # fmt: skip
def test_every_form_of_a_constant_is_changed(declared: str, changed: object) -> None:
    namespace: dict[str, object] = {}
    exec(mutations.mutated(f"{declared}\nC = A\n", "A", 0.5), namespace)
    assert namespace["C"] == changed


def test_derived_and_physical_values_are_not_mutated() -> None:
    assert "OUTLYING" not in constants("scales")  # the square of SURE
    assert "GRAVITY" not in constants("model")
    assert "LARGEST_RATE" not in constants("model")  # the score is clipped there
    assert "STEP" in constants("scales")


def test_the_core_stays_within_the_limit_of_constants() -> None:
    modules = mutations.modules_of(mutations.CORE)
    assert sum(len(list(mutations.constants(module))) for module in modules) <= LIMIT


def test_the_named_tests_exist() -> None:
    modules = [*mutations.modules_of(mutations.CORE), *mutations.modules_of(mutations.CONTROL)]
    named = {m: tests for m in modules if (tests := mutations.TESTS.get(m.rpartition(".")[2]))}
    assert len(named) == len(mutations.TESTS)
    for module, tests in named.items():
        assert len(mutations.tests_of(module)) == len(tests), module
    assert mutations.tests_of("identification.plausibility")


def test_rate_control_is_mutated_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert mutations.main(["control", "--list"]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert {"control.laws.MAX_INTERVAL", "control.effectiveness.CERTAIN"} <= {*listed}
    for module in mutations.modules_of(mutations.CONTROL):
        assert not {*mutations.constants(module)} or mutations.tests_of(module), module


def test_a_name_that_is_gone_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert mutations.stale() == []
    monkeypatch.setitem(mutations.TESTS, "former", ("test_gates.py", "test_former.py"))
    monkeypatch.setitem(mutations.GIVEN, "nothing", {"FORMER"})
    assert mutations.main(["--list"]) == 1
    assert "do not exist: FORMER, former, test_former.py" in capsys.readouterr().out


def test_the_test_that_notices_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "test" / "identification"
    folder.mkdir(parents=True)
    (folder / "test_one.py").write_text("def test_a(): pass\ndef test_b(): assert 1 == 2\n")
    tests = ["test/identification/test_one.py"]
    assert mutations.noticing(tmp_path, tests) == "test_one.py::test_b"
    (folder / "test_one.py").write_text("def test_a(): pass\n")
    assert mutations.noticing(tmp_path, tests) == ""
