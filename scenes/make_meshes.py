"""Makes scenes/meshes/*.ply with trimesh: the shapes that Mitsuba has no plugin for.

Run from the repository root: python scenes/make_meshes.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh


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


def main() -> None:
    """Write the meshes beside this script."""
    target = Path(__file__).parent / "meshes"
    target.mkdir(exist_ok=True)
    meshes = {"torus": torus(0.82, 0.18), "trefoil": trefoil(0.27, 0.16), "rounded_cube": rounded_cube()}
    for name, mesh in meshes.items():
        mesh.export(target / f"{name}.ply", vertex_normal=True)


if __name__ == "__main__":
    main()
