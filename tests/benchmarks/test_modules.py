"""Every module of the benchmarks can be imported."""

import importlib

import pytest

from tests.helpers import ROOT

MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "benchmarks").rglob("*.py")
    if path.name != "__init__.py"
)


@pytest.mark.parametrize("name", MODULES)
def test_module_is_imported(name: str) -> None:
    assert importlib.import_module(name).__doc__
