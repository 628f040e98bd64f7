"""The benchmark of whole frames, as a small instance."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import endtoend
from benchmarks.common.build import read_result


@pytest.mark.slow
def test_errors_have_parts_and_fall_with_samples(tmp_path: Path) -> None:
    assert endtoend.main(["--small", "--quiet", "-o", str(tmp_path)]) == 0
    refgs, coarse, fine = read_result(tmp_path / "endtoend.json")["rows"]
    assert fine["error"] < coarse["error"] and fine["gradient_error"] < coarse["gradient_error"]
    # Shading at the mesh's hits is the frame without errors of geometry: no part is larger than the sum.
    assert refgs["shading"] < refgs["error"] < refgs["shading"] + refgs["geometry"] < 1
