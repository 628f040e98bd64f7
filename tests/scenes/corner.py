"""Two plates that meet in a concave edge, or three that form a channel: for tests of rays and their hits."""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.shade.light.envmap import PrefilteredLight
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import ShadingPoints
from mi_refgs.shade.reflectance import TraceContext
from mi_refgs.shade.reflection import reflection
from mi_refgs.surfels.table import Surfels
from tests.helpers import unit, vector

VOXEL = 1e-4  # so small that the offset of the rays' origins does not matter
FLOOR, WALL, EYE = 2.0, 1.5, np.array([1.4, 1.2, 0.3])
"""A floor (y = 0) of depth FLOOR and twice that width, a wall (x = 0) WALL high on it, and the camera."""
LOW_EYE = np.array([1.4, 0.3, 0.3])  # its mirror rays are so flat that they meet several walls of a `channel`


def corner(cells: int = 8) -> Mesh:
    """Two plates that meet in a concave edge, each of cells² × 2 triangles; seen from the open side."""
    axes = np.meshgrid(np.linspace(0, 1, cells + 1), np.linspace(-1, 1, cells + 1), indexing="ij")
    u, z = (axis.ravel() for axis in axes)
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]
    faces = np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)])
    floor = np.stack([FLOOR * u, 0 * u, FLOOR * z], 1)
    vertices = np.concatenate([floor, np.stack([0 * u, WALL * u, FLOOR * z], 1)]).astype(np.float32)
    return Mesh(vertices, np.concatenate([faces, faces[:, ::-1] + len(floor)]).astype(np.uint32), VOXEL)


def channel() -> Mesh:
    """A `corner` with a second wall at x = FLOOR: rays go back and forth until they leave above."""
    base = corner()
    wall = len(base.vertices) // 2
    vertices = base.vertices[wall:] + np.array([FLOOR, 0, 0], np.float32)
    faces = base.faces[len(base.faces) // 2 :, ::-1] + np.uint32(wall)
    return Mesh(np.concatenate([base.vertices, vertices]), np.concatenate([base.faces, faces]), VOXEL)


def wall_surfels(
    albedo: np.ndarray | None = None, metallic: float = 1.5, roughness: float = 0.2, seed: int = 2
) -> Surfels:
    """400 discs on the wall, turned to the floor; materials are logits, `albedo` (400, 3) or one colour."""
    rng, count = np.random.default_rng(seed), 400
    y, z = WALL * rng.uniform(size=count), FLOOR * rng.uniform(-1, 1, count)
    raw = {
        "position": np.stack([0 * y, y, z], 1),
        "rotation": np.tile([0, np.sqrt(0.5), 0, np.sqrt(0.5)], (count, 1)),  # +z to +x
        "scale": np.full((count, 2), np.log(0.15)),
        "opacity": np.full(count, 2.0),
        "albedo": np.tile([1.0, 0.0, -1.0], (count, 1)) if albedo is None else albedo,
        "metallic": np.full(count, metallic),
        "roughness": np.full(count, roughness),
    }
    return Surfels.from_numpy(raw)


def channel_surfels(albedo: np.ndarray | None = None) -> Surfels:
    """400 discs on either wall of a `channel`: other colours, less metallic and rougher on the second."""
    near, far = wall_surfels(albedo), wall_surfels(-1.5 + np.zeros((400, 3)), -0.5, 1.0, seed=3)
    raw = {name: np.concatenate([near.raw[name].numpy(), x.numpy()]) for name, x in far.raw.items()}
    raw["position"][400:, 0] = FLOOR
    return Surfels.from_numpy(raw)


def floor_points(
    roughness: float, count: int = 40, eye: np.ndarray = EYE
) -> tuple[np.ndarray, ShadingPoints]:
    """Points of a metal floor near the wall, seen from `eye`."""
    rng = np.random.default_rng(7)
    place = np.stack([rng.uniform(0.1, 0.9, count), np.zeros(count), rng.uniform(-0.3, 0.6, count)], 1)
    points = ShadingPoints(
        normal=vector(np.tile([0, 1.0, 0], (count, 1))),
        view=vector(unit(eye - place)),
        albedo=mi.Color3f(0.8, 0.7, 0.6) + dr.zeros(mi.Color3f, count),
        metallic=dr.full(mi.Float, 1, count),
        roughness=dr.opaque(mi.Float, roughness, count),
    )
    return place, points


def with_materials(mesh: Mesh, surfels: Surfels) -> Occluder:
    occluder = Occluder(mesh)
    occluder.set_materials(surfels)
    return occluder


def seen(
    points: ShadingPoints,
    place: np.ndarray,
    options: ShadingOptions,
    surfels: Surfels | None = None,
    light: PrefilteredLight | None = None,
    diffuse: Any = "irradiance",
    occluder: Occluder | None = None,
    eye: np.ndarray = EYE,
) -> Any:
    """The points with what `reflection` finds, by default in the corner."""
    if occluder is None:
        occluder = Occluder(corner()) if surfels is None else with_materials(corner(), surfels)
    table: Any = surfels
    context = TraceContext(occluder, table, light, mi.Point3f(eye), vector(place - eye))
    return reflection(points, context, replace(options, diffuse=diffuse))


def wall_blocks(place: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Analytic: which directions (n, 3) from a point of the floor meet the wall, and where."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(direction[:, 0] < 0, -place[0] / direction[:, 0], np.inf)
        point = place + t[:, None] * direction
    return (point[:, 1] < WALL) & (np.abs(point[:, 2]) < FLOOR) & np.isfinite(t), point


def wall_hit(origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, int] | None:
    """Analytic: where a rising ray in a `channel` meets a wall, its normal, and which; None if it leaves."""
    side = int(direction[0] > 0)
    if direction[0] == 0:
        return None
    point = origin + (side * FLOOR - origin[0]) / direction[0] * direction
    if point[1] > WALL or abs(point[2]) > FLOOR:
        return None
    return point, np.array([1.0 - 2 * side, 0, 0]), side


def mirrored(place: np.ndarray, eye: np.ndarray = EYE) -> np.ndarray:
    """Mirror directions (n, 1, 3) of the floor."""
    return (unit(place - eye) * [1, -1, 1])[:, None]


def gradient_sky(h: int = 16) -> np.ndarray:
    up = np.linspace(0, np.pi, h)[:, None, None]
    around = ((np.arange(2 * h) + 0.5) * np.pi / h)[None, :, None]
    return np.array([1.0, 0.8, 0.6]) * (1.5 + np.cos(up)) + 0.4 * np.sin(up) * np.sin(around)
