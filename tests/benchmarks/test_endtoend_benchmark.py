"""The benchmark of whole frames, as a small instance."""

from typing import Any

import pytest

BENCHMARK = "endtoend"


@pytest.mark.slow
def test_errors_have_parts_and_fall_with_samples(result: dict[str, Any]) -> None:
    refgs, coarse, fine = result["rows"]
    assert fine["error"] < coarse["error"] and fine["gradient_error"] < coarse["gradient_error"]
    # Shading at the mesh's hits is the frame without errors of geometry: no part is larger than the sum.
    assert refgs["shading"] < refgs["error"] < refgs["shading"] + refgs["geometry"] < 1
