"""On and in the visual hull, for images with alpha."""

from __future__ import annotations

import numpy as np

from mi_refgs.data import hull
from mi_refgs.methods.extensions import Initialiser, Start, Wanted, register_initialiser
from mi_refgs.surfels import init


def on_hull(wanted: Wanted) -> Start | None:
    """Points uniform on the hull's surface with its normals; a share uniform in its volume, since concave
    surfaces lie inside. Raises InputError if the masks have no point in common."""
    data, rng = wanted.data, wanted.rng
    if not data.has_alpha:
        return None
    views, behind = data.views, data.background
    shape = hull.visual_hull(views, hull.camera_bounds(views))
    inner = shape.inner_points(round(wanted.share * wanted.count), rng)
    outer, facing = shape.surface_points(wanted.count - len(inner), rng)
    normals = np.concatenate([facing, init.random_normals(len(inner), rng)])
    # Points inside face no view in particular: every view counts.
    colours = [hull.median_colours(outer, views, behind, facing), hull.median_colours(inner, views, behind)]
    return Start(np.concatenate([outer, inner]), np.concatenate(colours), normals)


register_initialiser(Initialiser("hull", on_hull))
