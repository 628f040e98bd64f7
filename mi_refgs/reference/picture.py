"""A whole picture and its gradients in float64: footprints, compositing, shading, for any pixels of a view.

Every stage treats its items (surfels, surfel-pixel pairs, pixels) one by one, so its derivative is one
complex step a column, exact to the last digit: the imaginary part of f(x + ih) is h f'(x). Compositing has
the derivative of its sums. The order of surfels is an input: the sort has no derivative.

Letters: N surfels, P pixels, K features, D raw columns. Maps are (P, …).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from mi_refgs import constants as c
from mi_refgs.reference.blend import STEP, Blend
from mi_refgs.reference.footprint import Rules
from mi_refgs.reference.lookup import Light, harmonics, positive, shade, unit
from mi_refgs.reference.pinhole import QUATERNION_FLOOR, PinholeCamera, rotation_axes, sigmoid
from mi_refgs.reference.primitives import primitive_of

Array = np.ndarray
MAPS = ("radiance", "alpha", "depth", "normal", "albedo", "metallic", "roughness")


@dataclass(frozen=True)
class Scene:
    """What a picture is made from. `order` (N, P): surfels from front to back at each pixel."""

    raw: dict[str, Array]
    camera: PinholeCamera
    pixels: Array  # (P,) raster indices
    order: Array
    at: str = "pixel"
    reflectance: str = "split_sum"
    diffuse: str = "sh"
    light: Light | None = None
    visibility: Callable[[Array, Array], Array] | None = None  # unit normals, unit rays (P, 3) → 0 … 1 (P,)
    rules: Rules = field(default_factory=Rules)


@dataclass
class Picture:
    """Maps (P, …) by name; `taps` of lookups in the light: texels, weights, and what their sum is times."""

    maps: dict[str, Array]
    band: Array  # (P,): a declared discontinuity is near
    shown: Array  # (N, P): surfel contributes
    taps: list[tuple[Array, Array, Array]] = field(default_factory=list)
    gradients: dict[str, Array] = field(default_factory=dict)  # of Σ weights · maps; "light": flat levels


def render(scene: Scene, weights: dict[str, Array] | None = None, band: float = 1e-4) -> Picture:
    """The picture, and with `weights` (P, …) of some maps the gradients of Σ weights · maps.

    `band` is the relative width of the declared discontinuities.
    """
    raw = {name: np.asarray(x, np.float64) for name, x in scene.raw.items()}
    camera = scene.camera
    x, y = scene.pixels % camera.width + 0.5, scene.pixels // camera.width + 0.5
    blend = Blend.of(raw, camera, scene.order, x, y, scene.rules)
    features_of = Features(scene, raw)
    taps: list[tuple[Array, Array, Array]] = []
    features = features_of(features_of.columns, taps).real
    sums = blend.sums(features)
    resolve = Resolve(scene, features_of, x, y, sums)
    pixel_taps: list[tuple[Array, Array, Array]] = []
    maps = resolve.named(resolve(sums, pixel_taps).real)

    picture = Picture(maps, blend.band(band), blend.shown, taps + pixel_taps)
    if weights is None:
        return picture

    δout = np.concatenate(
        [np.asarray(weights.get(n, np.zeros_like(maps[n])), np.float64).reshape(len(x), -1) for n in maps], 1
    )
    δsums = itemwise_adjoint(lambda v: resolve(v, []), sums, δout)
    gradients, δfeatures = blend.adjoint(features, δsums)
    δraw = itemwise_adjoint(lambda v: features_of(v, []), features_of.columns, δfeatures)
    for name, values in features_of.split(δraw).items():
        gradients[name] = gradients.get(name, np.zeros_like(raw[name])) + values
    zero = np.abs(raw["rotation"]).max(axis=1, initial=0) < QUATERNION_FLOOR
    gradients["rotation"][zero] = 0
    if scene.light is not None:
        δlight = np.zeros((sum(level.size // 3 for level in scene.light.levels), 3))
        δradiance = [(taps, δfeatures[:, features_of.radiance])] if taps else []
        δradiance += [(pixel_taps, δout[:, :3])]
        for found, δcolour in δradiance:
            for texel, share, factor in found:
                np.add.at(δlight, texel, share.real[..., None] * (factor.real * δcolour)[:, None])
        gradients["light"] = δlight
    picture.gradients = gradients
    return picture


def itemwise_adjoint(function: Callable[[Array], Array], inputs: Array, δ: Array) -> Array:
    """δinputs (n, D) of a function of rows (n, D) → (n, K), for δ (n, K)."""
    out = np.zeros_like(inputs)
    for d in range(inputs.shape[1]):
        moved = inputs.astype(complex)
        moved[:, d] += 1j * STEP
        out[:, d] = np.sum(function(moved).imag / STEP * δ, axis=1)
    return out


def sample_depth(scene: Scene) -> Array:
    """Depth (N, P) of the sample of each primitive at each pixel: by it, every pixel sorts for itself."""
    x, y = scene.pixels % scene.camera.width + 0.5, scene.pixels // scene.camera.width + 0.5
    raw = {name: np.asarray(values, np.float64) for name, values in scene.raw.items()}
    return primitive_of(raw).footprint(raw, scene.camera, scene.rules, x, y).z


# ---------------- attributes of surfels ----------------


class Features:
    """Features (N, K) of raw columns (N, D): normal, materials, SH colours; or normal and radiance."""

    def __init__(self, scene: Scene, raw: dict[str, Array]) -> None:
        self.scene, self.normal = scene, primitive_of(raw).normal(raw)
        self.names = [name for name in raw if name not in ("scale", "opacity")]
        self.columns = np.concatenate([raw[name] for name in self.names], axis=1)
        self.widths = [raw[name].shape[1] for name in self.names]
        self.has_indirect = scene.visibility is not None and "indirect_sh" in raw
        self.radiance = slice(3, 6)  # of a surfel that is shaded itself

    def split(self, columns: Array) -> dict[str, Array]:
        """Columns by channel."""
        return dict(zip(self.names, np.split(columns, np.cumsum(self.widths)[:-1], axis=1), strict=True))

    def __call__(self, columns: Array, taps: list[tuple[Array, Array, Array]]) -> Array:
        raw, scene = self.split(columns), self.scene
        direction = unit(raw["position"] - scene.camera.to_world[:3, 3])
        normal = np.choose(self.normal[:, None], rotation_axes(raw["rotation"]))
        away = np.sum(normal * direction, 1, keepdims=True).real > c.FACING_TOLERANCE
        normal = np.where(away, -normal, normal)
        materials = [sigmoid(raw[n]) for n in ("albedo", "metallic", "roughness") if n in raw]
        colour = positive(harmonics(raw["radiance_sh"], direction) + 0.5)
        if scene.at == "surfel":
            if scene.reflectance == "split_sum":
                assert scene.light is not None
                m = np.concatenate(materials, axis=1)
                own = colour if scene.diffuse == "sh" else None
                colour = shade(scene.light, normal, -direction, m, own, None, None, scene.diffuse, taps)
            return np.concatenate([normal, colour, *materials], axis=1)
        parts = [normal, *materials]
        if scene.diffuse == "sh":
            parts.append(colour)
        if self.has_indirect:
            n_v = -np.sum(normal * direction, 1, keepdims=True)
            parts.append(positive(harmonics(raw["indirect_sh"], 2 * n_v * normal + direction)))
        return np.concatenate(parts, axis=1)


class Resolve:
    """Maps (P, …) of blended sums (P, K + 2): features, depth, alpha."""

    def __init__(self, scene: Scene, features: Features, x: Array, y: Array, sums: Array) -> None:
        self.scene, self.features = scene, features
        camera = scene.camera
        ray = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=1)
        self.ray = unit(ray @ camera.to_world[:3, :3].T)
        self.visibility = None
        if scene.visibility is not None:
            self.visibility = scene.visibility(unit(sums[:, :3]), self.ray)

    def __call__(self, sums: Array, taps: list[tuple[Array, Array, Array]]) -> Array:
        alpha = sums[:, -1:]
        seen = alpha.real > c.COVERAGE_FLOOR
        inverse = np.where(seen, 1 / np.where(seen, alpha, 1), 0)
        normal, depth = sums[:, :3], sums[:, -2:-1] * inverse
        if self.scene.at == "surfel":
            return np.concatenate([sums[:, 3:6], alpha, depth, normal, sums[:, 6:-2] * inverse], axis=1)
        assert self.scene.light is not None
        materials, rest = sums[:, 3:8] * inverse, sums[:, 8:-2] * inverse
        own = rest[:, :3] if self.scene.diffuse == "sh" else None
        indirect = rest[:, -3:] if self.features.has_indirect else None
        found: list[tuple[Array, Array, Array]] = []
        colour = shade(
            self.scene.light, normal, -self.ray, materials, own, self.visibility, indirect,
            self.scene.diffuse, found,
        )  # fmt: skip
        taps += [(texel, share, factor * alpha) for texel, share, factor in found]
        return np.concatenate([colour * alpha, alpha, depth, normal, materials], axis=1)

    def named(self, values: Array) -> dict[str, Array]:
        """Columns by map."""
        parts = np.split(values, [3, 4, 5, 8, 11, 12], axis=1)
        return {n: p for n, p in zip(MAPS, parts, strict=True) if p.shape[1]}
