"""The planted mistakes can be planted, and their tests exist. `python -m benchmarks.mutation` runs them."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from benchmark_runs import ROOT

from benchmarks.mutation.catalogue import MISTAKES
from benchmarks.mutation.planting import Mistake, mutated


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)
def test_a_mistake_changes_what_its_file_does(mistake: Mistake) -> None:
    """What it replaces stands in the file once, and the result is other, valid source."""
    source = mutated(mistake)
    if mistake.file.endswith(".py"):
        before = ast.dump(ast.parse((ROOT / mistake.file).read_text(encoding="utf-8")))
        assert ast.dump(ast.parse(source)) != before


@pytest.mark.parametrize("test", sorted({mistake.test for mistake in MISTAKES}))
def test_its_test_exists(test: str) -> None:
    file, _, name = test.partition("::")
    tree = ast.parse((ROOT / Path(file)).read_text(encoding="utf-8"))
    functions = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    assert not name or name.partition("[")[0] in functions


def test_names_are_unique_and_cover_the_chain() -> None:
    names = [mistake.name for mistake in MISTAKES]
    assert len(set(names)) == len(names)
    assert len(names) >= 60
