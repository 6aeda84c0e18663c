# SPDX-License-Identifier: Apache-2.0
"""The mutation run: it finds the constants, changes one at a time, and its tests exist."""

from pathlib import Path

import mutations
import pytest

LIMIT = 40
"""Largest number of constants of the core."""


def constants(module: str) -> set[str]:
    return {*mutations.constants(f"{mutations.CORE}.{module}")}


def test_chosen_numbers_are_found_and_no_others() -> None:
    found = constants("flow") | constants("scales") | constants("gates") | constants("model")
    assert {"ATTITUDE_GAIN", "IN_A_ROW", "STEP"} <= found
    # no number; the square of SURE; of nature; the score is clipped there
    assert not {"IMU_SIGNALS", "OUTLYING", "GRAVITY", "LARGEST_RATE"} & found


def test_one_line_changes() -> None:
    path = mutations.ROOT / mutations.path_of("identification.scales")
    source = path.read_text(encoding="utf-8")
    changed = mutations.mutated(source, "IN_A_ROW", 2.0)
    before, after = source.splitlines(), changed.splitlines()
    different = [b for a, b in zip(before, after, strict=True) if a != b]
    assert len(different) == 1 and different[0].startswith("IN_A_ROW = 5; ")


@pytest.mark.parametrize(
    ("declared", "changed"),
    [("A = 3.0", 1.5), ("A: float = 3.0", 1.5), ("A = 4", 2), ("B, A = 1, 8", 4),
     ('A = {"x": 1.0}', {"x": 0.5}), ("A = (2.0, 4.0)", (1.0, 2.0))],
)  # fmt: skip
def test_every_form_of_a_constant_is_changed(declared: str, changed: object) -> None:
    namespace: dict[str, object] = {}
    exec(mutations.mutated(f"{declared}\nC = A\n", "A", 0.5), namespace)
    assert namespace["C"] == changed


def test_the_core_stays_within_the_limit_of_constants() -> None:
    modules = mutations.modules_of(mutations.CORE)
    assert sum(len(list(mutations.constants(module))) for module in modules) <= LIMIT


def test_rate_control_is_mutated_too_and_modules_with_constants_have_tests(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert mutations.main(["control", "--list"]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert {"control.laws.MAX_INTERVAL", "control.effectiveness.CERTAIN"} <= {*listed}
    for module in (m for folder in mutations.FOLDERS for m in mutations.modules_of(folder)):
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
