"""The formulas as textbooks and first programs have them, in NumPy float32.

Homogeneous splat matrix with the cross product of two transformed planes in pixel coordinates, centres and
near plane in absolute units, sort by the centre's depth, α without a guard, floors of 1e-7, softplus and
sigmoid as written. [2DGS, Huang et al. 2024, eq. 8-10; 3DGS, Kerbl et al. 2023]
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.stability.cases import Array, Case
from benchmarks.stability.exact import light_of
from mi_refgs import constants as c
from mi_refgs.reference import image as oracle
from mi_refgs.reference import models
from mi_refgs.reference.camera import rotation_axes

NEAR = 0.2
"""Scene units; what lies nearer is dropped."""
FLOOR = np.float32(1e-7)


def image_error(case: Case, scene: oracle.Scene, band: Array) -> float:
    """Largest error of radiance and alpha, relative to the largest value, against float64 in the same order
    of centres; infinite where a value is not finite."""
    if not len(scene.raw["position"]):
        return 0.0
    depth = _centre_depth(case)
    order = np.broadcast_to(np.argsort(depth, kind="stable")[:, None], scene.order.shape)
    truth = oracle.render(replace(scene, order=order, rules=oracle.Rules(edge_on=0.0)))
    with np.errstate(all="ignore"):
        found = _render(case, scene, order[:, 0])
    worst = 0.0
    keep = ~(band | truth.band)
    for name, values in found.items():
        if not np.isfinite(values).all():
            return float("inf")
        exact = truth.maps[name]
        peak = float(np.abs(exact).max()) or 1.0
        worst = max(worst, float(np.abs(values - exact)[keep].max(initial=0)) / peak)
    return worst


def _centre_depth(case: Case) -> Array:
    view = case.camera.to_world.astype(np.float32)
    return (case.raw["position"] - view[:3, 3]) @ view[:3, 2]


def _render(case: Case, scene: oracle.Scene, order: Array) -> dict[str, Array]:
    f = np.float32
    raw = case.raw
    view = np.linalg.inv(case.camera.to_world).astype(f)  # one 4 × 4 matrix for points, as programs have it
    p = case.camera
    projection = np.array([[p.fx, 0, p.cx], [0, p.fy, p.cy], [0, 0, 1]], f)
    x = (scene.pixels % p.width).astype(f) + f(0.5)
    y = (scene.pixels // p.width).astype(f) + f(0.5)
    q = raw["rotation"] / np.maximum(np.linalg.norm(raw["rotation"], axis=1, keepdims=True), FLOOR)
    axes = [a.astype(f) for a in rotation_axes(q)]
    σ = np.exp(raw["scale"])
    opacity = 1 / (1 + np.exp(-raw["opacity"][:, 0]))
    features = _features(case, axes[2])
    total = np.zeros((len(x), features.shape[1]), f)
    alpha_sum, transmittance = np.zeros(len(x), f), np.ones(len(x), f)
    alive = np.ones(len(x), bool)
    for i in order:
        centre = view[:3, :3] @ raw["position"][i] + view[:3, 3]
        if centre[2] <= NEAR:
            continue
        columns = [view[:3, :3] @ (axes[k][i] * σ[i, k]) for k in range(2)]
        matrix = projection @ np.stack([*columns, centre], axis=1)  # uv1 to pixels, homogeneous
        k = x[:, None] * matrix[2] - matrix[0]
        m = y[:, None] * matrix[2] - matrix[1]
        cross = np.cross(k, m)
        u, v = cross[:, 0] / cross[:, 2], cross[:, 1] / cross[:, 2]
        middle = matrix[:2, 2] / matrix[2, 2]
        plane = u * u + v * v
        screen = f(c.LOW_PASS_INV_VARIANCE) * ((x - middle[0]) ** 2 + (y - middle[1]) ** 2)
        low = ~(screen >= plane)
        z = np.where(low, matrix[2, 2], u * matrix[2, 0] + v * matrix[2, 1] + matrix[2, 2])
        a = np.minimum(f(0.99), opacity[i] * np.exp(f(-0.5) * np.where(low, screen, plane)))
        hit = alive & ~(a < f(1 / 255)) & ~(z < NEAR)
        after = transmittance * (1 - a)
        ends = hit & (after < f(1e-4))
        alive &= ~ends
        hit &= ~ends
        weight = np.where(hit, transmittance * a, 0)
        total += weight[:, None] * features[i]
        alpha_sum += weight
        transmittance = np.where(hit, after, transmittance)
        if not alive.any():
            break
    return {"radiance": _radiance(case, scene, total, alpha_sum, x, y), "alpha": alpha_sum[:, None]}


def _features(case: Case, normal: Array) -> Array:
    """Normal, albedo, metallic, roughness, colour, indirect colour; or normal and radiance."""
    f, raw = np.float32, case.raw
    direction = raw["position"] - case.camera.to_world[:3, 3].astype(f)
    direction = direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), FLOOR)
    away = np.sum(normal * direction, 1, keepdims=True) > c.FACING_TOLERANCE
    normal = np.where(away, -normal, normal)
    colour = np.maximum(models.harmonics(raw["radiance_sh"], direction) + f(0.5), 0).astype(f)
    materials = [1 / (1 + np.exp(-raw[n])) for n in ("albedo", "metallic", "roughness") if n in raw]
    if case.at == "surfel":
        if case.reflectance == "split_sum":
            m = np.concatenate(materials, 1)
            colour = _shade(case, normal, -direction, m, colour, None, None)
        return np.concatenate([normal, colour], axis=1)
    parts = [normal, *materials, colour]
    if case.surface is not None:
        n_v = -np.sum(normal * direction, 1, keepdims=True)
        parts.append(np.maximum(models.harmonics(raw["indirect_sh"], 2 * n_v * normal + direction), 0))
    return np.concatenate(parts, axis=1).astype(f)


def _radiance(case: Case, scene: oracle.Scene, total: Array, alpha: Array, x: Array, y: Array) -> Array:
    f, p = np.float32, case.camera
    if case.at == "surfel":
        return total[:, 3:6]
    maps = total / (alpha[:, None] + FLOOR)
    ray = np.stack([(x - f(p.cx)) / f(p.fx), (y - f(p.cy)) / f(p.fy), np.ones_like(x)], 1)
    ray = (ray @ p.to_world[:3, :3].T.astype(f)).astype(f)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    normal = total[:, :3] / (np.linalg.norm(total[:, :3], axis=1, keepdims=True) + FLOOR)
    visibility = None if scene.visibility is None else scene.visibility(normal, ray).astype(f)
    indirect = maps[:, 11:14] if scene.visibility is not None else None
    return _shade(case, normal, -ray, maps[:, 3:8], maps[:, 8:11], visibility, indirect) * alpha[:, None]


def _shade(
    case: Case,
    normal: Array,
    view: Array,
    materials: Array,
    own: Array,
    visibility: Array | None,
    indirect: Array | None,
) -> Array:
    """The split sum with the light's exact levels; what is looked up is float32."""
    f = np.float32
    radiance = np.log(1 + np.exp(case.light))  # softplus as written
    if not np.isfinite(radiance).all():
        return np.full((len(normal), 3), np.nan, f)
    exact = light_of(np.asarray(case.light, np.float64))
    light = oracle.Light([x.astype(f) for x in exact.levels], exact.roughness, exact.table.astype(f))
    n_v = np.clip(np.sum(normal * view, 1, keepdims=True), 0, 1)
    albedo, metallic, roughness = materials[:, :3], materials[:, 3:4], materials[:, 4]
    f0 = f(0.04) * (1 - metallic) + albedo * metallic
    a, b = models.table_lookup(light.table, n_v[:, 0], roughness).T
    reflectance = (f0 * a[:, None] + b[:, None]).astype(f)
    mirror = 2 * np.sum(normal * view, 1, keepdims=True) * normal - view
    texel, share = models.specular(light, mirror.astype(f), roughness.astype(f))
    out = reflectance * np.einsum("nk,nkc->nc", share.astype(f), light.flat()[texel])
    if visibility is not None:
        out = out * visibility[:, None]
    if case.diffuse == "sh":
        out = out + (1 - metallic) * own
    else:
        last = np.full(len(normal), len(light.levels) - 1)
        texel, share = models.bilinear(light, normal, last)
        base = np.maximum(1 - reflectance, 0) * (1 - metallic) * albedo
        out = out + base * np.einsum("nk,nkc->nc", share.astype(f), light.flat()[texel])
    if visibility is not None and indirect is not None:
        out = out + (1 - visibility[:, None]) * indirect * reflectance
    return out.astype(f)
