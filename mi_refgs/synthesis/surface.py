"""The surface of a Mitsuba scene as one triangle mesh in world space."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh

from mi_refgs.errors import InputError

SPHERE_SUBDIVISIONS = 5
"""Subdivisions of an icosahedron: 20,480 triangles, whose middles lie 1.5e-4 radii below the sphere."""
ROUND_SIDES = 256
"""Sides of a circle: the middle of a side lies 8e-5 radii inside it."""


def surface_mesh(shapes: Sequence[Any]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 and faces (F, 3) of shapes of a scene, one after the other.

    Meshes are as they are; spheres, disks and cylinders are tessellated, their corners on the surface. Raises
    InputError that names a shape of any other kind.
    """
    vertices, faces, count = [], [], 0
    for shape in shapes:
        points, triangles = _triangles(shape)
        vertices.append(points)
        faces.append(triangles + count)
        count += len(points)
    return np.concatenate(vertices), np.concatenate(faces)


def _triangles(shape: Any) -> tuple[np.ndarray, np.ndarray]:
    import mitsuba as mi

    if shape.is_mesh():
        points = np.array(shape.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
        return points, np.array(shape.faces_buffer(), dtype=np.int64).reshape(-1, 3)
    name = shape.class_name()
    params = mi.traverse(shape)
    if name not in UNIT_SHAPES or "to_world" not in params:
        raise InputError(
            f"shape '{shape.id()}': a {name} has no triangles here; use a mesh, sphere, disk or cylinder"
        )
    points, triangles = UNIT_SHAPES[name]()
    matrix = np.array(params["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    return points @ matrix[:3, :3].T + matrix[:3, 3], triangles


def _sphere() -> tuple[np.ndarray, np.ndarray]:
    ball = trimesh.creation.icosphere(subdivisions=SPHERE_SUBDIVISIONS)
    return np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int64)


def _circle() -> np.ndarray:
    angle = 2 * np.pi * np.arange(ROUND_SIDES) / ROUND_SIDES
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(ROUND_SIDES)], axis=1)


def _disk() -> tuple[np.ndarray, np.ndarray]:
    """The unit disk around the origin, across z."""
    rim = np.arange(ROUND_SIDES)
    fan = np.stack([np.full(ROUND_SIDES, ROUND_SIDES), rim, (rim + 1) % ROUND_SIDES], axis=1)
    return np.concatenate([_circle(), np.zeros((1, 3))]), fan


def _cylinder() -> tuple[np.ndarray, np.ndarray]:
    """The open cylinder of radius 1 from z = 0 to z = 1."""
    low, after = np.arange(ROUND_SIDES), (np.arange(ROUND_SIDES) + 1) % ROUND_SIDES
    first = np.stack([low, after, after + ROUND_SIDES], axis=1)
    second = np.stack([low, after + ROUND_SIDES, low + ROUND_SIDES], axis=1)
    upper = _circle() + np.array([0, 0, 1])
    return np.concatenate([_circle(), upper]), np.concatenate([first, second])


UNIT_SHAPES = {"Sphere": _sphere, "Disk": _disk, "Cylinder": _cylinder}
"""Shapes of Mitsuba that are a `to_world` of something round."""
