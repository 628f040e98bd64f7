"""Surfels on a mesh or on Mitsuba shapes, with the normals and materials that are known there."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mi_refgs.surfels.attributes import attribute, logit
from mi_refgs.surfels.init import even_points, from_points
from mi_refgs.surfels.table import Surfels
from mi_refgs.synthesis.ground_truth import materials_at, surface_mesh
from mi_refgs.synthesis.settings import scene_of

NO_HOLES = 0.7  # `scale_factor` of evenly spread points from which alpha is above 0.95 everywhere inside
ABOVE = 1e-3  # extents of the mesh above a point from which its BSDF is looked up: tessellations are inside


def surfels_from_mesh(mesh: Any, count: int, *, seed: int = 0, **options: Any) -> Surfels:
    """Surfels evenly spread on a surface, of a size that leaves no holes.

    mesh: an `mi.Scene`, its shapes or one of them, whose shading normals, and albedo, roughness and metallic
    where their BSDFs and textures define them, are taken; or anything with `vertices` (V, 3) and `faces` (F,
    3), world, such as a `Mesh` or a trimesh. options: of `from_points`, such as attributes, opacity (default:
    0.99), or values in place of the BSDF's. Raises InputError for a shape that cannot be tessellated, a
    surface without area, and as `from_points` does."""
    rng = np.random.default_rng(seed)
    materials: dict[str, np.ndarray] = {}
    if hasattr(mesh, "faces") and hasattr(mesh, "vertices"):
        points, normals = even_points(mesh.vertices, mesh.faces, count, rng)
    else:
        shapes = mesh.shapes() if hasattr(mesh, "shapes") else mesh if isinstance(mesh, Sequence) else [mesh]
        points, normals, materials = _on_shapes(shapes, count, rng)
    defaults = {"opacity": 0.99, "scale_factor": NO_HOLES}
    surfels = from_points(points, normals, rng=rng, **defaults | options)
    known = {name: logit(x) for name, x in materials.items() if surfels.has(name) and name not in options}
    return Surfels.from_numpy(surfels.to_numpy() | known)


def _on_shapes(
    shapes: Sequence[Any], count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Points, normals (N, 3) and materials (N, C) of shapes, found by rays from right above the surface."""
    import mitsuba as mi

    points, normals = even_points(*surface_mesh(shapes), count, rng)
    above = points + ABOVE * float(np.ptp(points, axis=0).max()) * normals
    origin, towards = (np.ascontiguousarray(x.T, np.float32) for x in (above, -normals))
    scene = scene_of(shapes)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(towards)))
    hit = np.array(si.is_valid())[:, None]
    points, normals = np.where(hit, si.p.numpy().T, points), np.where(hit, si.sh_frame.n.numpy().T, normals)
    found = {}
    for name, (value, known) in materials_at(scene, si)._asdict().items():
        values = np.broadcast_to(np.atleast_2d(np.array(value)), (attribute(name).widths[0], count)).T
        known = np.broadcast_to(np.array(known), count)[:, None] & hit
        found[name] = np.where(known, values, attribute(name).initial)
    return points, normals, found
