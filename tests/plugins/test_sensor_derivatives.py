"""Derivatives of mi.render with respect to a sensor's `to_world`, `x_fov` and principal point."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from benchmarks.stability import exact
from benchmarks.stability.cases import HEIGHT, WIDTH, Case, camera, catalogue, plain
from mi_refgs.kernels.device import upload, upload_tensor
from mi_refgs.occlusion.mesh import write_mesh
from mi_refgs.reference import image as oracle
from mi_refgs.reference.camera import PinholeCamera, ray_slopes
from tests.helpers import slow, with_grad
from tests.scenes import integrator as scenes
from tests.scenes.camera_motion import moved_pose, require_slopes, transform

POSE, ANGLE, CENTRE = "sensor.to_world", "sensor.x_fov", "sensor.principal_point_offset_"
FOV = 45.0  # degrees
START = np.array([0.06, -0.1, 0.08, 0.04, 0.06, -0.02, 0.03, 0, 0], np.float32)
"""Where derivatives are taken: a motion, the relative change of the field of view, the principal point."""


@dataclass
class Moved:
    """A scene whose sensor has another pose and lens, by (9,) numbers under AD."""

    of: mi.Scene

    def __post_init__(self) -> None:
        self.params = mi.traverse(self.of)
        self.start = mi.Transform4f(self.params[POSE])
        self.angle = float(self.params[ANGLE][0])

    def image(self, values: mi.Float, **arguments: Any) -> mi.TensorXf:
        self.params[POSE] = transform(values) @ self.start
        angle, x, y = (dr.gather(mi.Float, values, dr.opaque(mi.UInt32, i)) for i in (6, 7, 8))
        self.params[ANGLE] = self.angle * (1 + angle)
        self.params[f"{CENTRE}x"], self.params[f"{CENTRE}y"] = x, y
        self.params.update()
        return mi.render(self.of, self.params, **arguments)


@dataclass(frozen=True)
class Pair:
    """A case in the plugin and in the float64 reference."""

    case: Case
    folder: Path

    @cached_property
    def start(self) -> np.ndarray:
        """The pose that START moves to that of the case."""
        away = np.linalg.inv(moved_pose(np.eye(4), START[:6].astype(np.float64)))
        return np.asarray((away @ self.case.camera.to_world).astype(np.float32), np.float64)

    @cached_property
    def materials(self) -> tuple[str, ...]:
        return () if self.case.reflectance == "radiance" else ("albedo", "roughness")

    @cached_property
    def order(self) -> np.ndarray:
        return exact.product_order(self.case, np.arange(WIDTH * HEIGHT))

    @cached_property
    def scene(self) -> Moved:
        case, options = self.case, {}
        if case.mesh is not None:
            options["mesh"] = str(self.folder / "mesh.ply")
            write_mesh(self.folder / "mesh.ply", case.mesh())
        aovs = ",".join(f"{name}:{name}" for name in ("normal", "depth", *self.materials))
        chosen = {"shade_at": case.at, "reflectance": case.reflectance, "diffuse": case.diffuse}
        inner = scenes.integrator(case.raw, light=upload_tensor(case.light), aovs=aovs, **chosen, **options)
        film = {"width": WIDTH, "height": HEIGHT, "pixel_format": "rgba"}
        eye = scenes.sensor(film=film, to_world=mi.ScalarTransform4f(self.start), fov=FOV / (1 + START[6]))
        return Moved(mi.load_dict({"type": "scene", "integrator": inner, "sensor": eye}))

    def camera(self, values: np.ndarray) -> PinholeCamera:
        focal = -0.5 * WIDTH / np.tan(np.radians(FOV / (1 + float(START[6])) * (1 + values[6])) / 2)
        pose = moved_pose(self.start, values[:6])
        x, y = self.case.camera.cx - WIDTH * values[7], self.case.camera.cy - HEIGHT * values[8]
        return replace(self.case.camera, fx=focal, fy=focal, cx=x, cy=y, to_world=pose)

    def planes(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Channels (H, W, C) as the plugin has them, and where a declared discontinuity is near."""
        eye, pixels = self.camera(values), np.arange(WIDTH * HEIGHT)
        found = oracle.render(exact.scene_of(replace(self.case, camera=eye), pixels, self.order))
        maps = found.maps
        ray = np.linalg.norm(ray_slopes(eye, pixels % WIDTH + 0.5, pixels // WIDTH + 0.5), axis=0)
        seen = maps["alpha"].ravel() > 1e-3
        normal = maps["normal"] / np.where(seen, np.linalg.norm(maps["normal"], axis=1), 1)[:, None]
        depth = (maps["depth"].ravel() - 0.01) * ray
        parts = [maps["radiance"], maps["alpha"], normal, depth, *(maps[name] for name in self.materials)]
        table = np.concatenate([part.reshape(len(pixels), -1) for part in parts], axis=1)
        return np.where(seen[:, None], table, 0), found.band | ~seen


def gaussians() -> Case:
    case = plain("sh", at="surfel", reflectance="radiance", camera=camera())
    raw = {name: case.raw[name] for name in ("position", "rotation", "scale", "opacity", "radiance_sh")}
    return replace(case, raw=raw | {"scale": np.concatenate([raw["scale"], raw["scale"][:, :1] - 1], 1)})


CASES = {
    "deferred": plain("deferred"),
    "forward": plain("forward", at="surfel", diffuse="irradiance"),
    "SH colour": plain("sh", at="surfel", reflectance="radiance"),
    "3D Gaussians": gaussians(),
    "occlusion": next(case for case in catalogue() if case.name == "two plates"),
}


@pytest.mark.parametrize(
    "name", ["deferred", *map(slow, ("3D Gaussians", "forward", "SH colour", "occlusion"))]
)
def test_derivatives_are_those_of_float64(name: str, tmp_path: Path) -> None:
    """Both modes, of radiance, alpha and AOVs, with respect to motions and the field of view."""
    pair = Pair(CASES[name].rounded(), tmp_path)
    exact_image, band = pair.planes(START.astype(np.float64))
    found = pair.scene.image(mi.Float(START), spp=1).numpy().reshape(exact_image.shape)
    np.testing.assert_allclose(found[~band], exact_image[~band], atol=2e-4 * np.abs(exact_image).max())
    weight = np.random.default_rng(7).normal(size=exact_image.shape) / np.abs(exact_image).max(axis=0)
    weight[band] = 0
    require_slopes(
        lambda leaf: dr.sum(pair.scene.image(leaf, spp=1).array * upload(np.float32(weight).ravel())),
        lambda values: float(np.sum(weight * pair.planes(values)[0])),
        START,
    )


CROP = {"crop_offset_x": 5, "crop_offset_y": 2, "crop_width": 7, "crop_height": 6}
AOVS = "nn:normal,d:depth,a:albedo"


@pytest.mark.parametrize("kind", ["crop", *map(slow, ("occlusion", "antialias", "open"))])
def test_derivatives_are_those_of_differences(kind: str, tmp_path: Path) -> None:
    """Supersampled images and their AOVs."""
    # Of one ray: the mean over more varies without a derivative.
    mesh: dict[str, Any] = {"mesh": scenes.plane_mesh(tmp_path), "visibility_rays": 1}
    options = {"occlusion": mesh, "antialias": {"antialias": True}}.get(kind, {})
    make = scenes.open_scene if kind == "open" else scenes.scene
    moved = Moved(make(scenes.sensor(film=CROP if kind == "crop" else {}), aovs=AOVS, **options))
    step, spp = mi.Float(scenes.varied((9,))), 1 if kind == "antialias" else 4
    errors = scenes.derivative_errors(lambda t: moved.image(t * step, spp=spp), kind)
    assert max(errors) < scenes.TANGENT_TOLERANCE, errors


def test_only_rigid_changes_have_derivatives() -> None:
    """The gradient of a matrix is a rotation's and a translation's: that of scale and shear is zero."""
    moved = Moved(scenes.scene())
    leaf = with_grad(mi.Matrix4f(moved.start.matrix))
    moved.params[POSE] = mi.Transform4f(leaf)
    moved.params.update()
    dr.backward(dr.sum(mi.render(moved.of, moved.params, spp=1), axis=None))
    gradient, pose = (np.array(x, np.float64).reshape(4, 4) for x in (dr.grad(leaf), leaf))
    symmetric = gradient[:3, :3] @ pose[:3, :3].T
    np.testing.assert_allclose(symmetric + symmetric.T, 0, atol=1e-5 * np.abs(gradient).max())
    assert np.abs(gradient[:3, 3]).max() > 0.1 and not gradient[3].any()
