# SPDX-License-Identifier: Apache-2.0
"""YAML as it stands in a file: every scalar is its text, and no key is there twice."""

from __future__ import annotations

from typing import Any

import yaml


class StrictLoader(yaml.BaseLoader):
    """A loader of text, mappings and lists; whoever reads them says what a text means."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Return a mapping; raises a YAMLError if a key is there twice."""
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(
                    None, None, "a key must be a plain name", key.start_mark
                )
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"'{key.value}' is there twice", key.start_mark
                )
            seen.add(key.value)
        return dict(super().construct_mapping(node, deep))


def yaml_problem(error: yaml.YAMLError) -> str:
    """Say in a line what is wrong with a text, and in which line of it."""
    if isinstance(error, yaml.MarkedYAMLError):
        mark = error.problem_mark or error.context_mark
        return f"line {mark.line + 1 if mark else 1}: {error.problem or error.context}"
    return str(error).splitlines()[0]
