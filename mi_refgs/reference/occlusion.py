"""Depth fusion, visibility and ambient ratios in float64, of shapes by their distance and of meshes.

A shape is a function from (N, 3) points to (N,) exact or underestimated signed distances, positive outside.
Cameras are (to_world, focal, size): rigid (4, 4), Mitsuba camera frame; pixels; square image, centred.
"""

from collections.abc import Callable

import numpy as np

Array = np.ndarray
Shape = Callable[[Array], Array]
View = tuple[Array, float, int]

HIT_DISTANCE = 1e-5  # a ray this close to a shape of unit size has hit it
TRACE_STEPS, TRACE_FAR = 200, 20.0


def sphere(centre: tuple[float, float, float], radius: float) -> Shape:
    return lambda p: np.linalg.norm(p - np.array(centre), axis=-1) - radius


def torus(major: float, minor: float) -> Shape:
    return lambda p: np.hypot(np.hypot(p[..., 0], p[..., 1]) - major, p[..., 2]) - minor


def box(centre: tuple[float, float, float], half: tuple[float, float, float]) -> Shape:
    def distance(p: Array) -> Array:
        q = np.abs(p - np.array(centre)) - np.array(half)
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)

    return distance


def union(*shapes: Shape) -> Shape:
    return lambda p: np.min([shape(p) for shape in shapes], axis=0)


def normal(shape: Shape, points: Array, step: float = 1e-5) -> Array:
    """Unit outward normals by central differences."""
    gradient = np.stack([shape(points + step * e) - shape(points - step * e) for e in np.eye(3)], axis=-1)
    return gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)


def trace(shape: Shape, origin: Array, direction: Array) -> Array:
    """Distance to the shape along unit directions by sphere tracing, infinite for a miss."""
    t, result = np.zeros(len(origin)), np.full(len(origin), np.inf)
    active = np.arange(len(origin))
    for _ in range(TRACE_STEPS):
        distance = shape(origin[active] + t[active, None] * direction[active])
        hit = np.abs(distance) < HIT_DISTANCE
        result[active[hit]] = t[active[hit]]
        t[active] += distance
        active = active[~hit & (t[active] < TRACE_FAR)]
    return result


def depth_map(shape: Shape, to_world: Array, focal: float, size: int) -> Array:
    """(size, size) camera z of the shape through the pixel centres, 0 for background."""
    j, i = np.mgrid[:size, :size] + 0.5
    local = np.stack([(size / 2 - i) / focal, (size / 2 - j) / focal, np.ones_like(i)], -1).reshape(-1, 3)
    length = np.linalg.norm(local, axis=1)
    direction = (local / length[:, None]) @ to_world[:3, :3].T
    t = trace(shape, np.broadcast_to(to_world[:3, 3], direction.shape), direction)
    return np.where(np.isfinite(t), t / length, 0).reshape(size, size)


def visible(shape: Shape, points: Array, direction: Array, clearance: float) -> Array:
    """Whether rays from `points` leave the shape, starting `clearance` off it along its normal."""
    return ~np.isfinite(trace(shape, points + clearance * normal(shape, points), direction))


def fuse_point(
    point: Array, depths: list[Array], views: list[View], voxel: float, truncation: float, unseen_vote: float
) -> float:
    """Fused signed distance of one point, in truncations, by the table at the top of `occlusion.tsdf`."""
    total = weight = covered = 0.0
    for depth, (to_world, focal, size) in zip(depths, views, strict=True):
        x, y, z = to_world[:3, :3].T @ (point - to_world[:3, 3])
        if z <= 0:
            continue
        u, v = size / 2 - focal * x / z - 0.5, size / 2 - focal * y / z - 0.5
        if not (-0.5 <= u < size - 0.5 and -0.5 <= v < size - 0.5):
            continue
        u0, v0 = int(np.floor(u)), int(np.floor(v))
        du, dv = u - u0, v - v0
        rows, columns = (np.clip((k, k + 1), 0, size - 1) for k in (v0, u0))
        tap = depth[np.ix_(rows, columns)]
        if (tap == 0).all():  # background for certain
            weight += 1
            total += 1
            continue
        surface = tap[int(dv >= 0.5), int(du >= 0.5)]
        if surface == 0:  # half-covered pixel
            continue
        if tap.min() > 0 and np.ptp(tap) < truncation:
            surface = np.array([1 - dv, dv]) @ tap @ np.array([1 - du, du])
        distance = surface - z
        if distance <= -truncation:
            covered += 1
            continue
        w = min(1.0, (distance + truncation) / (truncation - voxel))
        weight += w
        total += w * min(1.0, distance / truncation)
    if covered and weight <= unseen_vote * covered:
        return -1.0
    return total / weight if weight else 1.0


def mesh_hit(vertices: Array, faces: Array, origin: Array, direction: Array) -> tuple[float, int, Array]:
    """Distance along a ray to the nearest triangle, of either side, infinite for a miss; its index; shares
    (3,) of corners. [Möller and Trumbore 1997]"""
    a, b, c = (np.asarray(vertices, np.float64)[np.asarray(faces, int)[:, k]] for k in range(3))
    across = np.cross(direction, c - a)
    determinant = np.sum((b - a) * across, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / determinant
        u = np.sum((origin - a) * across, axis=1) * inverse
        beside = np.cross(origin - a, b - a)
        v = (beside @ direction) * inverse
        t = np.sum((c - a) * beside, axis=1) * inverse
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & np.isfinite(t)
    first = int(np.argmin(np.where(hit, t, np.inf)))
    shares = np.array([1 - u[first] - v[first], u[first], v[first]])
    return (float(t[first]) if hit[first] else np.inf), first, shares


def mesh_distance(vertices: Array, faces: Array, origin: Array, direction: Array) -> Array:
    """Distance (n,) along rays to the nearest of all triangles, either side; infinite for a miss."""
    return np.array([mesh_hit(vertices, faces, o, d)[0] for o, d in zip(origin, direction, strict=True)])


def beyond(normal: Array, direction: Array, offset: float, along: float) -> Array:
    """From a surface to where rays (…, 3) start, `offset` above it: along them, at most `along` offsets."""
    cosine = np.sum(normal * direction, -1, keepdims=True)
    with np.errstate(divide="ignore"):
        length = offset * np.clip(1 / cosine, 0, along)
    return length * direction + (offset - length * cosine) * normal


def mirror_visibility(
    vertices: Array, faces: Array, eye: Array, normal: Array, ray: Array, offset: float, along: float
) -> Array:
    """1 (P,), or 0 where mirror rays of unit rays (P, 3) from the eye, `beyond` the mesh, are blocked."""
    if not len(faces):
        return np.ones(len(normal))
    origin = np.broadcast_to(eye, ray.shape)
    t = mesh_distance(vertices, faces, origin, ray)
    hit = np.isfinite(t)
    mirror = ray - 2 * np.sum(normal * ray, 1, keepdims=True) * normal
    start = origin + np.where(hit, t, 0)[:, None] * ray + beyond(normal, mirror, offset, along)
    return np.where(hit & np.isfinite(mesh_distance(vertices, faces, start, mirror)), 0.0, 1.0)


def ambient(
    vertices: Array,
    faces: Array,
    normals: Array,
    directions: Array,
    light: Callable[[Array], Array],
    outgoing: Callable[[Array, Array, bool, Array], Array],
    *,
    offset: float,
    along: float,
    bounces: int,
    brightest: float,
) -> Array:
    """Ratios (V, 3) by the formula of `shade.ambient`, for normals (V, 3), unit directions (V, K, 3) of
    density cosine / π, blurred light(ω) (3,), rays from `beyond` the surface, and radiance (3,)
    outgoing(normal, view, free, ratio) of a hit, `free` if light arrives along its mirror direction."""
    ratio = np.ones((len(vertices), 3))
    for _ in range(bounces):
        found = np.zeros_like(ratio)
        for vertex, (place, normal) in enumerate(zip(vertices, normals, strict=True)):
            arrives, every = np.zeros(3), np.zeros(3)
            for direction in directions[vertex]:
                radiance = light(direction)
                every += radiance
                start = place + beyond(normal, direction, offset, along)
                distance, face, shares = mesh_hit(vertices, faces, start, direction)
                if not np.isfinite(distance):
                    arrives += radiance
                else:
                    there = shares @ normals[faces[face]]
                    there = there / np.linalg.norm(there)
                    there = -there if there @ direction > 0 else there
                    mirror = direction - 2 * (direction @ there) * there
                    hit = start + distance * direction + beyond(there, mirror, offset, along)
                    free = not np.isfinite(mesh_hit(vertices, faces, hit, mirror)[0])
                    arrives += outgoing(there, -direction, free, shares @ ratio[faces[face]])
            found[vertex] = arrives / every
        ratio = np.clip(found, 0, brightest)
    return ratio
