"""The surfels a fit starts from: on the visual hull where pictures have alpha, else at random."""

from __future__ import annotations

import numpy as np

from mi_refgs.fit.config import Method
from mi_refgs.fit.data import Dataset, View
from mi_refgs.images import linear_from_srgb
from mi_refgs.surfels import init
from mi_refgs.surfels.order import along_curve
from mi_refgs.surfels.table import GEOMETRY, Surfels


def initial_surfels(method: Method, data: Dataset, rng: np.random.Generator) -> Surfels:
    """A table of `method.surfels.count` surfels with the method's channels.

    On the hull, surfels take its normals. Colours are the median over the views that see the point.

    Raises InputError where the masks have no point in common.
    """
    options = method.surfels
    views = [_view(view, data) for view in data.views]
    bounds = init.camera_bounds(views)
    normals = None
    if all(view.alpha is not None for view in data.views):
        points, normals = init.visual_hull_points(views, options.count, bounds, rng)
    else:
        points = init.random_points(options.count, bounds, rng)
    order = along_curve(points)
    points, normals = points[order], None if normals is None else normals[order]
    return init.from_points(
        points,
        normals,
        init.mean_colours(points, views, normals),
        rng=rng,
        channels=(*GEOMETRY, *options.channels),
        sh_degree=options.sh_degree,
        indirect_degree=options.indirect_degree,
        opacity=options.opacity,
        metallic=options.metallic,
        roughness=options.roughness,
    )


def _view(view: View, data: Dataset) -> init.View:
    alpha = np.ones(view.image.shape[:2], np.float32) if view.alpha is None else view.alpha
    covered = np.maximum(alpha, 1e-3)[..., None]
    colour = np.clip((view.image - (1 - alpha[..., None]) * data.background) / covered, 0, None)
    colour = colour if data.linear else linear_from_srgb(np.clip(colour, 0, 1))
    return init.View(-view.fx, -view.fy, view.cx, view.cy, view.to_world, alpha, colour.astype(np.float32))
