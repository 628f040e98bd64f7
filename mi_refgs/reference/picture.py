"""A whole picture and its gradients in float64: footprints, compositing, shading, for any pixels of a view.

Every stage treats its items (surfels, surfel-pixel pairs, pixels) one by one, so its derivative is one
complex step a column, exact to the last digit: the imaginary part of f(x + ih) is h f'(x). Compositing has
the derivative of its sums. The order of surfels is an input: the sort has no derivative.

Letters: N surfels, P pixels, K features, D raw columns. Maps are (P, …).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from mi_refgs import constants as c
from mi_refgs.reference.splat import PinholeCamera

Array = np.ndarray
STEP = 1e-40
GEOMETRY = ("position", "rotation", "scale", "opacity")
MAPS = ("radiance", "alpha", "depth", "normal", "albedo", "metallic", "roughness")
DIELECTRIC_F0 = 0.04
QUATERNION_FLOOR = 1e-12
"""Largest |component| below which a quaternion is the identity, with gradient 0: a rule of the table."""


@dataclass(frozen=True)
class Light:
    """Prefiltered levels, the map itself first, and the roughness of the others; the split-sum table."""

    levels: list[Array]  # (h, 2h, 3) each
    roughness: tuple[float, ...]
    table: Array  # (n, n, 2): [roughness, n·v]

    def flat(self) -> Array:
        """All texels (T, 3), level after level."""
        return np.concatenate([level.reshape(-1, 3) for level in self.levels])

    def split(self, flat: Array) -> list[Array]:
        """Inverse of `flat`."""
        ends = np.cumsum([level.size // 3 for level in self.levels])[:-1]
        return [x.reshape(y.shape) for x, y in zip(np.split(flat, ends), self.levels, strict=True)]


@dataclass(frozen=True)
class Rules:
    """The named constants of footprints and compositing; others than the product's measure their bias."""

    alpha_min: float = c.ALPHA_MIN
    alpha_max: float = c.ALPHA_MAX
    transmittance_min: float = c.TRANSMITTANCE_MIN
    low_pass: float | None = c.LOW_PASS_INV_VARIANCE  # None: no screen-space filter
    edge_on: float = c.EDGE_ON_COSINE


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
    rules: Rules = Rules()


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
    camera, rules = scene.camera, scene.rules
    x, y = scene.pixels % camera.width + 0.5, scene.pixels // camera.width + 0.5
    columns = np.concatenate([raw[name] for name in GEOMETRY], axis=1)
    culled = _culled(raw, camera, rules)
    sample = _footprint(columns, camera, rules, x, y)
    alpha, z = sample.alpha.real, sample.z.real
    hit = (alpha >= rules.alpha_min) & (z > camera.near) & ~culled[:, None]
    alpha = np.where(hit, alpha, 0)
    order = scene.order
    after = np.take_along_axis(np.log1p(-alpha), order, 0).cumsum(0)
    before = np.exp(np.concatenate([np.zeros((1, len(x))), after[:-1]]))
    ends = math.log(rules.transmittance_min) if rules.transmittance_min else -math.inf
    alive = np.logical_and.accumulate(after >= ends, axis=0)
    before, alive, after = (_unsort(v, order) for v in (before, alive, np.exp(after)))
    shown = hit & alive
    weight = np.where(shown, before * alpha, 0)

    features_of = _Features(scene, raw)
    taps: list[tuple[Array, Array, Array]] = []
    features = features_of(features_of.columns, taps).real
    sums = np.concatenate([weight.T @ features, np.sum(weight * np.where(hit, z, 0), 0)[:, None]], axis=1)
    sums = np.concatenate([sums, weight.sum(0)[:, None]], axis=1)
    resolve = _Resolve(scene, features_of, x, y, sums)
    pixel_taps: list[tuple[Array, Array, Array]] = []
    maps = resolve.named(resolve(sums, pixel_taps).real)

    near_band = alive & ~culled[:, None] & np.isfinite(z)
    unclamped, in_band = sample.unclamped, np.zeros(len(x), bool)
    for values, limit, where in (
        (unclamped, rules.alpha_min, near_band),
        (unclamped, rules.alpha_max, shown),
        (after, rules.transmittance_min, hit),
    ):
        in_band |= np.any(where & (np.abs(values - limit) < band * limit), 0)
    in_band |= np.any(shown & (np.abs(sample.screen - sample.plane) < band * sample.screen), 0)
    in_band |= np.any(near_band & (np.abs(z - camera.near) < band * camera.near), 0)
    picture = Picture(maps, in_band, shown, taps + pixel_taps)
    if weights is None:
        return picture

    δout = np.concatenate(
        [np.asarray(weights.get(n, np.zeros_like(maps[n])), np.float64).reshape(len(x), -1) for n in maps], 1
    )
    δsums = itemwise_adjoint(lambda v: resolve(v, []), sums, δout)
    value = features @ δsums[:, :-2].T + np.where(hit, z, 0) * δsums[:, -2] + δsums[:, -1]
    part = np.take_along_axis(weight * value, order, 0)
    behind = _unsort(np.cumsum(part[::-1], axis=0)[::-1] - part, order)
    δalpha = np.where(shown, before * value - behind / (1 - alpha), 0)
    δz = np.where(shown, weight * δsums[:, -2], 0)
    δcolumns = np.zeros_like(columns)
    for d in range(columns.shape[1]):
        moved = columns.astype(complex)
        moved[:, d] += 1j * STEP
        there = _footprint(moved, camera, rules, x, y)
        slope_alpha, slope_z = there.alpha.imag / STEP, there.z.imag / STEP
        δcolumns[:, d] = np.sum(np.where(shown, δalpha * slope_alpha + δz * slope_z, 0), 1)
    widths = np.cumsum([raw[name].shape[1] for name in GEOMETRY])[:-1]
    gradients = dict(zip(GEOMETRY, np.split(δcolumns, widths, axis=1), strict=True))
    δfeatures = weight @ δsums[:, :-2]
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


def _unsort(values: Array, order: Array) -> Array:
    out = np.empty_like(values)
    np.put_along_axis(out, order, values, axis=0)
    return out


# ---------------- footprints ----------------


@dataclass(frozen=True)
class _Sample:
    """A footprint at pixels, (N, P) each."""

    alpha: Array
    z: Array
    unclamped: Array
    screen: Array
    plane: Array


def camera_frame(raw: dict[str, Array], camera: PinholeCamera) -> tuple[Array, Array]:
    """Centres (N, 3) and axes (N, 3, 3) — t_u, t_v, n — in the camera's frame."""
    to_camera, origin = camera.to_world[:3, :3].T, camera.to_world[:3, 3]
    centre = (raw["position"] - origin) @ to_camera.T
    return centre, np.stack([axis @ to_camera.T for axis in rotation_axes(raw["rotation"])], axis=1)


def rotation_axes(rotation: Array) -> tuple[Array, Array, Array]:
    """Images (N, 3) of the three axes under quaternions (x, y, z, w) of any norm."""
    largest = np.abs(rotation.real).max(axis=1, keepdims=True, initial=0)
    valid = largest >= QUATERNION_FLOOR
    q = np.where(valid, rotation / np.where(valid, largest, 1), np.array([0, 0, 0, 1.0]))
    x, y, z, w = (q / np.sqrt(np.sum(q**2, axis=1, keepdims=True))).T
    return (
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)], axis=1),
        np.stack([2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)], axis=1),
        np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=1),
    )


def _culled(raw: dict[str, Array], camera: PinholeCamera, rules: Rules) -> Array:
    centre, axes = camera_frame(raw, camera)
    facing = np.abs(np.sum(centre * axes[:, 2], axis=1))
    culled = ~(centre[:, 2] > camera.near) | ~(facing > rules.edge_on * np.linalg.norm(centre, axis=1))
    return culled | (_sigmoid(raw["opacity"][:, 0]) < rules.alpha_min)


def _footprint(columns: Array, camera: PinholeCamera, rules: Rules, x: Array, y: Array) -> _Sample:
    raw = dict(zip(GEOMETRY, np.split(columns, [3, 7, 9], axis=1), strict=True))
    p, axes = camera_frame(raw, camera)
    σ = np.exp(raw["scale"])
    ray = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)])
    with np.errstate(all="ignore"):
        t = np.sum(p * axes[:, 2], axis=1)[:, None] / (axes[:, 2] @ ray)
        # Only the difference to the ray through the surfel's own centre meets the axes: nothing cancels.
        beside = ray[None] - (p / p[:, 2:])[:, :, None]
        plane = np.zeros_like(t)
        lift = np.einsum("nk,nkp->np", axes[:, 2], beside) / np.sum(p * axes[:, 2], 1)[:, None]
        for i in range(2):
            along = np.einsum("nk,nkp->np", axes[:, i], beside)
            pa = np.sum(p * axes[:, i], 1)[:, None]
            plane = plane + (t * (along - lift * pa) / σ[:, i : i + 1]) ** 2
        middle = [f * p[:, i : i + 1] / p[:, 2:] + m for i, (f, m) in enumerate(_intrinsics(camera))]
        screen = (x - middle[0]) ** 2 + (y - middle[1]) ** 2
        screen = screen * rules.low_pass if rules.low_pass else np.full_like(screen, np.inf)
        low_pass = ~(t.real > 0) | ~(screen.real >= plane.real)
        opacity = _sigmoid(raw["opacity"])
        unclamped = opacity * np.exp(-0.5 * np.where(low_pass, screen, plane))
    alpha = np.where(unclamped.real > rules.alpha_max, rules.alpha_max, unclamped)
    z = np.where(low_pass, p[:, 2:], t)
    return _Sample(alpha, z, unclamped.real, screen.real, plane.real)


def _intrinsics(camera: PinholeCamera) -> tuple[tuple[float, float], tuple[float, float]]:
    return (camera.fx, camera.cx), (camera.fy, camera.cy)


def sample_depth(scene: Scene) -> Array:
    """Depth (N, P) of the sample of each surfel at each pixel: by it, every pixel sorts for itself."""
    x, y = scene.pixels % scene.camera.width + 0.5, scene.pixels // scene.camera.width + 0.5
    columns = np.concatenate([np.asarray(scene.raw[name], np.float64) for name in GEOMETRY], axis=1)
    return _footprint(columns, scene.camera, scene.rules, x, y).z


def sort_key(raw: dict[str, Array], camera: PinholeCamera, pixels: Array, corner: tuple[int, int]) -> Array:
    """Depth (N, P) by which surfels are ordered in the tiles of pixels; `corner`: the first pixel's place in
    its tile. As `reference.splat` has it: the plane's depth, SORT_REACH σ from the centre at most."""
    p, axes = camera_frame(raw, camera)
    σ = np.exp(raw["scale"])
    width, height = c.tile_size(abs(camera.fx))
    x = (pixels % camera.width + corner[0]) // width * width + width / 2 - corner[0]
    y = (pixels // camera.width + corner[1]) // height * height + height / 2 - corner[1]
    ray = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)])
    with np.errstate(all="ignore"):
        k = 1 / p[:, 2:]
        beside = ray[None] - (p * k)[:, :, None]
        pn = np.sum(p * axes[:, 2], 1)[:, None]
        lift = np.einsum("nk,nkp->np", axes[:, 2], beside) / pn
        across = [
            (np.einsum("nk,nkp->np", axes[:, i], beside) - lift * np.sum(p * axes[:, i], 1)[:, None])
            / σ[:, i : i + 1]
            for i in range(2)
        ]
        share = np.minimum(1, c.SORT_REACH * k / np.hypot(*across))
        return 1 / np.maximum(k + share * lift, k / c.SORT_DEPTH_RANGE)


# ---------------- attributes of surfels ----------------


class _Features:
    """Features (N, K) of raw columns (N, D): normal, materials, SH colours; or normal and radiance."""

    def __init__(self, scene: Scene, raw: dict[str, Array]) -> None:
        self.scene = scene
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
        direction = _unit(raw["position"] - scene.camera.to_world[:3, 3])
        normal = rotation_axes(raw["rotation"])[2]
        away = np.sum(normal * direction, 1, keepdims=True).real > c.FACING_TOLERANCE
        normal = np.where(away, -normal, normal)
        materials = [_sigmoid(raw[n]) for n in ("albedo", "metallic", "roughness") if n in raw]
        colour = _positive(_harmonics(raw["radiance_sh"], direction) + 0.5)
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
            parts.append(_positive(_harmonics(raw["indirect_sh"], 2 * n_v * normal + direction)))
        return np.concatenate(parts, axis=1)


class _Resolve:
    """Maps (P, …) of blended sums (P, K + 2): features, depth, alpha."""

    def __init__(self, scene: Scene, features: _Features, x: Array, y: Array, sums: Array) -> None:
        self.scene, self.features = scene, features
        camera = scene.camera
        ray = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=1)
        self.ray = _unit(ray @ camera.to_world[:3, :3].T)
        self.visibility = None
        if scene.visibility is not None:
            self.visibility = scene.visibility(_unit(sums[:, :3]), self.ray)

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


# ---------------- shading ----------------


def shade(
    light: Light,
    normal: Array,
    view: Array,
    materials: Array,
    own: Array | None,
    visibility: Array | None,
    indirect: Array | None,
    diffuse: str,
    taps: list[tuple[Array, Array, Array]],
) -> Array:
    """Radiance (n, 3) of points; `materials` (n, 5) are albedo, metallic, roughness. As `shade.models`."""
    n, v = _unit(normal), _unit(view)
    albedo, metallic, roughness = materials[:, :3], materials[:, 3:4], materials[:, 4]
    n_v = np.sum(n * v, 1)
    f0 = DIELECTRIC_F0 * (1 - metallic) + albedo * metallic
    a, b = _table(light.table, n_v, roughness)
    reflectance = f0 * a[:, None] + b[:, None]
    free = np.ones(len(n)) if visibility is None else visibility
    factor = reflectance * free[:, None]
    texel, share = _specular(light, 2 * n_v[:, None] * n - v, roughness)
    flat = light.flat()
    taps.append((texel, share, factor))
    out = factor * np.einsum("nk,nkc->nc", share, flat[texel])
    if diffuse == "sh":
        assert own is not None
        out = out + (1 - metallic) * own
    else:
        texel, share = _bilinear(light, n, np.full(len(n), len(light.levels) - 1))
        factor = _positive(1 - reflectance) * (1 - metallic) * albedo
        taps.append((texel, share, factor))
        out = out + factor * np.einsum("nk,nkc->nc", share, flat[texel])
    if visibility is not None and indirect is not None:
        out = out + (1 - free)[:, None] * indirect * reflectance
    return out


def _table(table: Array, n_v: Array, roughness: Array) -> tuple[Array, Array]:
    n = len(table)
    x, y = _clip(n_v, 0, 1) * n - 0.5, _clip(roughness, 0, 1) * n - 0.5
    j, i = (np.clip(np.floor(q.real), 0, n - 2).astype(int) for q in (x, y))
    s, t = (x - j)[:, None], (y - i)[:, None]
    upper = (1 - s) * table[i, j] + s * table[i, j + 1]
    lower = (1 - s) * table[i + 1, j] + s * table[i + 1, j + 1]
    pair = (1 - t) * upper + t * lower
    return pair[:, 0], pair[:, 1]


def _specular(light: Light, direction: Array, roughness: Array) -> tuple[Array, Array]:
    first, r = light.roughness[0], roughness
    sharp = r.real <= first
    level = np.where(sharp, (np.where(sharp, r, first) / first) ** 4, 1.0)
    inverse = 1 / np.where(sharp, first, r)
    for a, b in zip(light.roughness, light.roughness[1:], strict=False):
        level = level + _clip((inverse - 1 / a) / (1 / b - 1 / a), 0, 1)
    lower = np.clip(level.real.astype(int), 0, len(light.levels) - 2)
    t = (level - lower)[:, None]
    one, two = (_bilinear(light, direction, lower + k) for k in range(2))
    return np.concatenate([one[0], two[0]], 1), np.concatenate([(1 - t) * one[1], t * two[1]], 1)


def _bilinear(light: Light, direction: Array, level: Array) -> tuple[Array, Array]:
    """Texels (n, 4) of the flat levels and their weights."""
    heights = np.array([len(x) for x in light.levels])
    firsts = np.concatenate([[0], np.cumsum(2 * heights**2)[:-1]])
    h = heights[level]
    w, first = 2 * h, firsts[level]
    x, y, z = direction.T
    pole = (x.real == 0) & (z.real == 0)
    sin = np.where(pole, 0, np.sqrt(np.where(pole, 1, x * x + z * z)))
    turn = _atan2(np.where(pole, 0, x), np.where(pole, -1, -z)) / (2 * math.pi)
    u = np.where(turn.real < 0, turn + 1, turn) * w - 0.5
    v = _atan2(sin, y) / math.pi * (h - 1)
    j = np.floor(u.real).astype(int)
    i = np.clip(np.floor(v.real).astype(int), 0, h - 2)
    s, t = u - j, v - i
    texel = [first + (i + a) * w + (j + b) % w for a in (0, 1) for b in (0, 1)]
    share = [(t if a else 1 - t) * (s if b else 1 - s) for a in (0, 1) for b in (0, 1)]
    return np.stack(texel, 1), np.stack(share, 1)


def _harmonics(coefficients: Array, direction: Array) -> Array:
    """Σ c_k Y_k (n, 3) of coefficients (n, 3 (degree + 1)²); Legendre functions by recursion over z."""
    degree = math.isqrt(coefficients.shape[1] // 3) - 1
    x, y, z = direction.T
    cos, sin = [np.ones_like(x)], [np.zeros_like(x)]  # r^m cos mφ, r^m sin mφ
    for _ in range(degree):
        cos, sin = [*cos, x * cos[-1] - y * sin[-1]], [*sin, x * sin[-1] + y * cos[-1]]
    p = {(0, 0): np.ones_like(z)}  # over r^m
    for m in range(1, degree + 1):
        p[m, m] = -(2 * m - 1) * p[m - 1, m - 1]
    for m in range(degree):
        p[m + 1, m] = (2 * m + 1) * z * p[m, m]
        for n in range(m + 2, degree + 1):
            p[n, m] = ((2 * n - 1) * z * p[n - 1, m] - (n + m - 1) * p[n - 2, m]) / (n - m)
    out = np.zeros((len(x), 3), coefficients.dtype)
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            k = abs(m)
            norm = math.sqrt((2 * n + 1) / (4 * math.pi) * math.factorial(n - k) / math.factorial(n + k))
            turn = 1 if m == 0 else math.sqrt(2) * (cos[k] if m > 0 else sin[k])
            i = 3 * (n * (n + 1) + m)
            out = out + (norm * p[n, k] * turn)[:, None] * coefficients[:, i : i + 3]
    return out


# ---------------- functions of complex steps ----------------


def _sigmoid(x: Array) -> Array:
    return 1 / (1 + np.exp(-x))


def _positive(x: Array) -> Array:
    """max(0, x) with slope 1 at 0."""
    return np.where(x.real < 0, 0, x)


def _clip(x: Array, low: float, high: float) -> Array:
    return np.where(x.real < low, low, np.where(x.real > high, high, x))


def _atan2(y: Array, x: Array) -> Array:
    value = np.arctan2(y.real, x.real)
    if not (np.iscomplexobj(y) or np.iscomplexobj(x)):
        return value
    squared = x.real**2 + y.real**2
    slope = (x.real * np.imag(y) - y.real * np.imag(x)) / np.where(squared > 0, squared, 1)
    return value + 1j * slope


def _unit(v: Array) -> Array:
    """v / |v| by rows; (0, 0, 1) where |v|² is below NORM_FLOOR."""
    largest = np.abs(v.real).max(axis=1, keepdims=True)
    valid = largest > math.sqrt(c.NORM_FLOOR)
    v = np.where(valid, v / np.where(valid, largest, 1), np.array([0, 0, 1.0]))
    return v / np.sqrt(np.sum(v * v, axis=1, keepdims=True))
