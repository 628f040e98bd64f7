"""The region of interest during a fit: once its surfels have the scene's shape, it follows the object.

The rendered depth of some training views gives points on all surfaces, without floaters that others hide.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from mi_refgs.data.object_region import camera_positions, fitted_region, seen_share
from mi_refgs.data.region import Region
from mi_refgs.data.view import View, evenly_spread
from mi_refgs.fitting.schedule import FitSetup
from mi_refgs.fitting.state import FitState
from mi_refgs.render.panorama import SURFACE
from mi_refgs.types import Float

AFTER = 1 / 3  # fraction of the iterations after which the region follows the object
DEPTH_VIEWS = 24  # training views whose depth is rendered
LEVEL = 0.05  # difference of depth, in radii of the region, up to which two pixels show one surface
LEVEL_COUNT = 3  # of the eight neighbours of a pixel; fewer are where an outline mixes near and far

Depth = Callable[[View], tuple[Float, Float]]  # renders camera-z depth and opacity, (H·W) each


def is_due(setup: FitSetup, state: FitState) -> bool:
    """Whether the region is to be adapted now: once, if no user has given one."""
    region = setup.data.region
    open_ = setup.open_scene and region is not None and region.estimated
    return open_ and state.region is None and state.iteration >= AFTER * setup.method.iterations


def followed(setup: FitSetup, depth_of: Depth) -> Region | None:
    """The region around the object that a fit shows; None if it shows no object apart from the scene."""
    region, views = setup.data.region, setup.data.views
    assert region is not None
    shown = [views[i] for i in evenly_spread(len(views), DEPTH_VIEWS)]
    points = np.concatenate([surface_points(view, *depth_of(view), region.radius) for view in shown])
    return fitted_region(region, camera_positions(views), points, partial(seen_share, views))


def surface_points(view: View, depth: Float, alpha: Float, radius: float) -> np.ndarray:
    """World points (P, 3) of the pixels that show a surface; `radius` of the region, scene units."""
    z, opaque = (np.array(x).reshape(view.height, view.width) for x in (depth, alpha))
    around = np.pad(z, 1, constant_values=np.inf)
    shifts = [(row, column) for row in range(3) for column in range(3) if (row, column) != (1, 1)]
    beside = np.stack([around[r : r + view.height, c : c + view.width] for r, c in shifts])
    level = np.count_nonzero(abs(beside - z) < LEVEL * radius, axis=0) >= LEVEL_COUNT
    row, column = np.nonzero((opaque > SURFACE) & level)
    return np.asarray(view.to_world[:3, 3] + view.rays(row, column) * z[row, column, None])
