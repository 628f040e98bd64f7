"""The script for a machine with a GPU: its small instance on the CPU, and a step that takes too long."""

from pathlib import Path

from benchmarks.common.build import read_result
from tests.helpers import completed


def test_small_instance(tmp_path: Path) -> None:
    completed("-m", "benchmarks.gpu", tmp_path, "--small", "gsplat", "splat", "volprim")
    steps = read_result(tmp_path / "gpu.json")["steps"]
    (ours,), (theirs,) = steps["splat"], steps["volprim"]
    assert 0 < ours["kernels_both"]["ms"] and 0.2 < ours["mean_alpha"] < 0.6
    assert ours["both_ms"] > 0 and theirs["both_ms"] > 0 and steps["gsplat"] == []
