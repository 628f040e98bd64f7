"""Points on the surfaces that a fit shows, from its rendered depth."""

from __future__ import annotations

import numpy as np

from mi_refgs.data.images import Pixels
from mi_refgs.data.view import View
from mi_refgs.fitting.events.follow_object import surface_points
from mi_refgs.reference.camera import look_at

ORIGIN, TARGET = np.array([3.0, -2.0, 1.5]), np.array([0.2, 0.1, -0.3])


def test_points_are_where_depth_is_level_and_opaque() -> None:
    """A near square in front of a far plane, without the mixed depths at its outline and a hole."""
    pose, pixels = look_at(ORIGIN, TARGET), Pixels(np.zeros((40, 60, 3), np.float32))
    view = View("v", 60, 40, 70.0, 75.0, 28.0, 21.0, pose, pixels)
    depth, alpha = np.full((40, 60), 6.0), np.ones((40, 60))
    depth[10:20, 20:30] = 3.0
    depth[9, 20:30] = np.linspace(3.5, 5.5, 10)
    alpha[30:35, 40:50] = 0.3
    points = surface_points(view, depth.ravel(), alpha.ravel(), 1.0)
    row, column, seen = view.project(points)
    along = (points - ORIGIN) @ pose[:3, 2]
    assert seen.all() and {*np.round(along, 6)} == {3.0, 6.0}
    found = np.zeros((40, 60), bool)
    found[np.rint(row).astype(int), np.rint(column).astype(int)] = True
    assert found[10:20, 20:30].all() and not found[9, 20:30].any() and not found[30:35, 40:50].any()
    assert np.sum(~found) < 10 + 50 + 12
