"""Render a case by the product and the float64 reference: errors, verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.stability.cases import Array, Case
from benchmarks.stability.exact import (
    fast_camera,
    light_gradient,
    light_of,
    product_order,
    scene_of,
    visibility_of,
)
from mi_refgs.kernels.device import upload, upload_tensor
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.reference import image as reference
from mi_refgs.reference.footprint import Surfel
from mi_refgs.render.depth_normals import normals_from_depth
from mi_refgs.render.pipeline import Request, SurfelScene, render
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.table import Surfels

IMAGE_LIMIT = 1e-4
"""Largest error of a map's pixel, relative to the map's largest value: a fortieth of an 8-bit step."""
GRADIENT_LIMIT = 1e-2  # largest ‖g - g₆₄‖ / ‖g₆₄‖ of a class of parameters
ORDER_LIMIT = 1e-5  # largest relative difference of the depths of two surfels that show in the wrong order
ULP = 2.0**-23
ILL = 8.0
"""An error of up to so many times what one unit in the last place of the inputs does to the exact answer is
the input's own: no float32 formula could do better."""
NEGLIGIBLE = 1e-5
"""A class whose gradient is smaller than this share of the largest class's (positions in units of the
scene's extent) is compared with that share: GRADIENT_LIMIT of it is float32's resolution of the largest."""
KEPT = 0.4
"""Share of the pixels that show something which must lie outside the float64 reference's declared bands."""
LOSS_MAPS = ("radiance", "alpha", "depth", "normal")
GRADIENTS = (
    "position", "rotation", "scale", "opacity", "radiance_sh", "albedo", "metallic", "roughness",
    "indirect_sh", "light",
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """What is measured of a case. Errors are relative, see IMAGE_LIMIT and GRADIENT_LIMIT."""

    name: str
    image: float  # of radiance and alpha
    maps: float  # of depth, normal and materials
    gradients: dict[str, float]
    non_finite: int
    kept: float  # share of the pixels that show something, outside the declared bands
    order: float
    image_floor: float  # change of the exact answer by one ulp of the inputs
    gradient_floor: dict[str, float]

    @property
    def verdict(self) -> str:
        """Return "within limits", "ill-conditioned", or what fails."""
        failed: list[str] = []
        ill: list[str] = []
        if self.non_finite:
            failed.append(f"{self.non_finite} values are not finite")
        if self.kept < KEPT:
            failed.append(f"only {self.kept:.0%} of the pixels are compared")
        if self.order > ORDER_LIMIT:
            failed.append(f"order wrong by {self.order:.1e}")
        checks = [(n, getattr(self, n), IMAGE_LIMIT, self.image_floor) for n in ("image", "maps")]
        checks += [(n, e, GRADIENT_LIMIT, self.gradient_floor[n]) for n, e in self.gradients.items()]
        for name, error, limit, floor in checks:
            if not error <= limit:
                (ill if error <= ILL * floor else failed).append(f"{name} {error:.1e}")
        if failed:
            return "FAILS: " + ", ".join(failed)
        return "ill-conditioned: " + ", ".join(ill) if ill else "within limits"

    def record(self) -> dict[str, Any]:
        """For JSON: one level."""
        gradient = max(self.gradient_floor.values(), default=0.0)
        flat = {"case": self.name, "image": self.image, "maps": self.maps, "ulp_image": self.image_floor}
        flat |= {"ulp_gradient": gradient, "non_finite": self.non_finite, "kept": self.kept}
        flat |= {"order": self.order, "verdict": self.verdict}
        return flat | {f"gradient_{name}": self.gradients.get(name) for name in GRADIENTS}


# ---------------- the product ----------------


@dataclass(frozen=True)
class Found:
    """What the product made: maps (H·W, …), gradients, and how many values are not finite."""

    maps: dict[str, Array]
    gradients: dict[str, Array]
    non_finite: int


def product(case: Case, weights: dict[str, Array]) -> Found:
    """Render, and differentiate Σ weights · maps (H·W, …)."""
    surfels = Surfels({name: upload_tensor(x) for name, x in case.raw.items()})
    light = EnvironmentLight(upload_tensor(case.light))
    surfels.enable_grad()
    dr.enable_grad(light.raw)
    camera = fast_camera(case)
    shading: Any = Shading(case.at, case.reflectance, case.diffuse, case.mesh is not None)  # type: ignore[arg-type]
    occluder = None if case.mesh is None else Occluder(case.mesh())
    used = light.prefilter() if case.reflectance == "split_sum" else None
    scene = SurfelScene(surfels, shading, used, occluder)
    frame = render(scene, camera, Request(scene.all_aovs if used is not None else ("normal",)))
    maps = {"radiance": frame.radiance, "alpha": frame.alpha, "depth": frame.depth, "normal": frame.normal}
    planes = {n: [x] if dr.depth_v(x) == 1 else [*x] for n, x in (maps | frame.maps).items()}
    others: list[Any] = list(normals_from_depth(frame.depth, frame.alpha, camera)[0])
    if frame.terms is not None:
        others += [*frame.terms.diffuse, *frame.terms.specular, *frame.terms.indirect]
    loss = mi.Float(0)
    for name, weight in weights.items():
        for plane, w in zip(planes[name], weight.reshape(len(weight), -1).T, strict=True):
            loss += dr.sum(plane * upload(w))
    if dr.grad_enabled(loss):
        dr.backward(loss)
    gradients = {name: dr.grad(x).numpy() for name, x in surfels.raw.items()}
    gradients["light"] = dr.grad(light.raw).numpy()
    pixels = case.camera.width * case.camera.height
    shown = {n: np.stack([_plane(x, pixels) for x in values], 1) for n, values in planes.items()}
    arrays = [*shown.values(), *gradients.values(), *(_plane(x, pixels) for x in others)]
    return Found(shown, gradients, sum(int(np.sum(~np.isfinite(x))) for x in arrays))


def _plane(x: Any, pixels: int) -> Array:
    return np.broadcast_to(np.array(dr.detach(x)), (pixels,)).astype(np.float64)


# ---------------- comparing ----------------


def chosen_pixels(case: Case) -> Array:
    """Raster indices that the float64 reference looks at."""
    every = case.camera.width * case.camera.height
    if case.pixels is None or case.pixels >= every:
        return np.arange(every)
    return np.sort(np.random.default_rng(5).choice(every, case.pixels, replace=False))


def measure(case: Case, floors: bool = True) -> Row:
    """All numbers of a case; `floors`: the condition of the answer even where nothing exceeds a limit."""
    case = case.rounded()
    pixels = chosen_pixels(case)
    order = product_order(case, pixels) if len(case.raw["position"]) else np.empty((0, len(pixels)), int)
    scene = scene_of(case, pixels, order)
    truth = reference.render(scene, band=case.band)
    band = truth.band | _flips(case, scene, truth)
    weights = _weights(truth, band)
    truth = reference.render(scene, weights)
    exact = _gradients(case, scene, truth)
    spread = {n: np.zeros((case.camera.width * case.camera.height, w.shape[1])) for n, w in weights.items()}
    for name, values in weights.items():
        spread[name][pixels] = values
    found = product(case, spread)
    maps = {name: values[pixels] for name, values in found.maps.items()}
    image, others = map_errors(maps, truth.maps, ~band)
    gradients = gradient_errors(found.gradients, exact, scene.raw)
    worst = max(gradients.values(), default=0.0)
    image_floor, gradient_floor = 0.0, dict.fromkeys(gradients, 0.0)
    if floors or max(image, others) > IMAGE_LIMIT or worst > GRADIENT_LIMIT:
        image_floor, gradient_floor = condition(case, scene, truth, exact, weights, band)
    shown = truth.maps["alpha"][:, 0] > 0
    kept = float(np.mean(~band[shown])) if shown.any() else 1.0
    inverted = inversion(case, scene, truth) if len(order) else 0.0
    return Row(
        case.name, image, others, gradients, found.non_finite, kept, inverted, image_floor, gradient_floor
    )


def map_errors(found: dict[str, Array], exact: dict[str, Array], keep: Array) -> tuple[float, float]:
    """Largest errors, relative to the largest value of a map: radiance and alpha; the other maps."""
    errors = {}
    for name in exact.keys() & found.keys() if keep.any() else ():
        error = float(np.abs(found[name] - exact[name])[keep].max())
        errors[name] = error / (float(np.abs(exact[name]).max()) or 1)
    first = [errors.pop(name, 0.0) for name in ("radiance", "alpha")]
    return max(first), max(errors.values(), default=0.0)


def gradient_errors(
    found: dict[str, Array], exact: dict[str, Array], raw: dict[str, Array]
) -> dict[str, float]:
    """‖g - g₆₄‖ / ‖g₆₄‖ of every class, ‖g₆₄‖ no smaller than NEGLIGIBLE says.

    Columns are weighed by what they are measured in: positions by the scene's extent, quaternions
    by their length."""
    sizes, difference = _sizes(exact, raw), {n: found[n].astype(np.float64) - x for n, x in exact.items()}
    errors, least = _sizes(difference, raw), NEGLIGIBLE * max(sizes.values(), default=0.0)
    return {n: e / s if (s := max(sizes[n], least)) > 0 else e for n, e in errors.items()}


def _sizes(gradients: dict[str, Array], raw: dict[str, Array]) -> dict[str, float]:
    units: dict[str, Any] = {"position": _extent(raw["position"])}
    length = np.linalg.norm(raw["rotation"], axis=1, keepdims=True)
    units["rotation"] = np.maximum(length, reference.QUATERNION_FLOOR)
    names = [n for n in GRADIENTS if n in gradients and gradients[n].size]
    return {n: float(np.linalg.norm(units.get(n, 1.0) * gradients[n])) for n in names}


def _extent(position: Array) -> float:
    """Root mean square distance of positions to their mean; 1 where they coincide."""
    return float(np.sqrt(np.asarray(position, np.float64).var(0).sum())) or 1.0 if len(position) else 1.0


def _gradients(case: Case, scene: reference.Scene, truth: reference.Image) -> dict[str, Array]:
    gradients = dict(truth.gradients)
    if scene.light is not None:
        gradients["light"] = light_gradient(case.light, scene.light, gradients["light"])
    return gradients


def _weights(truth: reference.Image, band: Array) -> dict[str, Array]:
    rng = np.random.default_rng(11)
    weights = {}
    for name in LOSS_MAPS:
        values = truth.maps[name]
        peak = float(np.abs(values).max()) or 1.0
        random = rng.normal(size=values.shape) / (peak * len(values))
        weights[name] = np.where(band[:, None], 0, random).astype(np.float32).astype(np.float64)
    return weights


def _flips(case: Case, scene: reference.Scene, truth: reference.Image) -> Array:
    """Pixels (P,) at a declared discontinuity: their visibility changes when normal and ray turn by 1e-4 and
    1e-5, or with the offset of rays that a mesh made elsewhere may have."""
    flips = np.zeros(len(scene.pixels), bool)
    if scene.visibility is None:
        return flips
    x, y = scene.pixels % scene.camera.width + 0.5, scene.pixels // scene.camera.width + 0.5
    c = scene.camera
    ray = np.stack([(x - c.cx) / c.fx, (y - c.cy) / c.fy, np.ones_like(x)], 1) @ c.to_world[:3, :3].T
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    length = np.maximum(np.linalg.norm(truth.maps["normal"], axis=1, keepdims=True), 1e-30)
    normal = truth.maps["normal"] / length
    base, rng = scene.visibility(normal, ray), np.random.default_rng(3)
    for _ in range(8):
        moved = normal + 1e-4 * rng.normal(size=normal.shape)
        turned = ray + 1e-5 * rng.normal(size=ray.shape)
        flips |= scene.visibility(moved, turned) != base
    if case.further:
        flips |= visibility_of(case, normal, ray, case.further) != base
    return flips


def condition(
    case: Case,
    scene: reference.Scene,
    truth: reference.Image,
    exact: dict[str, Array],
    weights: dict[str, Array],
    band: Array,
) -> tuple[float, dict[str, float]]:
    """What one ulp of every input, up or down at random, does to the exact image and gradients: the larger
    of two draws."""
    images, gradients = [0.0], [dict.fromkeys(gradient_errors(exact, exact, scene.raw), 0.0)]
    rng = np.random.default_rng(7)

    def nudged(x: Array) -> Array:
        return x * (1 + ULP * rng.choice([-1.0, 1.0], size=np.shape(x)))

    for _ in range(2):
        pose = scene.camera.to_world.copy()
        pose[:3, 3] = nudged(pose[:3, 3])
        raw_light = nudged(np.asarray(case.light, np.float64))
        light = None if scene.light is None else light_of(raw_light)
        raw = {name: nudged(x) for name, x in scene.raw.items()}
        moved = replace(scene, raw=raw, camera=replace(scene.camera, to_world=pose), light=light)
        image = reference.render(moved, weights)
        images.append(max(map_errors(image.maps, truth.maps, ~band)))
        gradients.append(
            gradient_errors(_gradients(replace(case, light=raw_light), moved, image), exact, scene.raw)
        )
    return max(images), {n: max(g[n] for g in gradients) for n in gradients[0]}


def inversion(case: Case, scene: reference.Scene, truth: reference.Image) -> float:
    """Largest relative difference of depths in the wrong order, among the surfels that a pixel shows."""
    phase = fast_camera(case).tile_offset
    key = Surfel.sort_key(scene.raw, scene.camera, scene.pixels, phase)
    key, shown = (np.take_along_axis(x, scene.order, 0) for x in (key, truth.shown))
    key = np.where(shown, key, 0)
    late = np.where(shown, (np.maximum.accumulate(key) - key) / np.where(shown, key, 1), 0)
    return float(late.max(initial=0))
