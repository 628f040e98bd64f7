"""The float64 reference of a case: its light, its scene, and the product's order of surfels."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

from benchmarks.stability.cases import Array, Case
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.reference import image as oracle
from mi_refgs.reference import occlusion as trace
from mi_refgs.shade import brdf
from mi_refgs.shade.light import lobe_matrices
from mi_refgs.splat import Camera, list_by_tile, project
from mi_refgs.surfels.table import Surfels


def fast_camera(case: Case) -> Camera:
    """The product's camera, with its own near plane unless the case sets one."""
    c = case.camera
    near = {} if case.near is None else {"near": case.near}
    found = Camera.from_pose(c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.to_world, **near)
    return replace(found, offset=case.offset)


@functools.lru_cache(maxsize=8)
def _operator(height: int) -> list[Array]:
    """Dense prefilter matrices (h_out · 2h_out, h · 2h) of the product's levels, float64."""
    matrices = []
    φ = lobe_matrices.column_angles(2 * height)
    for level in lobe_matrices.build_levels(height):
        m = np.arange(level.weights.shape[2])
        across = np.cos(m[:, None, None] * (lobe_matrices.column_angles(2 * level.height)[:, None] - φ))
        dense = np.einsum("ikm,mab->iakb", level.weights, across, optimize=True)
        matrices.append(dense.reshape(2 * level.height**2, 2 * height**2))
    return matrices


def light_of(raw: Array) -> oracle.Light:
    """The float64 reference's light."""
    radiance = np.logaddexp(0, np.asarray(raw, np.float64))  # softplus
    flat = radiance.reshape(-1, 3)
    levels = [(m @ flat) for m in _operator(len(raw))]
    shaped = [x.reshape(h := int(np.sqrt(len(x) / 2)), 2 * h, 3) for x in levels]
    return oracle.Light([radiance, *shaped], lobe_matrices.LEVEL_ROUGHNESS, brdf.table().astype(np.float64))


def light_gradient(raw: Array, light: oracle.Light, δflat: Array) -> Array:
    """δraw of δ of the flat levels."""
    first, *rest = light.split(δflat)
    δradiance = first.reshape(-1, 3)
    for matrix, δ in zip(_operator(len(raw)), rest, strict=True):
        δradiance = δradiance + matrix.T @ δ.reshape(-1, 3)
    return δradiance.reshape(raw.shape) / (1 + np.exp(-np.asarray(raw, np.float64)))


def product_order(case: Case, pixels: Array) -> Array:
    """The product's order (N, P) of surfels at pixels; those that the tile does not list come last."""
    count = len(case.raw["position"])
    camera = fast_camera(case)
    surfels = Surfels({name: upload_tensor(x) for name, x in case.raw.items()})
    lists = list_by_tile(project(surfels, camera), camera)
    listed, begin, end = (
        np.array(x).astype(int) for x in (lists.surfel_from_pair, lists.pair_begin, lists.pair_end)
    )
    (width, height), (left, top) = camera.tile, camera.tile_offset
    x, y = (pixels % camera.width + left) // width, (pixels // camera.width + top) // height
    order = np.empty((count, len(pixels)), int)
    for tile in np.unique(y * camera.tiles[0] + x):
        first = listed[begin[tile] : end[tile]]
        rest = np.ones(count, bool)
        rest[first] = False
        order[:, y * camera.tiles[0] + x == tile] = np.concatenate([first, np.nonzero(rest)[0]])[:, None]
    return order


def scene_of(case: Case, pixels: Array, order: Array, light: oracle.Light | None = None) -> oracle.Scene:
    """The float64 reference's scene of a case."""
    visibility = None
    if case.surface is not None:
        visibility = functools.partial(visibility_of, case)
    eye = replace(case.camera, near=0.0 if case.near is None else case.near)
    light = light if light is not None or case.reflectance == "radiance" else light_of(case.light)
    raw = {n: np.asarray(x, np.float64) for n, x in case.raw.items()}
    return oracle.Scene(raw, eye, pixels, order, case.at, case.reflectance, case.diffuse, light, visibility)


def visibility_of(case: Case, normal: Array, ray: Array, further: float = 0.0) -> Array:
    vertices, faces, offset = case.surface
    offset += further
    if not len(faces):
        return np.ones(len(normal))
    origin = np.broadcast_to(case.camera.to_world[:3, 3], ray.shape)
    t = trace.mesh_distance(vertices, faces, origin, ray)
    hit = np.isfinite(t)
    point = origin + np.where(hit, t, 0)[:, None] * ray + offset * normal
    mirror = ray - 2 * np.sum(normal * ray, 1, keepdims=True) * normal
    return np.where(hit & np.isfinite(trace.mesh_distance(vertices, faces, point, mirror)), 0.0, 1.0)
