"""Every mutant applies, and its test exists. `python -m benchmarks.mutation` runs them."""

import ast
from functools import cache

from benchmarks.mutation.__main__ import mutated, read_mutants
from tests.helpers import ROOT

MUTANTS = read_mutants()
WITHOUT_MUTANTS = {"reference"}  # the float64 reference that the others are tested against


def test_mutant_changes_its_source() -> None:
    """The replaced text occurs once, and the result is different, valid source."""

    @cache
    def dumped(file: str) -> str:
        return ast.dump(ast.parse((ROOT / file).read_text(encoding="utf-8")))

    for mutant in MUTANTS:
        assert ast.dump(ast.parse(mutated(mutant))) != dumped(mutant.file), mutant.name


def test_named_tests_exist() -> None:
    @cache
    def functions(file: str) -> set[str]:
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}

    for mutant in MUTANTS:
        file, _, name = mutant.test.partition("::")
        assert not name or name.partition("[")[0] in functions(file), mutant.name


def test_every_folder_of_the_package_has_mutants() -> None:
    """A new folder gets mutants, or is listed as one that computes nothing of its own."""
    packages = {path.parent.name for path in (ROOT / "mi_refgs").glob("*/__init__.py")}
    assert packages - {mutant.file.split("/")[1] for mutant in MUTANTS} <= WITHOUT_MUTANTS
