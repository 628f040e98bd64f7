"""A data set of an object in its surroundings: which shapes it is about, its region, its cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.region import Region
from mi_refgs.errors import InputError

REGION_MARGIN = 1.2
"""Radius of the region over that of the object's bounding sphere: room for what stands against it."""


def named_shapes(scene: Any, ids: Sequence[str], file: Path) -> list[Any]:
    """The shapes of a scene with these ids; raises InputError for an id that none has."""
    found = {shape.id(): shape for shape in scene.shapes()}
    missing = [name for name in ids if not name or name not in found]
    if missing:
        known = ", ".join(sorted(name for name in found if name)) or "none"
        raise InputError(
            f"{file}: --shapes: no shape has the id '{missing[0]}'; give one of those there: {known}"
        )
    return [found[name] for name in dict.fromkeys(ids)]


def region_around(centre: np.ndarray, radius: float) -> Region:
    """The region of an object with this bounding sphere."""
    x, y, z = (float(c) for c in centre)
    return Region((x, y, z), REGION_MARGIN * radius)


def check_cameras(scene: Any, objects: Sequence[Any], region: Region, poses: np.ndarray, file: Path) -> None:
    """Raise InputError if a camera (poses (N, 4, 4)) stands in the region, or something hides its middle."""
    import drjit as dr
    import mitsuba as mi

    origin = np.asarray(poses)[:, :3, 3]
    toward = np.array(region.centre) - origin
    distance = np.linalg.norm(toward, axis=1)
    if distance.min() <= region.radius:
        raise InputError(
            f"{file}: --distance: {distance.min():.4g} is inside of the region around the object, whose "
            f"radius is {region.radius:.4g}; give more"
        )
    with dr.suspend_grad():
        ray = mi.Ray3f(
            mi.Point3f(np.ascontiguousarray(origin.T, np.float32)),
            mi.Vector3f(np.ascontiguousarray((toward / distance[:, None]).T, np.float32)),
        )
        hit = scene.ray_intersect_preliminary(ray)
        own = mi.Bool(False)
        for shape in objects:
            own |= hit.shape == mi.ShapePtr(shape)
        hidden = np.array(hit.is_valid() & ~own) & (np.array(hit.t) < distance - region.radius)
    if hidden.any():
        raise InputError(
            f"{file}: --distance: something stands between {int(hidden.sum())} of {len(poses)} cameras and "
            f"the object, at {distance[hidden].min():.4g} … {distance[hidden].max():.4g}; give a shorter "
            "distance, or another --elevation"
        )
