"""An open scene in the renderer and in float64: object, surroundings and background, in either order."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.stability import exact
from benchmarks.stability.cases import camera, plain
from mi_refgs.kernels.device import upload
from mi_refgs.reference import image as oracle
from mi_refgs.render.pipeline import Frame, Request, SurfelScene, render
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.near_field import NearField
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.table import Surfels
from tests.scenes.integrator import scattered_discs

FAR, NEAR = 0.0, 0.25  # 1 / distance of what the light shows
CASES = [("pixel", "irradiance", NEAR, "surfel"), ("surfel", "sh", FAR, "gaussian")]
CENTRE = np.array([0.2, -0.1, 0.3])  # the point from which the light shows it
MAPS = "radiance alpha depth normal object_alpha albedo metallic roughness background".split()


@dataclass(frozen=True)
class Pair:
    """The plain case with surroundings: the renderer and the float64 reference."""

    at: str
    diffuse: str
    nearness: float = FAR
    primitive: str = "gaussian"  # of the surroundings

    @cached_property
    def around(self) -> dict[str, np.ndarray]:
        return scattered_discs(primitive=self.primitive)

    @cached_property
    def case(self) -> Any:
        case = plain("open", at=self.at, diffuse=self.diffuse, camera=camera())
        return replace(case, raw={n: x for n, x in case.raw.items() if n != "indirect_sh"}).rounded()

    @cached_property
    def values(self) -> dict[str, np.ndarray]:
        """Every parameter (float32) by name, as in a fit."""
        rng = np.random.default_rng(9)
        found = {name: np.asarray(x, np.float32) for name, x in self.case.raw.items()}
        found |= {f"surroundings/{name}": x for name, x in self.around.items()}
        background = rng.normal(size=(8, 16, 3)).astype(np.float32)
        return found | {"light": np.asarray(self.case.light, np.float32), "background": background}

    @cached_property
    def order(self) -> np.ndarray:
        pixels = np.arange(self.case.camera.width * self.case.camera.height)
        return exact.product_order(self.case, pixels, self.around)

    def truth(self, values: dict[str, np.ndarray], pose: np.ndarray | None = None) -> tuple[Any, np.ndarray]:
        """Maps and band in float64, from the camera's own pose or another (4, 4)."""
        case = replace(self.case, raw={n: values[n] for n in self.case.raw})
        if pose is not None:
            case = replace(case, camera=replace(case.camera, to_world=pose))
        pixels = np.arange(case.camera.width * case.camera.height)
        light = replace(exact.light_of(values["light"]), centre=CENTRE, nearness=self.nearness)
        scene = exact.scene_of(case, pixels, self.order, light)
        others = {name: values[f"surroundings/{name}"] for name in self.around}
        image = oracle.render(replace(scene, around=others, background=values["background"]))
        return image.maps, image.band

    def loss(self, values: dict[str, np.ndarray], pose: np.ndarray | None = None) -> float:
        """The weighted sum of the maps in float64."""
        maps, _ = self.truth(values, pose)
        return sum(float(np.sum(w * maps[name])) for name, w in self.weights.items())

    @cached_property
    def weights(self) -> dict[str, np.ndarray]:
        """Random numbers for each value of each map, 0 near a declared discontinuity."""
        rng = np.random.default_rng(11)
        maps, band = self.truth(self.values)
        drawn = {name: rng.normal(size=maps[name].shape) / np.abs(maps[name]).max() for name in MAPS}
        return {name: np.where(band[:, None], 0, x) for name, x in drawn.items()}

    def frame(self, params: dict[str, Any], eye: Camera | None = None) -> Frame:
        surfels = Surfels({name: params[name] for name in self.case.raw})
        others = Surfels({name: params[f"surroundings/{name}"] for name in self.around})
        behind = Surroundings(others, EnvironmentLight(params["background"]))
        light = EnvironmentLight(params["light"]).prefilter()
        shading = Shading(self.at, "split_sum", self.diffuse)  # type: ignore[arg-type]
        eye = eye or exact.fast_camera(self.case)
        near = NearField(CENTRE, np.full((4, 8), self.nearness)) if self.nearness else None
        scene = SurfelScene(surfels, shading, light, surroundings=behind, near=near)
        return render(scene, eye, Request(scene.all_aovs))

    def planes(self, params: dict[str, Any], eye: Camera | None = None) -> dict[str, list[Any]]:
        frame = self.frame(params, eye)
        named = {name: getattr(frame, name) for name in MAPS if hasattr(frame, name)} | frame.maps
        found = {name: [*value] if dr.depth_v(value) > 1 else [value] for name, value in named.items()}
        return {name: found[name] for name in MAPS}


def weighted(planes: dict[str, list[Any]], weights: dict[str, np.ndarray]) -> Any:
    total = mi.Float(0)
    for name, table in weights.items():
        for plane, w in zip(planes[name], table.T, strict=True):
            total += dr.sum(plane * upload(np.ascontiguousarray(w, np.float32)))
    return total
