# SPDX-License-Identifier: Apache-2.0
"""The mutation run finds the constants, changes nothing else, and its named tests exist."""

import mutations


def test_constants_are_found_and_changed_alone() -> None:
    found = set(mutations.constants("gates")) | set(mutations.constants("scales"))
    assert {"REST_NOISE", "REST_SWAY", "IN_A_ROW"} <= found
    assert "SIGNALS" not in found  # not a number
    source = (mutations.ROOT / mutations.path_of("scales")).read_text(encoding="utf-8")
    changed = mutations.mutated(source, "IN_A_ROW", 2.0)
    before, after = source.splitlines(), changed.splitlines()
    different = [(a, b) for a, b in zip(before, after, strict=True) if a != b]
    assert different == [("IN_A_ROW = 5", "IN_A_ROW = type(5)(5 * 2.0)")]
    namespace: dict[str, object] = {}
    exec(different[0][1], namespace)
    assert namespace["IN_A_ROW"] == 10


def test_the_tests_named_exist() -> None:
    for module in mutations.TESTS:
        assert len(mutations.tests_of(module)) == len(mutations.TESTS[module]), module
    assert mutations.tests_of("plausibility")
