"""The float64 reference of a case: its light, its scene, and the product's order of surfels."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

from benchmarks.stability.cases import Array, Case
from mi_refgs.occlusion.visibility import ALONG
from mi_refgs.reference import image as oracle
from mi_refgs.reference.light import Light, dense_filter, filtered
from mi_refgs.reference.occlusion import mirror_visibility
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
def filters(height: int) -> list[Array]:
    """Dense matrices (2 h_out², 2 height²) of the product's prefilter, float64."""
    return [dense_filter(weights) for weights in lobe_matrices.build_levels(height)]


def light_of(raw: Array) -> Light:
    """The float64 reference's light."""
    radiance = np.logaddexp(0, np.asarray(raw, np.float64))  # softplus
    levels = filtered(radiance, filters(len(raw)))
    return Light(levels, lobe_matrices.LEVEL_ROUGHNESS, brdf.table().astype(np.float64))


def light_gradient(raw: Array, light: Light, δflat: Array) -> Array:
    """δraw of δ of the flat levels."""
    first, *rest = light.split(δflat)
    δradiance = first.reshape(-1, 3)
    for matrix, δ in zip(filters(len(raw)), rest, strict=True):
        δradiance = δradiance + matrix.T @ δ.reshape(-1, 3)
    return δradiance.reshape(raw.shape) / (1 + np.exp(-np.asarray(raw, np.float64)))


def product_order(case: Case, pixels: Array, around: dict[str, Array] | None = None) -> Array:
    """The product's order (N, P) of surfels at pixels; those that the tile does not list come last.

    `around`: raw attributes of a background, which is numbered after the surfels of the case."""
    camera = fast_camera(case)
    tables = [Surfels.from_numpy(raw) for raw in (case.raw, around) if raw is not None]
    count = sum(table.count for table in tables)
    lists = list_by_tile(project(tables, camera), camera)
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


def scene_of(case: Case, pixels: Array, order: Array, light: Light | None = None) -> oracle.Scene:
    """The float64 reference's scene of a case."""
    visibility = None
    if case.surface is not None:
        visibility = functools.partial(visibility_of, case)
    eye = replace(case.camera, near=0.0 if case.near is None else case.near)
    light = light if light is not None or case.reflectance == "radiance" else light_of(case.light)
    raw = {n: np.asarray(x, np.float64) for n, x in case.raw.items()}
    return oracle.Scene(raw, eye, pixels, order, case.at, case.reflectance, case.diffuse, light, visibility)


def visibility_of(case: Case, normal: Array, ray: Array, further: float = 0.0) -> Array:
    """Visibility (P,) of the mirror direction, with `further` added to the offset of its rays."""
    vertices, faces, offset = case.surface
    eye = case.camera.to_world[:3, 3]
    return mirror_visibility(vertices, faces, eye, normal, ray, offset + further, ALONG)
