"""The small instance of the benchmark that a test module names as its BENCHMARK."""

from typing import Any

import pytest

from benchmarks import pages, plots
from benchmarks.common.build import read_result
from tests.helpers import completed


@pytest.fixture(scope="module")
def result(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Its JSON, which has every name that the pages' markers require, and from which its plot is drawn."""
    name = request.module.BENCHMARK
    folder = tmp_path_factory.mktemp(name)
    completed("-W", "error", "-m", f"benchmarks.{name}", "--small", "--quiet", "-o", folder)
    path = folder / f"{name}.json"
    assert pages.names_of(name) <= pages.values(path).keys()
    for plot in (plot for plot in plots.PLOTS if plot.startswith(name)):
        drawn = plots.draw(plot, folder, folder)
        assert drawn is not None and drawn.stat().st_size > 10_000
    return read_result(path)
