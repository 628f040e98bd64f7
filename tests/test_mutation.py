"""The planted mistakes can be planted, and their tests exist. `python -m benchmarks.mutation` runs them."""

from __future__ import annotations

import ast
from functools import cache

from benchmark_runs import ROOT

from benchmarks.mutation.planting import catalogue, mutated

MISTAKES = catalogue()


def test_a_mistake_changes_what_its_file_does() -> None:
    """What it replaces stands in the file once, and the result is other, valid source."""
    for mistake in MISTAKES:
        before = ast.dump(ast.parse((ROOT / mistake.file).read_text(encoding="utf-8")))
        assert ast.dump(ast.parse(mutated(mistake))) != before, mistake.name


def test_the_tests_exist() -> None:
    @cache
    def functions(file: str) -> set[str]:
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}

    for mistake in MISTAKES:
        file, _, name = mistake.test.partition("::")
        assert not name or name.partition("[")[0] in functions(file), mistake.name


def test_names_are_unique_and_cover_the_chain() -> None:
    names = [mistake.name for mistake in MISTAKES]
    assert len(set(names)) == len(names)
    assert len(names) >= 118
