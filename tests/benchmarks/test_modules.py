"""Every module of the benchmarks can be imported, and every command prints its help."""

from __future__ import annotations

import importlib
from typing import Any

import pytest

from tests.helpers import ROOT

MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "benchmarks").rglob("*.py")
    if path.name != "__init__.py"
)
LABORATORIES = ("memory", "splatting", "splitsum", "stability", "visibility")


@pytest.mark.parametrize("name", MODULES)
def test_module_is_imported(name: str) -> None:
    assert importlib.import_module(name).__doc__


@pytest.mark.parametrize("name", LABORATORIES)
def test_help_is_printed(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    command: Any = importlib.import_module(f"benchmarks.{name}.__main__").main
    with pytest.raises(SystemExit):
        command(["--help"])
    assert f"python -m benchmarks.{name}" in capsys.readouterr().out
