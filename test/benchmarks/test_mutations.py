# SPDX-License-Identifier: Apache-2.0
"""The mutation run finds the constants, changes nothing else, and its named tests exist."""

import mutations


def test_constants_are_found_and_changed_alone() -> None:
    found = set(mutations.constants("gates"))
    assert {"REST_NOISE", "HOLD_TIME", "LONGEST_GLITCH"} <= found
    assert "SIGNALS" not in found  # not a number
    source = (mutations.ROOT / mutations.path_of("gates")).read_text(encoding="utf-8")
    changed = mutations.mutated(source, "LONGEST_GLITCH", 2.0)
    before, after = source.splitlines(), changed.splitlines()
    different = [(a, b) for a, b in zip(before, after, strict=True) if a != b]
    assert different == [("LONGEST_GLITCH = 3", "LONGEST_GLITCH = type(3)(3 * 2.0)")]
    namespace: dict[str, object] = {}
    exec(different[0][1], namespace)
    assert namespace["LONGEST_GLITCH"] == 6


def test_the_tests_named_exist() -> None:
    for module in mutations.TESTS:
        assert len(mutations.tests_of(module)) == len(mutations.TESTS[module]), module
    assert mutations.tests_of("plausibility")
