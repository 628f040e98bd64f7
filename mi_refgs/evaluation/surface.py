"""Distance between a mesh and the true surface, and the concave regions of that surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from scipy.spatial import cKDTree

from mi_refgs.data.view import View
from mi_refgs.kernels.device import upload
from mi_refgs.occlusion.mesh import Mesh, read_mesh
from mi_refgs.occlusion.visibility import OFFSET_VOXELS, Occluder
from mi_refgs.shade.ambient import ambient_direction
from mi_refgs.shade.ggx_sampling import lobe_turn
from mi_refgs.synthesis.settings import SURFACE
from mi_refgs.types import Bool, Float, Point3f, UInt32, Vector3f

OPEN_RAYS = 64  # over the hemisphere of each point: ambient visibility is accurate to 1/64 or better
CONCAVE_BELOW = 0.9
"""Ambient visibility below which a point is concave. It is 1 on a convex object, ½ in a corner of two walls,
1 - h / 2R everywhere inside a spherical cap of height h and radius R."""
QUERIES = 20_000  # points per surface whose distances are averaged
TARGETS = 200_000  # points on a surface among which the nearest are searched
CANDIDATES = 8  # nearest of these points, to whose triangles the distance is computed
GRAZING = 0.1  # cosine to the viewing ray below which a view does not see a point
NEAR_TRUTH = 1.2  # radii of the true surface within which an open scene's mesh is compared with it
SURFACE_KEYS = ("surface_distance", "surface_accuracy", "surface_completeness")
NO_SURFACE = f"the data set has no true surface: {SURFACE}, which `refgs dataset` writes"


class TrueSurface:
    """The true surface of a scene, and rays against it."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh, self.occluder = mesh, Occluder(mesh)

    @staticmethod
    def read(folder: Path, offset: Sequence[float] = (0.0, 0.0, 0.0)) -> TrueSurface | None:
        """Read the surface of a data set, relative to `Dataset.offset`; None where there is none."""
        if not (path := folder / SURFACE).is_file():
            return None
        mesh = read_mesh(path)
        mesh = replace(mesh, vertices=(mesh.vertices - np.array(offset)).astype(np.float32))
        return TrueSurface(mesh) if len(mesh.faces) else None

    def concave(self, view: View) -> np.ndarray | None:
        """Pixels (H, W) of the true surface with visibility below CONCAVE_BELOW; None without truth."""
        if view.depth is None or view.normal is None:
            return None
        camera = view.camera()
        depth = upload(view.depth)
        point = mi.Point3f(camera.origin + camera.rays() * depth)
        normal = mi.Vector3f(view.normal.reshape(-1, 3).T)
        visibility = ambient_visibility(self.occluder, point, normal, depth > 0).numpy()
        return (visibility.reshape(view.depth.shape) < CONCAVE_BELOW) & (view.depth > 0)


def ambient_visibility(occluder: Occluder, point: Point3f, normal: Vector3f, active: Bool = True) -> Float:
    """Return the fraction (P,) of cosine-weighted rays that the mesh does not block; 1 if not `active`."""
    frame, turn = mi.Frame3f(normal), lobe_turn(dr.arange(mi.UInt32, dr.width(normal)))
    count = dr.opaque(mi.UInt32, OPEN_RAYS)
    active = mi.Bool(active) & (dr.squared_norm(normal) > 0)

    def body(index: UInt32, free: Float) -> tuple[UInt32, Float]:
        direction = ambient_direction(frame, turn, index, count)
        return index + 1, free + occluder.visible(point, direction, normal, active)

    start = (mi.UInt32(0), dr.zeros(mi.Float, dr.width(normal)))
    _, free = dr.while_loop(start, lambda i, _: active & (i < count), body, label="ambient_visibility")
    return dr.select(active, free / OPEN_RAYS, 1)


def surface_scores(mesh: Mesh | None, truth: TrueSurface | None, views: Sequence[View]) -> dict[str, Any]:
    """Return the keys of `surface_distance`, None where unknown, and `surface_reason`, which says why."""
    found: dict[str, Any] = dict.fromkeys((*SURFACE_KEYS, *(f"{key}_concave" for key in SURFACE_KEYS)))
    if mesh is None or not len(mesh.faces):
        return found | {"surface_reason": "the run has no mesh"}
    if truth is None:
        return found | {"surface_reason": NO_SURFACE}
    found |= surface_distance(mesh, truth, views)
    unseen = "no view sees both the mesh and the true surface"
    return found | {"surface_reason": unseen if found["surface_distance"] is None else None}


def surface_distance(mesh: Mesh, truth: TrueSurface, views: Sequence[View]) -> dict[str, float]:
    """Compute distances between a mesh and the true surface in percent of the diameter of its bounding
    sphere.

    `surface_accuracy`: mean distance from points of the mesh to the true surface; `surface_completeness`: the
    reverse; `surface_distance`: the mean of both (Chamfer distance); each with `_concave`, of points whose
    nearest true point is concave, if any. Points are spread evenly over the area that some view sees. In an
    open scene (views without alpha) the mesh near the true surface counts, in pixels that show the object."""
    corners = np.asarray(truth.mesh.vertices, np.float64)
    centre = (corners.min(0) + corners.max(0)) / 2
    radius = np.linalg.norm(corners - centre, axis=1).max()
    percent = 100 / (2 * radius)
    if views and not views[0].has_alpha:
        mesh = mesh.of_vertices(np.linalg.norm(mesh.vertices - centre, axis=1) <= NEAR_TRUTH * radius)
        if not len(mesh.faces):
            return {}
    (ours, _), (true, facing) = _seen(mesh, Occluder(mesh), views), _seen(truth.mesh, truth.occluder, views)
    if not len(ours) or not len(true):
        return {}
    result: dict[str, float] = {}
    visibility = ambient_visibility(truth.occluder, mi.Point3f(true.T), mi.Vector3f(facing.T)).numpy()
    nearest = cKDTree(true).query(ours)[1]
    accuracy, completeness = percent * distance_to(truth.mesh, ours), percent * distance_to(mesh, true)
    for suffix, counted in (("", np.ones(len(true), bool)), ("_concave", visibility < CONCAVE_BELOW)):
        if counted[nearest].any():
            means = float(accuracy[counted[nearest]].mean()), float(completeness[counted].mean())
            result[f"surface_accuracy{suffix}"], result[f"surface_completeness{suffix}"] = means
            result[f"surface_distance{suffix}"] = sum(means) / 2
    return result


def _seen(mesh: Mesh, occluder: Occluder, views: Sequence[View]) -> tuple[np.ndarray, np.ndarray]:
    """Sample points (P, 3) of a mesh that some view sees, and their normals (P, 3) towards that view."""
    position, triangle = sample(mesh, QUERIES)
    corners = np.asarray(mesh.vertices, np.float64)[mesh.faces[triangle]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    facing, best = np.zeros_like(normal), np.full(len(position), GRAZING)
    for view in views:
        origin = view.to_world[:3, 3]
        ray = position - origin
        reach = np.maximum(np.linalg.norm(ray, axis=1), 1e-30)
        cosine = np.sum(normal * ray, axis=1) / reach
        row, column, inside = view.project(position)
        better = inside & (np.abs(cosine) > best)
        if not view.has_alpha:
            at = np.rint(np.where(inside, [row, column], 0)).astype(int)
            at = np.clip(at, 0, np.array([[view.height - 1], [view.width - 1]]))
            better &= view.covered()[*at] > 0
        start = mi.Point3f(np.tile(origin, (len(ray), 1)).T)
        hit, stopped = occluder.first_hit(start, mi.Vector3f(ray.T), upload(better, mi.Bool))
        # In lengths of the ray: an occluder is nearer by more than the offset of rays from a surface.
        margin = 1 - OFFSET_VOXELS * mesh.voxel / reach
        better &= ~stopped.numpy() | (hit.numpy() > margin)
        facing[better] = (-np.sign(cosine)[:, None] * normal)[better]
        best[better] = np.abs(cosine)[better]
    found = best > GRAZING
    return position[found], facing[found]


def sample(mesh: Mesh, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Sample points (count, 3) evenly over the area of a mesh, and return the triangle (count,) of each."""
    made = trimesh.Trimesh(mesh.vertices.astype(np.float64), mesh.faces, process=False)
    points, triangle = trimesh.sample.sample_surface(made, count, seed=0)
    return np.array(points), triangle


def distance_to(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Compute distances (P,) from points (P, 3) to a mesh: to the nearest of the triangles around each."""
    targets, triangle = sample(mesh, TARGETS)
    near = triangle[cKDTree(targets).query(points, k=CANDIDATES)[1]]
    corners = np.asarray(mesh.vertices, np.float64)[mesh.faces[near.ravel()]]
    again = np.repeat(points, CANDIDATES, axis=0)
    closest = trimesh.triangles.closest_point(corners, again)
    return np.linalg.norm(closest - again, axis=1).reshape(near.shape).min(axis=1)
