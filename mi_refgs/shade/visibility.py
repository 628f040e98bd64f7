"""Is the light free in the mirror direction of a pixel?"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.shade.points import reflect, safe_normalize


def mirror_visibility(
    occluder: Occluder, origin: Any, ray: Any, normal: Any, view: Any, covered: Any = True
) -> Any:
    """Is the mirror direction free, seen from where the pixel's ray meets the mesh itself?

    Not from the blended depth: at a silhouette, and between two layers, that lies inside the object and every
    ray from there is blocked, which draws a dark outline. A ray that misses the mesh sees the light, and so
    do pixels that are not `covered`, for which nothing is traced.
    """
    with dr.suspend_grad():
        point, facing, hit = start_on_mesh(occluder, origin, ray, normal, covered)
        visibility = occluder.visible(point, reflect(view=view, normal=facing), facing, hit)
        # Now, once: every kernel of the adjoint that reads it would trace the rays again.
        dr.eval(visibility)
        return visibility


def start_on_mesh(
    occluder: Occluder, origin: Any, ray: Any, normal: Any, covered: Any
) -> tuple[Any, Any, Any]:
    """Where the pixels' rays meet the mesh, the unit normals there, and whether they do."""
    distance, hit = occluder.first_hit(origin, ray, covered)
    return mi.Point3f(mi.Vector3f(origin) + distance * ray), safe_normalize(normal), hit
