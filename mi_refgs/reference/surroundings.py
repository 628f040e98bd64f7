"""The picture of an open scene in float64: an object, its surroundings and a background, pixel by pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mi_refgs import constants as c
from mi_refgs.reference.blend import Blend
from mi_refgs.reference.footprint import GEOMETRY
from mi_refgs.reference.lookup import harmonics, positive, unit
from mi_refgs.reference.picture import Features, Resolve, Scene
from mi_refgs.reference.pinhole import rotation_axes
from mi_refgs.reference.primitives import primitive_of

Array = np.ndarray


@dataclass(frozen=True)
class OpenScene:
    """`scene` is the object, its `order` (N + M, P) of all rows, those of the surroundings last."""

    scene: Scene
    around: dict[str, Array]  # raw channels of M rows: geometry and radiance_sh
    background: Array  # (h, 2h, 3) raw, radiance is log(1 + exp raw)


def render(open_scene: OpenScene) -> tuple[dict[str, Array], Array]:
    """Maps (P, …) of the object and of both, and pixels (P,) near a declared discontinuity."""
    scene, camera = open_scene.scene, open_scene.scene.camera
    own = {name: np.asarray(values, np.float64) for name, values in scene.raw.items()}
    other = {name: np.asarray(values, np.float64) for name, values in open_scene.around.items()}
    count = len(own["position"])
    x, y = scene.pixels % camera.width + 0.5, scene.pixels // camera.width + 0.5
    both = {name: np.concatenate([own[name], other[name]]) for name in GEOMETRY}
    blend = Blend.of(both, camera, scene.order, x, y, scene.rules)

    features = Features(scene, own)
    values = features(features.columns, []).real
    direction = unit(other["position"] - camera.to_world[:3, 3])
    colour = positive(harmonics(other["radiance_sh"], direction) + 0.5)
    alpha = blend.weight.sum(0)
    depth = np.sum(blend.weight * blend.z, 0)
    share = blend.weight[:count].sum(0)
    sums = np.concatenate([blend.weight[:count].T @ values, depth[:, None], share[:, None]], axis=1)
    resolve = Resolve(scene, features, x, y, sums)
    maps = resolve.named(resolve(sums, []).real)
    maps["object_alpha"], maps["object_normal"] = share[:, None], maps["normal"]
    maps["alpha"] = alpha[:, None]
    seen = alpha > c.COVERAGE_FLOOR
    maps["depth"] = np.where(seen, depth / np.where(seen, alpha, 1), 0)[:, None]
    maps["radiance"] = maps["radiance"] + blend.weight[count:].T @ colour
    if scene.at == "surfel":  # one slot for the normals of both
        maps["normal"] = maps["normal"] + blend.weight[count:].T @ _facing(other, direction)
    texels = np.log1p(np.exp(np.asarray(open_scene.background, np.float64)))
    maps["background"] = np.stack([lookup(texels, ray) for ray in resolve.ray])
    return maps, blend.band(1e-4)


def lookup(image: Array, ray: Array) -> Array:
    """Bilinear colour (3,) of a lat-long image (h, 2h, 3) in a unit direction (3,); poles are rows."""
    h, w = image.shape[:2]
    column = np.arctan2(ray[0], -ray[2]) / (2 * np.pi) % 1 * w - 0.5
    row = np.arccos(np.clip(ray[1], -1, 1)) / np.pi * (h - 1)
    left, above = int(np.floor(column)), min(int(row), h - 2)
    s, t = column - left, row - above
    total = np.zeros(3)
    for i, share_i in ((above, 1 - t), (above + 1, t)):
        for j, share_j in ((left, 1 - s), (left + 1, s)):
            total += share_i * share_j * image[i, j % w]
    return total


def _facing(raw: dict[str, Array], direction: Array) -> Array:
    """Normals (M, 3), turned towards the camera."""
    normal = np.choose(primitive_of(raw).normal(raw)[:, None], rotation_axes(raw["rotation"]))
    away = np.sum(normal * direction, axis=1, keepdims=True) > c.FACING_TOLERANCE
    return np.where(away, -normal, normal)
