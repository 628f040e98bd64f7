"""The small instance of the benchmark that a test module names as its BENCHMARK."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks import pages
from benchmarks.common.build import read_result
from tests.helpers import run_process


@pytest.fixture(scope="module")
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with its output."""
    output = tmp_path_factory.mktemp(request.module.BENCHMARK)
    done = run_process(
        "-W", "error", "-m", f"benchmarks.{request.module.BENCHMARK}", "--small", "--quiet", "-o", output
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return output


@pytest.fixture(scope="module")
def result(request: pytest.FixtureRequest, folder: Path) -> Any:
    """Its JSON, which has every name that the pages' markers want of it."""
    path = folder / f"{request.module.BENCHMARK}.json"
    assert pages.names_of(path.stem) <= pages.values(path).keys()
    return read_result(path)
