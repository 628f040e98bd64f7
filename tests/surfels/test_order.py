"""The order of the table: a permutation that puts neighbours next to each other."""

from __future__ import annotations

import numpy as np
import pytest

from mi_refgs.surfels.order import morton_order


def steps(points: np.ndarray) -> float:
    """Mean distance from a row to the next."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).mean())


@pytest.mark.parametrize("outlier", [False, True])
def test_neighbours_stand_together(rng: np.random.Generator, outlier: bool) -> None:
    """Along the curve one walks a cell's width a step, 1/16 of the edge for 4096 points."""
    points = rng.uniform(-1, 3, (4096, 3)).astype(np.float32)
    if outlier:
        points[7] = 1e6
    order = morton_order(points)
    assert sorted(order) == list(range(4096))
    kept = points[order][:-1] if outlier else points[order]
    assert steps(kept) < 0.15 * 4 < 0.4 * steps(rng.uniform(-1, 3, (4096, 3)))


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.ones((1, 3)), np.ones((5, 3))])
def test_points_without_extent_keep_their_order(points: np.ndarray) -> None:
    np.testing.assert_array_equal(morton_order(points), np.arange(len(points)))
