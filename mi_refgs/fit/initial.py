"""The surfels a fit starts from: on and inside the visual hull where pictures have alpha, else at random."""

from __future__ import annotations

from typing import Any

import numpy as np

from mi_refgs.data import hull
from mi_refgs.data.dataset import Dataset
from mi_refgs.errors import InputError
from mi_refgs.methods.method import Method
from mi_refgs.surfels import init
from mi_refgs.surfels.order import morton_order
from mi_refgs.surfels.table import Surfels

ALBEDO_RANGE = (0.02, 0.9)
"""Where an albedo from pictures starts: away from the ends, where the sigmoid has no slope."""


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
    views, behind = data.views, data.background
    if all(view.alpha is not None for view in views):
        shape = hull.visual_hull(views, hull.camera_bounds(views))
        inner = shape.inner_points(round(options.inside * options.count), rng)
        outer, facing = shape.surface_points(options.count - len(inner), rng)
        points = np.concatenate([outer, inner])
        normals = np.concatenate([facing, init.random_normals(len(inner), rng)])
        # What lies inside has no side to be seen from: every view of it votes.
        colours = np.concatenate(
            [hull.median_colours(outer, views, behind, facing), hull.median_colours(inner, views, behind)]
        )
    elif data.points is not None and len(data.points.position):
        known_points = data.points.position
        row = rng.permutation(np.arange(options.count) % len(known_points))
        # Copies of a point lie around it, as far off as its neighbours do: their distance is a surfel's size.
        spread = init.neighbour_scale(known_points)[row] * (len(known_points) < options.count)
        points = known_points[row] + spread[:, None] * rng.normal(size=(options.count, 3))
        normals = init.random_normals(options.count, rng)
        known = data.points.colour
        colours = hull.median_colours(points, views, behind) if known is None else known[row]
    else:
        points = hull.random_points(options.count, hull.camera_bounds(views), rng)
        normals = init.random_normals(options.count, rng)
        colours = hull.median_colours(points, views, behind)
    order = morton_order(points)
    from_pictures: dict[str, Any] = {}
    if "albedo" in options.from_pictures and method.light is not None:
        # The hue alone: how bright a place is, is left to the light until it has been found.
        brightest = colours[order].max(axis=1, keepdims=True)
        hue = np.where(brightest > 0, colours[order] / np.maximum(brightest, 1e-9), 1)
        from_pictures["albedo"] = np.clip(hue * options.start("albedo"), *ALBEDO_RANGE)
    return init.from_points(
        points[order],
        normals[order],
        colours[order],
        rng=rng,
        primitive=options.primitive,
        channels=options.channels,
        degree={name: options.degree_of(name) for name in options.channels},
        **(options.initial | from_pictures),
    )
