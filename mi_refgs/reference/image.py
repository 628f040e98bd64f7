"""Render an image and its gradients in float64: footprints, compositing, shading, for any pixels of a view.

Every stage treats its items one by one, so its derivative is one complex step per column, exact to the last
digit: the imaginary part of f(x + ih) is h f'(x). The order of surfels is an input.

Letters: N surfels, P pixels, K features, D raw columns. Maps are (P, …).
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import map_coordinates

from mi_refgs import constants as c
from mi_refgs.reference.camera import QUATERNION_FLOOR, PinholeCamera, ray_slopes, rotation_axes, sigmoid
from mi_refgs.reference.footprint import Raw, Rules
from mi_refgs.reference.light import Light, radiance_of
from mi_refgs.reference.models import MATERIALS, MODELS, Options, Points, Taps, harmonics, positive, unit
from mi_refgs.reference.splat import STEP, Blend, primitive_of

Array = np.ndarray
TERMS = ("diffuse", "specular", "indirect")


@dataclass(frozen=True)
class Scene:
    """What an image is rendered from. `order` (N, P): surfels from front to back at each pixel."""

    raw: Raw
    camera: PinholeCamera
    pixels: Array  # (P,) raster indices
    order: Array
    at: str = "pixel"
    reflectance: str = "split_sum"
    diffuse: str = "sh"
    light: Light | None = None
    visibility: Callable[[Array, Array], Array] | None = None  # unit normals, unit rays (P, 3) → 0 … 1 (P,)
    rules: Rules = field(default_factory=Rules)
    options: Options = field(default_factory=Options)  # but its `diffuse`, which is the one above
    antialias: bool = False  # the mean over each pixel; of all pixels of the camera, and without gradients
    terms: bool = False  # also the terms of the radiance, premultiplied; these give the light no gradient
    around: Raw | None = None  # M rows, last in `order` (N + M, P); no gradients
    background: Array | None = None  # (h, 2h, 3) raw, seen behind both; radiance is log(1 + exp raw)


@dataclass
class Image:
    """Maps (P, …) by name, and their gradients."""

    maps: dict[str, Array]
    band: Array  # (P,): a declared discontinuity is near
    shown: Array  # (N, P): surfel contributes
    gradients: dict[str, Array] = field(default_factory=dict)  # of Σ weights · maps; "light": flat levels


def render(scene: Scene, weights: dict[str, Array] | None = None, band: float = 1e-4) -> Image:
    """Image, and with `weights` (P, …) gradients of Σ weights · maps; `band`: of discontinuities."""
    tables = scene.raw, scene.around or {}
    raw, around = ({n: np.asarray(x, np.float64) for n, x in table.items()} for table in tables)
    camera, count = scene.camera, len(raw["position"])
    x, y = scene.pixels % camera.width + 0.5, scene.pixels // camera.width + 0.5
    blend = Blend([raw, around] if around else [raw], camera, scene.order, x, y, scene.rules)
    features_of = Features(scene, raw)
    taps: Taps = []
    features, turns = np.split(features_of(features_of.columns, taps).real, [features_of.width], axis=1)
    # Features and alpha are those of the object, the depth is that of everything.
    weight, depth = blend.weight[:count], np.sum(blend.weight * blend.z, 0)
    sums = np.concatenate([blend.sums(features, turns), depth[:, None], weight.sum(0)[:, None]], axis=1)
    resolve = Resolve(scene, features_of, x, y, sums)
    mean_depth = depth * inverse_alpha(blend.weight.sum(0))
    resolve.depth = mean_depth if around else None
    pixel_taps: Taps = []
    maps = split(resolve(sums, pixel_taps).real, resolve.maps())
    if around:
        colour = harmonics(around["radiance_sh"], unit(around["position"] - camera.to_world[:3, 3]))
        maps["radiance"] = maps["radiance"] + blend.weight[count:].T @ positive(colour + 0.5)
        maps |= {"object_alpha": maps["alpha"], "alpha": blend.weight.sum(0)[:, None]}
        maps["depth"] = mean_depth[:, None]
    if scene.background is not None:
        texels = np.log1p(np.exp(np.asarray(scene.background, np.float64)))
        maps["background"] = radiance_of(texels, resolve.ray)

    image = Image(maps, blend.band(band), blend.shown)
    if weights is None:
        return image

    δout = np.concatenate(
        [np.asarray(weights.get(n, np.zeros_like(maps[n])), np.float64).reshape(len(x), -1) for n in maps], 1
    )
    δsums = itemwise_adjoint(lambda v: resolve(v, []), sums, δout)
    gradients, δfeatures = blend.adjoint(features, turns, δsums)
    δraw = itemwise_adjoint(lambda v: features_of(v, []), features_of.columns, δfeatures)
    for name, values in split(δraw, features_of.raw_widths).items():
        gradients[name] = gradients.get(name, np.zeros_like(raw[name])) + values
    gradients["rotation"][np.abs(raw["rotation"]).max(axis=1, initial=0) < QUATERNION_FLOOR] = 0
    if scene.light is not None:
        δlight = np.zeros((sum(level.size // 3 for level in scene.light.levels), 3))
        parts = [(taps, δfeatures[:, features_of.radiance])] if taps else []
        for found, δcolour in [*parts, (pixel_taps, δout[:, :3])]:
            for texel, share, factor in found:
                np.add.at(δlight, texel, share.real[..., None] * (factor.real * δcolour)[:, None])
        gradients["light"] = δlight
    image.gradients = gradients
    return image


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


class Features:
    """Features (N, K) of raw columns (N, D), by `layout`: normal, then what is blended besides; then `turns`
    (N, 6) of curved surfels that are shaded in pixels."""

    def __init__(self, scene: Scene, raw: Raw) -> None:
        self.scene, self.normal = scene, primitive_of(raw).normal(raw)
        self.turned = scene.at == "pixel" and "curvature" in raw
        unused = {"opacity"} if self.turned else {"opacity", "scale"}
        self.raw_widths = {name: x.shape[1] for name, x in raw.items() if name not in unused}
        self.columns = np.concatenate([raw[name] for name in self.raw_widths], axis=1)
        self.has_indirect = scene.visibility is not None and "indirect_sh" in raw
        self.options = replace(scene.options, diffuse=scene.diffuse)
        self.radiance = slice(3, 6)  # of a surfel that is shaded itself
        self.materials = {name: raw[name].shape[1] for name in MATERIALS if name in raw}
        if scene.at == "surfel":
            self.layout = {"normal": 3, "radiance": 3, **self.materials}
            self.layout |= dict.fromkeys(TERMS, 3) if scene.terms else {}
        else:
            self.layout = {"normal": 3, **self.materials}
            own = scene.reflectance != "split_sum" or scene.diffuse == "sh"
            self.layout |= ({"radiance": 3} if own else {}) | ({"indirect": 3} if self.has_indirect else {})
        self.width = sum(self.layout.values())  # number of features K

    def __call__(self, columns: Array, taps: Taps) -> Array:
        raw, scene = split(columns, self.raw_widths), self.scene
        direction = unit(raw["position"] - scene.camera.to_world[:3, 3])
        normal = np.choose(self.normal[:, None], rotation_axes(raw["rotation"]))
        away = np.sum(normal * direction, 1, keepdims=True).real > c.FACING_TOLERANCE
        normal = np.where(away, -normal, normal)
        values = {name: sigmoid(raw[name]) for name in self.materials}
        if "radiance_sh" in raw:
            values["radiance"] = positive(harmonics(raw["radiance_sh"], direction) + 0.5)
        if self.has_indirect:
            n_v = -np.sum(normal * direction, 1, keepdims=True)
            values["indirect"] = positive(harmonics(raw["indirect_sh"], 2 * n_v * normal + direction))
        if scene.at == "surfel":
            if scene.reflectance == "monte_carlo" and "indirect_sh" in raw:
                values["incident"] = raw["indirect_sh"]
            if scene.reflectance == "gaussian_shader":
                normal = unit(normal + np.where(away, -1, 1) * raw["normal_offset"])
            points = Points(normal, -direction, values, raw["position"])
            terms = MODELS[scene.reflectance](points, scene.light, self.options, taps)
            values |= dict(zip(TERMS, terms, strict=True)) | {"radiance": sum(terms[1:], terms[0])}
        values["normal"] = normal
        if self.turned:
            turns = primitive_of(raw).turns(raw) * np.where(away, -1, 1)
            return np.concatenate([*(values[name] for name in self.layout), turns], axis=1)
        return np.concatenate([values[name] for name in self.layout], axis=1)


class Resolve:
    """Maps (P, …) of blended sums (P, K + 2): features, depth, alpha."""

    def __init__(self, scene: Scene, features: Features, x: Array, y: Array, sums: Array) -> None:
        self.scene, self.features = scene, features
        self.ray = rays(scene.camera, x, y)
        self.depth: Array | None = None  # (P,) of a scene with a background; else that of the sums
        self.along = self.ray @ scene.camera.to_world[:3, 2]  # camera-z depth per length
        self.found = {}
        if scene.visibility is not None:
            self.found["visibility"] = scene.visibility(unit(sums[:, :3]), self.ray)[:, None]

    def __call__(self, sums: Array, taps: Taps) -> Array:
        scene, alpha = self.scene, sums[:, -1:]
        inverse = inverse_alpha(alpha)
        blended = split(sums[:, :-2], self.features.layout)
        values = {name: x * inverse for name, x in blended.items() if name != "normal"}
        depth = sums[:, -2:-1] * inverse
        maps = {"alpha": alpha, "depth": depth, "normal": blended["normal"], **values}
        z = depth if self.depth is None else self.depth[:, None]
        position = scene.camera.to_world[:3, 3] + z / self.along[:, None] * self.ray
        if scene.at == "surfel":
            maps |= {name: blended[name] for name in ("radiance", *TERMS) if name in blended}
        else:
            terms: list[Array] = []
            nodes = [(blended["normal"], self.ray, self.found)]
            nodes = self._nodes(blended["normal"], alpha) if scene.antialias else nodes
            for normal, ray, visible in nodes:
                found: Taps = []
                points = Points(normal, -ray, values | visible, position)
                here = MODELS[scene.reflectance](points, scene.light, self.features.options, found)
                taps += [(texel, share, factor * alpha / len(nodes)) for texel, share, factor in found]
                shares = [term / len(nodes) for term in here]
                terms = [a + b for a, b in zip(terms, shares, strict=True)] if terms else shares
            maps |= {name: term * alpha for name, term in zip(TERMS, terms, strict=True)}
            maps["radiance"] = sum(terms[1:], terms[0]) * alpha
        return np.concatenate([maps[name] for name in self.maps()], axis=1)

    def _nodes(self, normal: Array, alpha: Array) -> list[tuple[Array, Array, dict[str, Array]]]:
        """Normals, unit rays and visibility (P, …) at the nodes of 2 × 2 Gauss-Legendre points per pixel."""
        camera, shape, found = self.scene.camera, (self.scene.camera.height, self.scene.camera.width, -1), []
        y, x = (axis.ravel() + 0.5 for axis in np.mgrid[: camera.height, : camera.width])
        nodes = np.polynomial.legendre.leggauss(2)[0] / 2
        visible = {n: np.where(alpha.real > c.COVERAGE_FLOOR, v, 1) for n, v in self.found.items()}
        maps = [values.reshape(shape) for values in (normal, *visible.values())]
        for dy in nodes:
            for dx in nodes:
                at, *seen = (bilinear_map(values, x + dx, y + dy) for values in maps)
                found.append((at, rays(camera, x + dx, y + dy), dict(zip(visible, seen, strict=True))))
        return found

    def maps(self) -> dict[str, int]:
        """Columns of each map."""
        widths = {"radiance": 3, "alpha": 1, "depth": 1, "normal": 3, **self.features.materials}
        return widths | (dict.fromkeys(TERMS, 3) if self.scene.terms else {})


def split(columns: Array, widths: dict[str, int]) -> dict[str, Array]:
    """Columns (n, D) by name, for their widths."""
    return dict(zip(widths, np.split(columns, np.cumsum([*widths.values()])[:-1], axis=1), strict=True))


def inverse_alpha(alpha: Array) -> Array:
    """1 / alpha, or 0 below COVERAGE_FLOOR."""
    seen = alpha.real > c.COVERAGE_FLOOR
    return np.where(seen, 1 / np.where(seen, alpha, 1), 0)


def rays(camera: PinholeCamera, x: Array, y: Array) -> Array:
    """Unit directions (P, 3) in the world through points of the image (P,), in pixels."""
    return unit(ray_slopes(camera, x, y).T @ camera.to_world[:3, :3].T)


def bilinear_map(values: Array, x: Array, y: Array) -> Array:
    """Values (P, C) at points of the image (P,), in pixels, of a map (H, W, C); the border repeats."""
    at, planes = (y - 0.5, x - 0.5), np.moveaxis(values, -1, 0)
    return np.stack([map_coordinates(plane, at, order=1, mode="nearest") for plane in planes], axis=1)
