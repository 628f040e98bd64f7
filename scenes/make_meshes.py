"""Makes scenes/meshes/*.ply with trimesh: the shapes that Mitsuba has no plugin for.

Run from the repository root: python scenes/make_meshes.py
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation
from skimage import measure

Distance = Callable[[np.ndarray], np.ndarray]
"""Signed distance (…,) of points (…, 3), about exact near the surface, negative inside."""


def tube(centre_line: np.ndarray, radius: float, sides: int) -> trimesh.Trimesh:
    """Closed tube around a closed polyline (N, 3); its frame is twisted evenly so that both ends meet."""
    count = len(centre_line)
    forward = np.roll(centre_line, -1, axis=0) - np.roll(centre_line, 1, axis=0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    across = np.empty_like(forward)
    across[0] = np.cross(forward[0], [0.0, 0.0, 1.0])
    for i in range(1, count):  # parallel transport
        across[i] = across[i - 1] - forward[i] * (across[i - 1] @ forward[i])
        across[i] /= np.linalg.norm(across[i])
    across[0] /= np.linalg.norm(across[0])
    up = np.cross(forward, across)
    # What one turn of transport leaves over, undone a little at each section.
    gap = np.arctan2(across[-1] @ up[0], across[-1] @ across[0])
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False) - gap * np.arange(count)[:, None] / count
    normals = np.cos(angle)[..., None] * across[:, None] + np.sin(angle)[..., None] * up[:, None]
    vertices = centre_line[:, None] + radius * normals
    section, side = np.meshgrid(np.arange(count), np.arange(sides), indexing="ij")
    a, b = section * sides + side, section * sides + (side + 1) % sides
    c, d = (section + 1) % count * sides + side, (section + 1) % count * sides + (side + 1) % sides
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    flat = vertices.reshape(-1, 3)
    return trimesh.Trimesh(flat, faces, vertex_normals=normals.reshape(-1, 3), process=False)


def torus(major: float, minor: float, sections: int = 128, sides: int = 32) -> trimesh.Trimesh:
    """Torus around the z axis."""
    t = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    return tube(np.stack([major * np.cos(t), major * np.sin(t), 0 * t], -1), minor, sides)


def trefoil(size: float, radius: float, sections: int = 192, sides: int = 22) -> trimesh.Trimesh:
    """Trefoil knot, flat along z, with outer radius 3·size + radius."""
    t = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    line = np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -1.3 * np.sin(3 * t)], -1)
    return tube(size * line, radius, sides)


def rounded_cube(power: float = 4.0) -> trimesh.Trimesh:
    """Superellipsoid |x|ᵖ + |y|ᵖ + |z|ᵖ = 1 with its exact normals."""
    sphere = trimesh.creation.icosphere(subdivisions=4)
    directions = np.asarray(sphere.vertices)
    vertices = directions / (np.abs(directions) ** power).sum(axis=1, keepdims=True) ** (1 / power)
    gradient = np.sign(vertices) * np.abs(vertices) ** (power - 1)
    normals = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    return trimesh.Trimesh(vertices, sphere.faces, vertex_normals=normals, process=False)


def surface(distance: Distance, half: float, cells: int) -> trimesh.Trimesh:
    """Zero level of a distance in the cube [-half, half]³ with the normals of its gradient."""
    axis = np.linspace(-half, half, cells + 1)
    step = axis[1] - axis[0]
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    vertices, faces, _, _ = measure.marching_cubes(distance(grid), 0.0, gradient_direction="descent")
    vertices = vertices * step - half
    offsets = 0.25 * step * np.eye(3)
    normals = np.stack([distance(vertices + o) - distance(vertices - o) for o in offsets], axis=-1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mesh = trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False)
    if mesh.volume < 0:
        mesh.faces = mesh.faces[:, ::-1]
    return trimesh.Trimesh(vertices, mesh.faces, vertex_normals=normals, process=False)


def union(a: np.ndarray, b: np.ndarray, blend: float) -> np.ndarray:
    """Distance of a union whose edge is rounded over about `blend`."""
    share = np.clip(0.5 + 0.5 * (b - a) / blend, 0, 1)
    return b + (a - b) * share - blend * share * (1 - share)


def cut(a: np.ndarray, b: np.ndarray, blend: float) -> np.ndarray:
    """Distance of a without b, the edge rounded over about `blend`."""
    return -union(-a, b, blend)


def hollow_block(p: np.ndarray) -> np.ndarray:
    """A rounded block with a hole through it along x, bowls in the top and two sides, and a knob in one."""
    q = np.abs(p) - np.array([0.52, 0.52, 0.42])
    block = np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0) - 0.16
    hole = np.hypot(p[..., 1], p[..., 2] + 0.08) - 0.2
    top = np.linalg.norm(p - [0, 0, 0.78], axis=-1) - 0.46
    right = np.linalg.norm(p - [0, 0.86, -0.02], axis=-1) - 0.42
    left = np.linalg.norm(p - [0, -0.86, -0.02], axis=-1) - 0.42
    body = cut(cut(cut(cut(block, hole, 0.05), top, 0.05), right, 0.05), left, 0.05)
    return union(body, np.linalg.norm(p - [0.1, 0.05, 0.42], axis=-1) - 0.13, 0.04)


def shell(p: np.ndarray) -> np.ndarray:
    """A spherical shell with six round windows and rounded rims."""
    radius = np.linalg.norm(p, axis=-1)
    wall = np.abs(radius - 0.84) - 0.07
    windows = np.min(
        [np.hypot(p[..., (i + 1) % 3], p[..., (i + 2) % 3]) - (0.5, 0.44, 0.38)[i] for i in range(3)], axis=0
    )
    return cut(wall, windows, 0.1)


def cup(p: np.ndarray) -> np.ndarray:
    """A cup with a thick round rim, a foot and a handle along +x."""
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    radius = np.hypot(x, y)
    flare = 0.5 + 0.06 * (z + 0.55)  # outer radius grows upwards
    outside = np.maximum(radius - flare, np.abs(z) - 0.55)
    inside = np.maximum(radius - flare + 0.075, -(z + 0.46))
    body = cut(outside, inside, 0.05) - 0.02
    handle = np.hypot(np.hypot(x - 0.56, z) - 0.28, y) - 0.065
    return union(body, np.maximum(handle, flare - 0.05 - radius), 0.06)


def lathe(profile: np.ndarray, sections: int = 96, rows: int = 64) -> trimesh.Trimesh:
    """Surface of revolution around z of a smooth curve through points (N, 2) of radius and height, upwards.

    Both ends lie on the axis.
    """
    at = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    curve = PchipInterpolator(at, profile)
    t = np.linspace(0, at[-1], rows)
    (radius, height), (slope, rise) = curve(t).T, curve(t, 1).T
    angle = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def turned(out: np.ndarray, up: np.ndarray) -> np.ndarray:
        flat = out[:, None, None] * around
        return np.concatenate([flat, np.broadcast_to(up[:, None, None], (rows, sections, 1))], axis=-1)

    vertices, normals = turned(radius, height), turned(rise, -slope)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    row, side = np.meshgrid(np.arange(rows - 1), np.arange(sections), indexing="ij")
    a, b = row * sections + side, row * sections + (side + 1) % sections
    faces = np.concatenate(
        [
            np.stack([a, b, b + sections], -1).reshape(-1, 3),
            np.stack([a, b + sections, a + sections], -1).reshape(-1, 3),
        ]
    )
    return trimesh.Trimesh(
        vertices.reshape(-1, 3), faces, vertex_normals=normals.reshape(-1, 3), process=False
    )


def jug() -> trimesh.Trimesh:
    """The body of a jug with a closed top, from z = -0.6 to 0.5."""
    profile = [
        (0, -0.6), (0.3, -0.6), (0.36, -0.58), (0.47, -0.42), (0.5, -0.22), (0.44, 0.02), (0.31, 0.2),
        (0.27, 0.3), (0.3, 0.38), (0.29, 0.42), (0.2, 0.47), (0, 0.5),
    ]  # fmt: skip
    return lathe(np.array(profile))


def can() -> trimesh.Trimesh:
    """The metal of a drinks can, whose print is on a cylinder of radius 0.33; from z = -0.6 to 0.6."""
    profile = [
        (0, -0.52), (0.18, -0.55), (0.235, -0.598), (0.255, -0.6), (0.275, -0.585), (0.32, -0.53),
        (0.328, -0.5), (0.328, 0.4), (0.322, 0.44), (0.285, 0.53), (0.277, 0.555), (0.28, 0.58),
        (0.285, 0.595), (0.275, 0.6), (0.262, 0.59), (0.255, 0.54), (0.24, 0.535), (0.22, 0.55), (0, 0.553),
    ]  # fmt: skip
    return lathe(np.array(profile), 64, 60)


def placed(
    mesh: trimesh.Trimesh,
    move: tuple[float, float, float],
    size: tuple[float, float, float] = (1, 1, 1),
    turn: tuple[str, float] = ("x", 0),
) -> trimesh.Trimesh:
    """A mesh scaled, turned about an axis by degrees, and moved, with its normals."""
    rotation = Rotation.from_euler(*turn, degrees=True).as_matrix()
    normals = np.asarray(mesh.vertex_normals) / size @ rotation.T
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    vertices = np.asarray(mesh.vertices) * size @ rotation.T + move
    return trimesh.Trimesh(vertices, mesh.faces, vertex_normals=normals, process=False)


def ball(subdivisions: int = 2) -> trimesh.Trimesh:
    """The unit sphere with its exact normals."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.vertices, process=False)


def limb(length: float, *radii: float) -> trimesh.Trimesh:
    """A rounded limb upwards from the origin, of evenly spaced radii."""
    low, high = radii[0], radii[-1]
    middle = zip(radii, np.linspace(0.7 * low, length - 0.7 * high, len(radii)), strict=True)
    ends = [(0, 0), (0.75 * low, 0.2 * low)], [(0.75 * high, length - 0.2 * high), (0, length)]
    return lathe(np.array([*ends[0], *middle, *ends[1]]), 24, 20)


def figure() -> dict[str, trimesh.Trimesh]:
    """A toy figure of two materials, from z = -0.75 to 0.75, which looks along -y."""
    leg, arm = limb(0.6, 0.05, 0.072, 0.058, 0.08, 0.07), limb(0.28, 0.038, 0.05, 0.045)
    torso = [
        (0, -0.13), (0.09, -0.12), (0.135, -0.06), (0.115, 0.05), (0.14, 0.16), (0.172, 0.29), (0.15, 0.38),
        (0.07, 0.43), (0, 0.44),
    ]  # fmt: skip
    base = [(0, -0.75), (0.22, -0.75), (0.235, -0.735), (0.235, -0.71), (0.22, -0.695), (0, -0.69)]
    red = [
        placed(lathe(np.array(torso), 32, 28), (0, 0, 0), (1, 0.68, 1)),
        placed(ball(3), (0, 0, 0.6), (0.1, 0.115, 0.13)),  # head
        *(placed(leg, (0.1 * side, 0, -0.68), turn=("y", -3 * side)) for side in (-1, 1)),
        *(placed(arm, (0.215 * side, 0, 0.1), turn=("y", -5 * side)) for side in (-1, 1)),
        *(placed(ball(), hand, (0.04,) * 3) for hand in ((-0.222, -0.04, -0.15), (0.205, -0.27, 0.22))),
    ]
    silver = [
        placed(lathe(np.array(base), 40, 18), (0, 0, 0)),
        placed(torus(0.118, 0.024, 40, 10), (0, 0, 0.03), (1, 0.72, 1.2)),  # belt
        placed(limb(0.14, 0.055, 0.05, 0.055), (0, 0, 0.4)),  # neck
        placed(ball(3), (0, -0.03, 0.585), (0.078, 0.1, 0.1)),  # face
        placed(ball(), (0, 0, 0.66), (0.014, 0.11, 0.09)),  # crest
        placed(ball(), (0, -0.105, 0.27), (0.05, 0.03, 0.05)),  # badge
        placed(arm, (-0.22, -0.035, -0.14), turn=("x", 8)),
        placed(arm, (0.205, -0.25, 0.21), turn=("x", -65)),
    ]
    for side in (-1, 1):  # foot, knee, shoulder
        silver.append(placed(ball(), (0.105 * side, -0.03, -0.66), (0.065, 0.105, 0.05)))
        silver.append(placed(ball(), (0.085 * side, -0.018, -0.36), (0.055,) * 3))
        silver.append(placed(ball(), (0.195 * side, 0, 0.36), (0.078,) * 3))
    return {
        f"figure_{name}": trimesh.util.concatenate(parts)  # type: ignore[misc]
        for name, parts in (("red", red), ("silver", silver))
    }


def brick(columns: int, rows: int) -> trimesh.Trimesh:
    """A building brick, open below: walls, a top with studs, tubes between the studs. A stud a unit, z up."""
    wall, height, stud = 0.16, 1.2, (0.3, 0.22)
    w, d = columns / 2 - 0.01, rows / 2 - 0.01

    def box(low: tuple[float, ...], high: tuple[float, ...]) -> trimesh.Trimesh:
        return trimesh.creation.box(bounds=[low, high])

    parts = [
        box((-w, -d, height - wall), (w, d, height)),
        box((-w, -d, 0), (-w + wall, d, height - wall)),
        box((w - wall, -d, 0), (w, d, height - wall)),
        box((-w + wall, -d, 0), (w - wall, -d + wall, height - wall)),
        box((-w + wall, d - wall, 0), (w - wall, d, height - wall)),
    ]
    for i in range(columns):
        for j in range(rows):
            at = [i + 0.5 - columns / 2, j + 0.5 - rows / 2]
            post = trimesh.creation.cylinder(stud[0], stud[1], sections=32)
            parts.append(post.apply_translation([*at, height + stud[1] / 2]))
            if i and j:
                tube = trimesh.creation.cylinder(0.27, height - wall, sections=32)
                parts.append(tube.apply_translation([at[0] - 0.5, at[1] - 0.5, (height - wall) / 2]))
    brick: trimesh.Trimesh = trimesh.util.concatenate(parts)  # type: ignore[assignment]
    return brick


def main() -> None:
    """Write the meshes beside this script."""
    target = Path(__file__).parent / "meshes"
    target.mkdir(exist_ok=True)
    meshes = {"torus": torus(0.82, 0.18), "trefoil": trefoil(0.27, 0.16), "rounded_cube": rounded_cube()}
    meshes |= {"jug": jug(), "handle": torus(0.24, 0.055, 64, 20), "can": can(), **figure()}
    meshes |= {"hollow_block": surface(hollow_block, 0.75, 30), "shell": surface(shell, 0.95, 38)}
    whole = surface(cup, 0.9, 50)
    centres = whole.triangles_center
    inner = (np.hypot(*centres.T[:2]) < 0.47 + 0.06 * (centres[:, 2] + 0.55)) & (centres[:, 2] > -0.5)
    for name, faces in (("cup_outside", ~inner), ("cup_inside", inner)):
        used, index = np.unique(whole.faces[faces], return_inverse=True)
        meshes[name] = trimesh.Trimesh(
            whole.vertices[used],
            index.reshape(-1, 3),
            vertex_normals=whole.vertex_normals[used],
            process=False,
        )
    for name, mesh in meshes.items():
        mesh.export(target / f"{name}.ply", vertex_normal=True)
    for columns, rows in ((4, 2), (2, 2), (3, 1)):
        brick(columns, rows).export(target / f"brick_{columns}x{rows}.ply", vertex_normal=False)


if __name__ == "__main__":
    main()
