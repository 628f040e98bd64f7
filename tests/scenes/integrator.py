"""Small scenes of overlapping discs for tests of the renderer and the `refgs` plugin."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from benchmarks.common.scenes import asymmetric_sky, discs, unit
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.occlusion.mesh import Mesh, write_mesh
from mi_refgs.reference.camera import look_at
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.splat.camera import Camera
from tests.scenes.camera_motion import transform

WIDTH, HEIGHT = 16, 12
COUNT = 24


def raw_channels(count: int = COUNT, seed: int = 1) -> dict[str, np.ndarray]:
    """Overlapping discs on a unit sphere, with every attribute."""
    raw = discs(count, seed, degree=1, opacity=1, sh=0.15, glow=0.15)
    return {name: values.astype(np.float32) for name, values in raw.items()}


def sky(height: int = 32) -> np.ndarray:
    """Radiance without symmetries."""
    return asymmetric_sky(height).astype(np.float32)


def sensor(**changes: Any) -> dict:
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "pixel_format": "rgb"}
    film |= {"rfilter": {"type": "box"}} | changes.pop("film", {})
    to_world = mi.ScalarTransform4f().look_at([3, 1, 2], [0, 0, 0], [0, 0, 1])
    sampler = {"type": "independent", "sample_count": 1}
    camera = {"type": "perspective", "fov": 45, "to_world": to_world, "film": film, "sampler": sampler}
    return camera | changes


def integrator(raw: dict[str, np.ndarray] | None = None, **changes: object) -> dict:
    raw = raw_channels() if raw is None else raw
    light = EnvironmentLight.from_radiance(sky()).raw
    channels = {name: upload_tensor(values) for name, values in raw.items()}
    return {"type": "refgs", **channels, "light": light} | changes


def scene(camera: dict | None = None, *, more: dict | None = None, **changes: Any) -> mi.Scene:
    inner = {name: value for name, value in integrator(**changes).items() if value is not None}
    return mi.load_dict({"type": "scene", "integrator": inner, "sensor": camera or sensor()} | (more or {}))


def lit_scene(emitter: dict | None, more: dict | None = None, **changes: Any) -> mi.Scene:
    """A scene whose light is an emitter outside the integrator, or which has none."""
    sky = {} if emitter is None else {"sky": emitter}
    return scene(more=sky | (more or {}), light=None, **changes)


def image(of: mi.Scene, **arguments: object) -> np.ndarray:
    return mi.render(of, **arguments).numpy()


def joined(voxel: float, *parts: Any) -> Mesh:
    whole: Any = trimesh.util.concatenate(parts)
    return Mesh(np.asarray(whole.vertices, np.float32), np.asarray(whole.faces, np.uint32), voxel)


def wall(scale: float = 1) -> Mesh:
    """A wall behind the sphere's right half, seen in its reflections; `scale`: of the unit of length."""
    box = trimesh.creation.box((0.2, 8, 8))
    box.apply_translation((-2.5, 4, 0))
    return joined(0.05 * scale, box.apply_scale(scale))


def plane_mesh(folder: Path) -> str:
    path = folder / "mesh.ply"
    write_mesh(path, wall())
    return str(path)


def hollow_mesh(folder: Path) -> str:
    """The sphere and a wall that touches it: each takes light from the other."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    wall = trimesh.creation.box((0.2, 4, 4))
    wall.apply_translation((-1.1, 1, 0))
    path = folder / "hollow.ply"
    write_mesh(path, joined(0.02, ball, wall.subdivide_to_size(0.5)))
    return str(path)


STEPS = (2e-3, 2e-4)  # of differences; the better one counts: rounding, or curvature
JUMP = 0.1  # of their root mean square: where the two sides differ by more, there is no derivative
MAX_LEFT_OUT = 0.2  # share of the seen pixels in which that may happen; observed up to 2 %
TANGENT_TOLERANCE = 5e-3  # relative L2; observed 8e-5 … 3e-3


def check_derivatives(of: mi.Scene, key: str, spp: int = 1) -> None:
    errors = parameter_errors(of, key, spp)
    assert max(errors) < TANGENT_TOLERANCE, f"{key}: {errors} from central differences"


def varied(shape: tuple[int, ...]) -> np.ndarray:
    """Numbers of either sign, none of them small."""
    rng = np.random.default_rng(3)
    return (rng.uniform(0.5, 1, shape) * rng.choice([-1, 1], shape)).astype(np.float32)


def parameter_errors(of: mi.Scene, key: str, spp: int = 0) -> tuple[float, float]:
    """`derivative_errors` of images by a parameter of the scene, along a change of all of its numbers."""
    params, one = mi.traverse(of), np.ones(7, np.float32)
    start = params[key]
    base = mi.Transform4f(start) if hasattr(start, "matrix") else np.array(start).copy()  # no view of it

    def rendered(t: mi.Float) -> mi.TensorXf:
        if isinstance(base, np.ndarray):
            change = varied(base.shape) * (1 if isinstance(start, mi.TensorXf) else np.where(base, base, 0.3))
            params[key] = type(start)(base) + t * type(start)(change)
        else:
            params[key] = transform(0.1 * t * mi.Float(one)) @ base
        params.update()
        # Mitsuba refuses to draw the samples of an image and of its derivative with one seed.
        seeds = {"seed": 1, "seed_grad": 7} if dr.grad_enabled(t) else {"seed": 7}
        return mi.render(of, params, spp=spp, **seeds)

    errors = derivative_errors(rendered, key)
    rendered(mi.Float(0))
    return errors


def derivative_errors(at: Callable[[mi.Float], mi.TensorXf], name: str) -> tuple[float, float]:
    """Relative errors of forward and reverse mode of images by a number at 0: of tangents against central
    differences (L2), of gradients of their weighted sums."""
    t = mi.Float(0)
    dr.enable_grad(t)
    image = at(t)
    dr.set_grad(t, 1)
    tangent = dr.forward_to(image).numpy()
    found = []
    for step in STEPS:
        before, middle, after = (at(mi.Float(t)).numpy().astype(np.float64) for t in (-step, 0, step))
        left, right = (middle - before) / step, (after - middle) / step
        difference, seen = (left + right) / 2, np.any(middle != 0, axis=2)
        typical = np.sqrt(np.mean(difference[seen] ** 2))
        assert typical > 1e-3, f"{name}: no influence on the image"
        smooth = np.all(np.abs(right - left) < JUMP * (typical + np.abs(difference)), axis=2)
        if np.mean(~smooth[seen]) <= MAX_LEFT_OUT:
            error = np.linalg.norm((tangent - difference)[smooth]) / np.linalg.norm(difference[smooth])
            found.append((error, np.where(smooth[..., None], difference, 0)))
    assert found, f"{name}: too many jumps at every step"
    forward, difference = min(found, key=lambda pair: pair[0])

    weight = (difference * np.random.default_rng(3).uniform(0.5, 1.5, difference.shape)).astype(np.float32)
    dr.enable_grad(t)
    dr.set_grad(t, 0)
    dr.backward(dr.sum(at(t) * mi.TensorXf(weight), axis=None))
    reverse, product = float(dr.grad(t)[0]), np.sum(weight * tangent)
    assert abs(reverse - product) < 1e-5 * np.linalg.norm(weight) * np.linalg.norm(tangent)
    return float(forward), float(abs(reverse / np.sum(weight * difference) - 1))


PREFIX = "surroundings_"


def far_channels(count: int = 30) -> dict[str, np.ndarray]:
    """Discs around the object, some of them before it, with radiance alone."""
    raw = raw_channels(count, seed=4)
    raw["position"] = 1.7 * raw["position"]
    return {name: raw[name] for name in ("position", "rotation", "scale", "opacity", "radiance_sh")}


def background_light() -> EnvironmentLight:
    return EnvironmentLight.from_radiance(0.3 + sky(16))


def open_scene(camera: dict | None = None, **changes: Any) -> mi.Scene:
    around = {PREFIX + name: mi.TensorXf(values) for name, values in far_channels().items()}
    return scene(camera, **{**around, "background": background_light().raw, **changes})


def camera_at(focal: float) -> Camera:
    """A view with the tiles of its focal length, from as much farther away."""
    pose = look_at(np.array([1.0, 1.5, 3.0]) * focal / 30, np.zeros(3), up=(0, 1, 0))
    return Camera.from_pose(45, 38, -focal, -focal, 20.0, 22.0, pose)


def two_balls() -> Mesh:
    """A ball below the discs, and one beside it that blocks its mirror rays."""
    one, other = (trimesh.creation.icosphere(subdivisions=2, radius=radius) for radius in (0.8, 1.2))
    return joined(0.05, one, other.apply_translation((-1.8, 1.2, 0.8)))


OTHER_OPTIONS: dict[str, Any] = {
    "dominant": True, "visibility_rays": 3, "traced_bounces": 1, "ambient_rays": 16, "directions": 5,
    "antialias": True,
}  # fmt: skip
"""A value for each option that is not its default."""


def scattered_discs(seed: int = 4, count: int = 30, primitive: str = "surfel") -> dict[str, np.ndarray]:
    """Discs, or Gaussians, behind, beside and before the object of the plain case."""
    rng = np.random.default_rng(seed)
    direction = unit(rng.normal(size=(count, 3)))
    raw = {
        "position": direction * rng.uniform(0.4, 2.0, (count, 1)),
        "rotation": rng.normal(size=(count, 4)),
        "scale": np.log(rng.uniform(0.2, 0.5, (count, 2))),
        "opacity": rng.uniform(-1, 1, (count, 1)),
        "radiance_sh": 0.2 * rng.normal(size=(count, 12)),
    }
    if primitive == "gaussian":
        raw["scale"] = np.concatenate([raw["scale"], np.log(rng.uniform(0.06, 0.5, (count, 1)))], axis=1)
    return {name: values.astype(np.float32) for name, values in raw.items()}
