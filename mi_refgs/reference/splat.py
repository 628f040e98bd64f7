"""Composite footprints front to back, all primitives at all pixels at once, and differentiate the result.

Derivatives of footprints are complex steps, exact to the last digit: the imaginary part of f(x + ih) is
h f'(x). Derivatives of compositing follow from its sums. Letters: N primitives, P pixels, K features.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_refgs.reference.camera import Array, PinholeCamera
from mi_refgs.reference.footprint import GEOMETRY, Corner, Gaussian, Raw, Rules, Sample, Surfel

STEP = 1e-40


def primitive_of(raw: Raw) -> Any:
    return Gaussian if raw["scale"].shape[1] == 3 else Surfel


@dataclass(frozen=True)
class Maps:
    """Blended maps of shape (H, W, …) and the pixels where a declared discontinuity is near."""

    features: Array
    depth: Array
    alpha: Array
    band: Array


class Blend:
    """Footprints (N, P) of all tables of raw channels at pixel centres x, y, blended front to back."""

    def __init__(
        self, tables: Sequence[Raw], camera: PinholeCamera, order: Array, x: Array, y: Array, rules: Rules
    ) -> None:
        """`order` (N, P): rows from front to back at each pixel."""
        self.tables, self.camera, self.rules, self.order, self.x, self.y = tables, camera, rules, order, x, y
        self.culled = np.concatenate([primitive_of(raw).culled(raw, camera, rules) for raw in tables])
        samples = [primitive_of(raw).footprint(raw, camera, rules, x, y) for raw in tables]
        fields = ([getattr(sample, field.name) for sample in samples] for field in dataclasses.fields(Sample))
        self.sample = Sample(*(np.concatenate(parts) for parts in fields))
        alpha, z = self.sample.alpha.real, self.sample.z.real
        hit = (alpha >= rules.alpha_min) & (z > camera.near) & ~self.culled[:, None]
        self.alpha, self.z = np.where(hit, alpha, 0), np.where(hit, z, 0)
        self.u, self.v = (np.where(hit, place.real, 0) for place in (self.sample.u, self.sample.v))
        behind = np.take_along_axis(np.log1p(-self.alpha), order, 0).cumsum(0)
        before = np.exp(np.concatenate([np.zeros((1, len(x))), behind[:-1]]))
        ends = math.log(rules.transmittance_min) if rules.transmittance_min else -math.inf
        alive = np.logical_and.accumulate(behind >= ends, axis=0)
        # Transmittance in front and behind, and whether the pixel has not ended before.
        self.before, self.after, self.alive = (_unsort(v, order) for v in (before, np.exp(behind), alive))
        self.shown = hit & self.alive  # contributes
        self.weight = np.where(self.shown, self.before * self.alpha, 0)

    def band(self, width: float) -> Array:
        """Pixels (P,) with a declared discontinuity within this relative distance."""
        rules, z = self.rules, self.sample.z.real
        near = self.alive & ~self.culled[:, None] & np.isfinite(z)
        found = np.any(self.shown & (self.sample.jump < width), 0)
        for values, limit, where in (
            (self.sample.unclamped, rules.alpha_min, near),
            (self.sample.unclamped, rules.alpha_max, self.shown),
            (self.after, rules.transmittance_min, self.alpha > 0),
            (z, self.camera.near, near),
        ):
            found |= np.any(where & (np.abs(values - limit) < width * limit), 0)
        return found

    def sums(self, features: Array, turns: Array) -> Array:
        """Blended features (P, K) of the first rows (N, K); the first T gain `turns` (N, 2 T) per standard
        deviation along u, then along v."""
        count, turned = len(features), turns.shape[1] // 2
        sums = self.weight[:count].T @ features
        for place, turn in zip((self.u, self.v), np.split(turns, 2, axis=1), strict=True):
            sums[:, :turned] += (self.weight * place)[:count].T @ turn
        return sums

    def adjoint(self, features: Array, turns: Array, δsums: Array) -> tuple[dict[str, Array], Array]:
        """Derivatives of Σ δsums · sums by raw channels of the one table, and by features (N, K) and turns;
        sums (P, K + 2): of features, depth, alpha."""
        (raw,) = self.tables
        δturned = δsums[:, : turns.shape[1] // 2]
        by_u, by_v = (turn @ δturned.T for turn in np.split(turns, 2, axis=1))
        value = features @ δsums[:, :-2].T + self.z * δsums[:, -2] + δsums[:, -1]
        value += self.u * by_u + self.v * by_v
        part = np.take_along_axis(self.weight * value, self.order, 0)
        behind = _unsort(np.cumsum(part[::-1], axis=0)[::-1] - part, self.order)
        δalpha = np.where(self.shown, self.before * value - behind / (1 - self.alpha), 0)
        δz = np.where(self.shown, self.weight * δsums[:, -2], 0)
        primitive, gradients = primitive_of(raw), {name: np.zeros_like(raw[name]) for name in GEOMETRY}
        for name in GEOMETRY:
            for d in range(raw[name].shape[1]):
                moved = raw | {name: raw[name].astype(complex)}
                moved[name][:, d] += 1j * STEP
                there = primitive.footprint(moved, self.camera, self.rules, self.x, self.y)
                slope_alpha, slope_z = there.alpha.imag / STEP, there.z.imag / STEP
                slope_turn = by_u * there.u.imag / STEP + by_v * there.v.imag / STEP
                slope = δalpha * slope_alpha + δz * slope_z + self.weight * slope_turn
                gradients[name][:, d] = np.sum(np.where(self.shown, slope, 0), 1)
        by_turn = [self.weight * place @ δturned for place in (self.u, self.v)]
        return gradients, np.concatenate([self.weight @ δsums[:, :-2], *by_turn], axis=1)


def splat(
    raw: Raw, features: Array, camera: PinholeCamera, band: float = 1e-3, turns: Array | None = None
) -> Maps:
    """Render raw channels, features (N, K); `band`: relative width of `near`; `turns` as in `Blend.sums`."""
    turns = features[:, :0] if turns is None else turns
    blend, shape = _whole_image(raw, camera), (camera.height, camera.width)
    maps = np.sum(blend.weight * blend.z, 0), blend.weight.sum(0), blend.band(band)
    depth, alpha, near = (plane.reshape(shape) for plane in maps)
    return Maps(blend.sums(features, turns).reshape(*shape, -1), depth, alpha, near)


def differentiate(
    raw: Raw, features: Array, camera: PinholeCamera, weights: Array, turns: Array | None = None
) -> dict[str, Array]:
    """Gradients of Σ weights (K + 2, P) · maps: as raw channels, and "features", turns last (N, K + 2 T)."""
    turns = features[:, :0] if turns is None else turns
    gradients, δfeatures = _whole_image(raw, camera).adjoint(features, turns, weights.T)
    return gradients | {"features": δfeatures}


def sorted_rows(tables: Sequence[Raw], camera: PinholeCamera, pixel: Array, corner: Corner = (0, 0)) -> Array:
    """Rows (N, P) of all tables from front to back at pixels (raster indices); `corner` as in `sort_key`."""
    camera = dataclasses.replace(camera, fine=any("curvature" in raw for raw in tables))
    keys = [primitive_of(raw).sort_key(raw, camera, pixel, corner) for raw in tables]
    return np.argsort(np.concatenate(keys), axis=0, kind="stable")


def _whole_image(raw: Raw, camera: PinholeCamera) -> Blend:
    pixels = np.arange(camera.width * camera.height)
    x, y = pixels % camera.width + 0.5, pixels // camera.width + 0.5
    return Blend([raw], camera, sorted_rows([raw], camera, pixels), x, y, Rules())


def _unsort(values: Array, order: Array) -> Array:
    out = np.empty_like(values)
    np.put_along_axis(out, order, values, axis=0)
    return out
