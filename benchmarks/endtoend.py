"""Whole frames and gradients of `refgs`, and of Mitsuba's `path` and `prb`: time against error.

    python -m benchmarks.endtoend                     three scenes, in about four minutes on 2 cores
    python -m benchmarks.endtoend --small -o out      a small instance, below a minute

The surfels have the shape and the materials of the mesh: nothing is fitted. Errors are ‖x - ref‖ / ‖ref‖, of
the frame against the converged path tracer, of gradients against `prb`. The error of shading is that of the
product's shading at the mesh's own hits, averaged over each pixel; the rest is geometry and sampling.
Writes endtoend.json; `python -m benchmarks.pages` makes the tables."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from tqdm import tqdm

from benchmarks.common import timing
from benchmarks.common.report import Row, benchmark
from benchmarks.common.setup import path_tracer
from benchmarks.common.view import ROOT
from benchmarks.visibility.cases import Rule, make_scene
from benchmarks.visibility.setup import Setup
from mi_refgs.synthesis.mesh_surfels import surfels_from_mesh

DEPTH = 8
SIDE = 4  # points per side of a pixel at which shading is exact
RULE = Rule(1, 2)  # the mirror ray is traced, with two bounces
WISHED = 1.3  # the loss compares with the image of a roughness this many times larger
MATERIALS = ("albedo", "metallic", "roughness")
TEXELS = "light.data"
VARIED = {
    "refgs": ("refgs.albedo", "refgs.roughness"),
    "path": ("shape.bsdf.albedo.value", "shape.bsdf.roughness.value"),
}
"""Parameters whose derivatives are compared, besides the texels."""


@dataclass(frozen=True)
class Scene:
    """A mesh of scenes/meshes or of benchmarks.visibility, a light, and a material."""

    shape: str
    light: str
    metallic: float
    roughness: float


@dataclass(frozen=True)
class Settings:
    """One run; counts rise."""

    scenes: tuple[Scene, ...] = (
        Scene("rounded_cube", "studio", 0.5, 0.3),
        Scene("trefoil", "gradient", 0.0, 0.5),
        Scene("deep_bowl", "studio", 1.0, 0.1),
    )
    edge: int = 128  # of the image
    surfels: tuple[int, ...] = (2_500, 10_000, 40_000)
    refgs_spp: tuple[int, ...] = (1, 4)
    path_spp: tuple[int, ...] = (1, 4, 16, 64)  # of `prb`, too
    reference_spp: int = 256  # of each batch
    batches: int = 4
    light_height: int = 64
    seconds: float = 1.0  # spent on each time, at least
    rounds: int = 9  # of each time, at most

    @property
    def size(self) -> int:
        """Edge of the grid of exact points."""
        return SIDE * self.edge

    timing_size = size


PAGE = Settings()
SMALL = Settings(PAGE.scenes[:1], 32, (2_000,), (1,), (1, 4), 64, 2, 32, 0.02, 1)


class Case(Setup):
    """A scene: its mesh for Mitsuba, and surfels on the mesh for `refgs`."""

    def __init__(self, scene: Scene, settings: Settings) -> None:
        file, self.what = ROOT / "scenes" / "meshes" / f"{scene.shape}.ply", scene
        concave = make_scene(str(file) if file.exists() else scene.shape, 1)
        super().__init__(concave, settings, scene.light, scene.metallic, scene.roughness)
        film = {"type": "hdrfilm", "width": settings.edge, "height": settings.edge, "pixel_format": "rgb"}
        pose = mi.ScalarTransform4f().look_at(concave.look.origin, concave.look.target, [0, 1, 0])
        camera = {"type": "perspective", "fov": concave.look.fov, "to_world": pose}
        self.camera = mi.load_dict(camera | {"film": film | {"rfilter": {"type": "box"}}})

    def refgs(self, count: int) -> Any:
        """A scene of surfels on the mesh, with its normals and material, under the same light."""
        surfels = surfels_from_mesh(self.scene, count, attributes=MATERIALS)
        options = {"diffuse": "irradiance", "traced_bounces": RULE.bounces}
        with self.mesh_file() as path:
            refgs = {"type": "refgs", "mesh": path} | options | surfels.raw
            return mi.load_dict({"type": "scene", "refgs": refgs, "light": self.map.emitter()})

    def exact(self) -> np.ndarray:
        """The product's shading at the mesh's hits, averaged over each pixel: (H, W, 3)."""
        image, edge = np.zeros((self.settings.size**2, 3)), self.settings.edge
        image[self.points.pixel.numpy()] = self.image(RULE)
        return image.reshape(edge, SIDE, edge, SIDE, 3).mean((1, 3))

    def frame(self, scene: Any, integrator: Any, spp: int, seed: int = 0) -> Any:
        """The image (H, W, 3); without an integrator by the scene's own, `refgs`."""
        return mi.render(scene, sensor=self.camera, integrator=integrator, spp=spp, seed=seed)[..., :3]

    def gradient(self, scene: Any, integrator: Any, spp: int, weights: Any, seed: int = 0) -> list[Any]:
        """Derivatives of Σ weights · image by all albedos, all roughnesses, and the texels of the light."""
        params = mi.traverse(scene)
        names = (*VARIED["path" if integrator else "refgs"], TEXELS)
        leaves = {name: type(params[name])(params[name]) for name in names}
        dr.enable_grad(leaves)
        params.update(leaves)
        what = {"sensor": self.camera, "integrator": integrator, "spp": spp, "seed": seed}
        dr.backward(dr.sum(weights * mi.render(scene, params, **what)[..., :3], axis=None))
        params.update({name: dr.detach(leaf) for name, leaf in leaves.items()})
        return [dr.grad(leaf) for leaf in leaves.values()]

    def in_common(self, found: list[Any], raw: bool) -> np.ndarray:
        """One row of derivatives by the albedo, the roughness and the texels; `raw`: by logits of surfels."""
        albedo, roughness, texels = (np.array(x, np.float64) for x in found)
        if raw:
            albedo = albedo.sum(0) / (self.albedo * (1 - self.albedo))
            roughness = roughness.sum(0) / (self.what.roughness * (1 - self.what.roughness))
        return np.concatenate([x.ravel() for x in (albedo, roughness, texels)])

    def batches(self, call: Callable[[int], Any]) -> np.ndarray:
        """Mean over batches of a call with a seed."""
        return np.mean([np.asarray(call(1 + i), np.float64) for i in range(self.settings.batches)], 0)

    def measure(self) -> list[Row]:
        """A row for each renderer and setting."""
        settings, path, prb = self.settings, *(path_tracer(DEPTH, type, True) for type in ("path", "prb"))
        spp, roughness = settings.reference_spp, self.what.roughness
        reference = self.batches(lambda seed: self.frame(self.scene, path, spp, seed))
        self.set_material(self.what.metallic, WISHED * roughness)
        wished = self.batches(lambda seed: self.frame(self.scene, path, spp, seed))
        self.set_material(self.what.metallic, roughness)
        weights = mi.TensorXf((2 * (reference - wished) / reference.size).astype(np.float32))
        truth = self.batches(
            lambda seed: self.in_common(self.gradient(self.scene, prb, spp // 4, weights, seed), False)
        )
        exact = self.exact()
        found: list[Row] = []
        scenes = {count: self.refgs(count) for count in settings.surfels}
        keys = [("refgs", count, spp) for count in settings.surfels for spp in settings.refgs_spp]
        keys += [("path", 0, spp) for spp in settings.path_spp]
        frames, gradients = {}, {}
        for key in keys:
            name, count, spp = key
            scene, tracers = (scenes[count], (None, None)) if name == "refgs" else (self.scene, (path, prb))
            frames[key] = partial(self.frame, scene, tracers[0], spp)
            gradients[key] = partial(self.gradient, scene, tracers[1], spp, weights)
        limits = settings.seconds, settings.rounds
        ms, gradient_ms = timing.milliseconds(frames, *limits), timing.milliseconds(gradients, *limits)
        for key, call in frames.items():
            image = np.asarray(call(), np.float64)
            gradient = self.in_common(gradients[key](), key[0] == "refgs")
            row = dict(zip(("renderer", "surfels", "spp"), key, strict=True), scene=self.name)
            row |= {"ms": ms[key], "error": error(image, reference)}
            row |= {"gradient_ms": gradient_ms[key], "gradient_error": error(gradient[4:], truth[4:])}
            row |= {"material_gradient_error": error(gradient[:4], truth[:4])}
            if key[0] == "refgs":
                scale = np.linalg.norm(reference)
                row |= {"shading": error(exact, reference), "geometry": np.linalg.norm(image - exact) / scale}
            found.append(row)
        return found


def error(values: np.ndarray, reference: np.ndarray) -> float:
    """‖values - reference‖ / ‖reference‖."""
    return float(np.linalg.norm(values - reference) / np.linalg.norm(reference))


def measure(settings: Settings, quiet: bool) -> dict[str, Any]:
    """Times and errors of every scene."""
    found: list[Row] = []
    for scene in tqdm(settings.scenes, disable=quiet):
        found += Case(scene, settings).measure()
    return {"settings": asdict(settings), "rows": found}


if __name__ == "__main__":
    sys.exit(benchmark("endtoend", __doc__, measure, PAGE, SMALL))
