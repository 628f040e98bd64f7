"""Small scenes for the tests of the `refgs` plugin."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh

from mi_refgs.kernels.device import upload_tensor
from mi_refgs.occlusion.mesh import Mesh, write_mesh
from mi_refgs.shade.light.envmap import EnvironmentLight

WIDTH, HEIGHT = 16, 12
COUNT = 24


def raw_channels(count: int = COUNT, seed: int = 1) -> dict[str, np.ndarray]:
    """Overlapping discs on a unit sphere, with every channel."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # The shortest rotation from +z to the normal, (n × …, 1 + n_z), with some noise.
    rotation = np.stack([-normal[:, 1], normal[:, 0], 0 * normal[:, 0], 1 + normal[:, 2]], 1)
    raw = {
        "position": normal,
        "rotation": rotation + 0.1 * rng.normal(size=(count, 4)),
        "scale": np.log(rng.uniform(0.25, 0.5, (count, 2))),
        "opacity": rng.uniform(-1, 1, (count, 1)),
        "radiance_sh": 0.15 * rng.normal(size=(count, 12)),
        "albedo": rng.normal(size=(count, 3)),
        "metallic": rng.normal(size=(count, 1)),
        "roughness": rng.normal(size=(count, 1)),
        "indirect_sh": 0.15 * rng.normal(size=(count, 12)) + 0.5 * (np.arange(12) < 3),
    }
    return {name: values.astype(np.float32) for name, values in raw.items()}


def sky(height: int = 32) -> np.ndarray:
    """Radiance without symmetries, so smooth that lookups have no strong kinks between its texels."""
    θ, φ = np.meshgrid(np.linspace(0, np.pi, height), np.arange(2 * height) * np.pi / height, indexing="ij")
    x, y, z = np.sin(θ) * np.sin(φ), np.cos(θ), np.sin(θ) * np.cos(φ)
    log = [0.8 * x - 0.3 * y + 0.5 * x * z, 0.6 * y + 0.4 * z - 0.5 * x * y, 0.7 * z - 0.2 * x + 0.6 * y * z]
    return np.exp(np.stack(log, -1)).astype(np.float32)


def sensor(**changes: Any) -> dict:
    film = {
        "type": "hdrfilm",
        "width": WIDTH,
        "height": HEIGHT,
        "pixel_format": "rgb",
        "rfilter": {"type": "box"},
    }
    film |= changes.pop("film", {})
    to_world = mi.ScalarTransform4f().look_at([3, 1, 2], [0, 0, 0], [0, 0, 1])
    sampler = {"type": "independent", "sample_count": 1}
    return {
        "type": "perspective",
        "fov": 45,
        "to_world": to_world,
        "film": film,
        "sampler": sampler,
    } | changes


def integrator(raw: dict[str, np.ndarray] | None = None, **changes: object) -> dict:
    raw = raw_channels() if raw is None else raw
    light = EnvironmentLight.from_radiance(sky()).raw
    channels = {name: upload_tensor(values) for name, values in raw.items()}
    return {"type": "refgs", **channels, "light": light} | changes


def scene(
    camera: dict | None = None, raw: dict[str, np.ndarray] | None = None, **changes: object
) -> mi.Scene:
    return mi.load_dict(
        {"type": "scene", "integrator": integrator(raw, **changes), "sensor": camera or sensor()}
    )


def image(of: mi.Scene, **arguments: object) -> np.ndarray:
    return mi.render(of, **arguments).numpy()


def plane_mesh(folder: Path) -> str:
    """A wall behind the sphere's right half, seen in its reflections."""
    mesh = trimesh.creation.box((0.2, 8, 8))
    mesh.apply_translation((-2.5, 4, 0))
    path = folder / "mesh.ply"
    write_mesh(path, Mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32), 0.05))
    return str(path)


def hollow_mesh(folder: Path) -> str:
    """The sphere and a wall that touches it: each takes light from the other."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    wall = trimesh.creation.box((0.2, 4, 4))
    wall.apply_translation((-1.1, 1, 0))
    mesh: Any = trimesh.util.concatenate([ball, wall.subdivide_to_size(0.5)])
    path = folder / "hollow.ply"
    write_mesh(path, Mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32), 0.02))
    return str(path)
