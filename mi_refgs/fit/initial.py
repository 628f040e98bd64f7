"""The surfels a fit starts from: on and inside the visual hull where pictures have alpha, else at random."""

from __future__ import annotations

import numpy as np

from mi_refgs.data.dataset import Dataset, View
from mi_refgs.errors import InputError
from mi_refgs.images import linear_from_srgb
from mi_refgs.methods.method import Method
from mi_refgs.surfels import hull, init
from mi_refgs.surfels.order import morton_order
from mi_refgs.surfels.table import Surfels


def initial_surfels(method: Method, data: Dataset, rng: np.random.Generator) -> Surfels:
    """A table of `method.surfels.count` surfels with the method's channels.

    With alpha, a share `inside` of them is uniform in the hull's volume with normals at random, and the
    others are uniform on its surface with its normals: the surface of what is concave lies inside the hull.
    Colours are the median over the views that see the point.

    Raises InputError where the masks have no point in common, and for a share that is none.
    """
    options = method.surfels
    if not 0 <= options.inside <= 1:
        raise InputError(f"method: surfels.inside: {options.inside} is no share; give a number from 0 to 1")
    views = [_view(view, data) for view in data.views]
    bounds = hull.camera_bounds(views)
    if all(view.alpha is not None for view in data.views):
        shape = hull.visual_hull(views, bounds)
        inner = shape.inner_points(round(options.inside * options.count), rng)
        outer, facing = shape.surface_points(options.count - len(inner), rng)
        points = np.concatenate([outer, inner])
        normals = np.concatenate([facing, init.random_normals(len(inner), rng)])
        # What lies inside has no side to be seen from: every view of it votes.
        colours = np.concatenate(
            [hull.median_colours(outer, views, facing), hull.median_colours(inner, views)]
        )
    else:
        points = hull.random_points(options.count, bounds, rng)
        normals = init.random_normals(options.count, rng)
        colours = hull.median_colours(points, views)
    order = morton_order(points)
    return init.from_points(
        points[order],
        normals[order],
        colours[order],
        rng=rng,
        channels=options.channels,
        degree={name: options.degree_of(name) for name in options.channels},
        **options.initial,
    )


def _view(view: View, data: Dataset) -> hull.View:
    alpha = np.ones(view.image.shape[:2], np.float32) if view.alpha is None else view.alpha
    covered = np.maximum(alpha, 1e-3)[..., None]
    colour = np.clip((view.image - (1 - alpha[..., None]) * data.background) / covered, 0, None)
    colour = colour if data.linear else linear_from_srgb(np.clip(colour, 0, 1))
    return hull.View(-view.fx, -view.fy, view.cx, view.cy, view.to_world, alpha, colour.astype(np.float32))
