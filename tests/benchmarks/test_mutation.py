"""The planted mistakes can be planted, and their tests exist. `python -m benchmarks.mutation` runs them."""

from __future__ import annotations

import ast
from functools import cache

from benchmarks.mutation.planting import catalogue, mutated
from tests.benchmarks.benchmark_runs import ROOT

MISTAKES = catalogue()
WITHOUT_MISTAKES = {"gallery", "reference"}
"""Pictures of the documentation, and the float64 reference that the others are tested against."""


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


def test_names_are_unique() -> None:
    names = [mistake.name for mistake in MISTAKES]
    assert sorted(set(names)) == sorted(names)


def test_every_package_has_mistakes() -> None:
    """A new package gets some, or is listed as one that computes nothing of its own."""
    packages = {path.parent.name for path in (ROOT / "mi_refgs").glob("*/__init__.py")}
    assert packages - {mistake.file.split("/")[1] for mistake in MISTAKES} <= WITHOUT_MISTAKES
