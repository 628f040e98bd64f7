"""Initial parameters: on and in the visual hull for images with alpha, otherwise at sparse or random points.

Positions are world positions in scene units; colours are linear radiance.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mi_refgs.data import hull
from mi_refgs.data.dataset import Dataset, PixelRays, PointCloud
from mi_refgs.data.object_region import in_free_space, seen_share
from mi_refgs.data.region import Region
from mi_refgs.data.stereo import FARTHEST
from mi_refgs.errors import InputError
from mi_refgs.methods.method import AROUND, BACKGROUND, LIGHT, LightOptions, Method
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.lobe_matrices import map_directions
from mi_refgs.surfels import init
from mi_refgs.surfels.attributes import attribute
from mi_refgs.surfels.init import morton_order
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import TensorXf

FARTHEST_CONTRACTED = 2 - 1 / FARTHEST
"""Contracted distance of the farthest random points: beyond it the background map is as good."""
SEEN_SHARE = 0.1
"""Fraction of the views that must see a random point: fewer views cannot determine its position."""
DRAWS = 64  # rounds of rejection sampling; cameras on one side of a scene accept about a tenth per round


def open_points(
    count: int, random: float, inside: bool, data: Dataset, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points (count, 3) of the object, or of the background unless `inside`, and their colours.

    A fraction `random` is uniform in the region, or anywhere outside it: along pixels of unknown depth, or
    without those in contracted space where views see it. The others are at the known points there; all are
    random if there are none.
    """
    region = data.region
    assert region is not None
    sparse = data.points
    if sparse is not None:
        rows = region.contains(sparse.position) == inside
        colour = None if sparse.colour is None else sparse.colour[rows]
        sparse = PointCloud(sparse.position[rows], colour) if rows.any() else None
    drawn = count if sparse is None else round(random * count)
    if inside or data.unknown is None:
        points = _within(drawn, region, rng) if inside else _around(drawn, region, data, rng)
        colours = hull.median_colours(points, data.views, data.background)
    else:
        points, colours = _along(data.unknown, drawn, region, rng)
    if sparse is None or drawn == count:
        return points, colours
    near, known = at_points(sparse, count - drawn, data, rng)
    return np.concatenate([near, points]), np.concatenate([known, colours])


def at_points(
    cloud: PointCloud, count: int, data: Dataset, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points (count, 3) at those of a cloud, with their colours or those of the images.

    Copies of a point lie around it, as far away as its neighbours, whose distance is a surfel's size.
    """
    known = cloud.position
    row = rng.permutation(np.arange(count) % len(known))
    spread = init.neighbour_scale(known)[row] * (len(known) < count)
    points = known[row] + spread[:, None] * rng.normal(size=(count, 3))
    if cloud.colour is not None:
        return points, cloud.colour[row]
    return points, hull.median_colours(points, data.views, data.background)


def _within(count: int, region: Region, rng: np.random.Generator) -> np.ndarray:
    """Points (count, 3) uniform in the region; raises InputError if planes leave hardly any of its sphere."""
    found = np.empty((0, 3))
    for _ in range(DRAWS):
        number = (4 if region.planes else 1) * (count - len(found))
        offset = init.random_normals(number, rng) * np.cbrt(rng.random((number, 1))) * region.radius
        points = np.array(region.centre) + offset
        found = np.concatenate([found, points[region.above(points)]])[:count]
        if len(found) == count:
            return found
    raise InputError("region: planes: they leave hardly anything of the sphere; correct or remove them")


def _around(count: int, region: Region, data: Dataset, rng: np.random.Generator) -> np.ndarray:
    """Points (count, 3) uniform in contracted space outside of the region, where enough views see them,
    but not right in front of a camera; anywhere there if too few are seen."""
    nearest = 0.0 if region.planes else 1.0  # the sphere has points below planes

    def draw(number: int) -> np.ndarray:
        length = np.cbrt(rng.uniform(nearest, FARTHEST_CONTRACTED**3, (number, 1)))
        points = region.expand(init.random_normals(number, rng) * length)
        return points[~region.contains(points)] if region.planes else points

    found = np.empty((0, 3))
    for _ in range(DRAWS):
        if len(found) == count:
            break
        points = draw(4 * (count - len(found)))
        points = points[seen_share(data.views, points) >= SEEN_SHARE]
        points = points[~in_free_space(data.views, region, points)]
        found = np.concatenate([found, points])[:count]
    while len(found) < count:
        found = np.concatenate([found, draw(count - len(found))])
    return found


def _along(
    pixels: PixelRays, count: int, region: Region, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points (count, 3) outside of the region with the colours of pixels, of random depth, uniform in 1/z,
    beyond the region's centre.

    They are where points of surfaces are missing, such as walls that few views show, and nowhere near a
    camera. With median colours of all views instead, held-out views of the kitchen around *figure* lose 3 dB.
    """
    points, colours = np.empty((0, 3)), np.empty((0, 3))
    while len(points) < count:
        some = rng.integers(len(pixels.origin), size=2 * count)
        nearest = np.linalg.norm(pixels.origin[some] - np.array(region.centre), axis=1)
        z = 1 / rng.uniform(1 / (nearest + FARTHEST * region.radius), 1 / nearest)
        drawn = pixels.origin[some] + pixels.direction[some] * z[:, None]
        outside = ~region.contains(drawn)
        points = np.concatenate([points, drawn[outside]])[:count]
        colours = np.concatenate([colours, pixels.colour[some][outside]])[:count]
    return points, colours


ALBEDO_RANGE = (0.02, 0.9)  # range of an initial albedo from images: near 0 and 1 the sigmoid has no slope
FAR = 1e4  # distance, in scene extents, at which a direction is looked up in the images


def initial_parameters(
    method: Method, data: Dataset, rng: np.random.Generator, open_scene: bool
) -> dict[str, TensorXf]:
    """The parameters by name, with those of the background for an open scene; raises InputError."""
    params = initial_surfels(method, data, rng, open_scene).raw
    if open_scene:
        params |= initial_surroundings(method, data, rng)
    if method.light is None:
        return params
    light = seen_around(data, method.light.height) if open_scene else first_light(method.light)
    return params | {LIGHT: light.raw}


def with_columns(table: np.ndarray, width: int) -> np.ndarray:
    """The first `width` columns, filled with zeros."""
    kept = table[:, :width]
    return np.pad(kept, ((0, 0), (0, width - kept.shape[1])))


def converted(
    rows: dict[str, np.ndarray],  # (N, D) by attribute
    widths: dict[str, int],
    method: Method,
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Rows with attributes of these widths: cut or filled with zeros, and new ones as the method starts."""
    made = {
        name: with_columns(rows[name], width)
        if name in rows
        else attribute(name).start(len(rows["position"]), width, rng, method.surfels.start(name))
        for name, width in widths.items()
    }
    return {name: values.astype(np.float32) for name, values in made.items()}


def first_light(options: LightOptions) -> EnvironmentLight:
    """The initial environment: constant radiance."""
    return EnvironmentLight.constant(options.radiance, options.height)


def seen_around(data: Dataset, height: int) -> EnvironmentLight:
    """The background of the images as a map: colours at the distance of sparse points, else far away.

    The object reflects it, so it is a better initial light than constant radiance.
    """
    assert data.region is not None
    directions, centre = map_directions(height), np.array(data.region.centre)
    distance = FAR * data.scene_extent
    if data.points is not None:
        outside = data.points.position[~data.region.contains(data.points.position)]
        if len(outside):
            distance = float(np.median(np.linalg.norm(outside - centre, axis=1)))
    points = centre + distance * directions.reshape(-1, 3)
    seen = hull.median_colours(points, data.views, data.background)
    return EnvironmentLight.from_radiance(seen.reshape(directions.shape))


def initial_surroundings(method: Method, data: Dataset, rng: np.random.Generator) -> dict[str, TensorXf]:
    """The parameters of the background by name: surfels, and a map of the median of their colours."""
    options, region = method.surroundings, data.region
    assert options is not None and region is not None
    points, colours = open_points(options.count, options.scattered, False, data, rng)
    order = morton_order(points)
    points, distance = points[order], np.linalg.norm(points[order] - np.array(region.centre), axis=1)
    table = init.from_points(
        points,
        init.random_normals(len(points), rng),
        colours[order],
        rng=rng,
        primitive=options.primitive,
        attributes=["radiance_sh"],
        degree={"radiance_sh": options.degree},
        largest=options.size * distance,
        opacity=options.opacity,
    )
    # One colour: a map of the images would leave the surfels nothing to explain.
    shape = (options.height, 2 * options.height, 3)
    background = EnvironmentLight.from_radiance(np.broadcast_to(np.median(colours, axis=0), shape))
    return {AROUND + name: tensor for name, tensor in table.raw.items()} | {BACKGROUND: background.raw}


def initial_surfels(
    method: Method, data: Dataset, rng: np.random.Generator, open_scene: bool = False
) -> Surfels:
    """`method.surfels.count` surfels with the method's attributes.

    With alpha, a fraction `inside` of them is uniform in the visual hull's volume with random normals, and
    the others are uniform on its surface with its normals: concave surfaces lie inside the hull. Colours are
    the median over the views that see the point. Without alpha, they start at sparse and random points; in an
    `open_scene` inside the region, where `inside` is the fraction of random ones.

    Raises InputError if the masks have no point in common, and for a fraction beyond 0 … 1.
    """
    options = method.surfels
    if not 0 <= options.inside <= 1:
        raise InputError(f"method: surfels.inside: {options.inside} is no share; give a number from 0 to 1")
    views, behind = data.views, data.background
    start: dict[str, Any] = dict(options.initial)
    if data.has_alpha:
        shape = hull.visual_hull(views, hull.camera_bounds(views))
        inner = shape.inner_points(round(options.inside * options.count), rng)
        outer, facing = shape.surface_points(options.count - len(inner), rng)
        points = np.concatenate([outer, inner])
        normals = np.concatenate([facing, init.random_normals(len(inner), rng)])
        # Points inside face no view in particular: every view counts.
        colours = np.concatenate(
            [hull.median_colours(outer, views, behind, facing), hull.median_colours(inner, views, behind)]
        )
    else:
        if open_scene:
            assert method.surroundings is not None
            start["opacity"] = method.surroundings.opacity
            points, colours = open_points(options.count, options.inside, True, data, rng)
        elif data.points is not None and len(data.points.position):
            points, colours = at_points(data.points, options.count, data, rng)
        else:
            low, high = hull.camera_bounds(views)
            points = rng.uniform(low, high, (options.count, 3))
            colours = hull.median_colours(points, views, behind)
        normals = init.random_normals(options.count, rng)
    order = morton_order(points)
    if "albedo" in options.from_images and method.light is not None:
        # The hue only: brightness is left to the light until it has been estimated.
        brightest = colours[order].max(axis=1, keepdims=True)
        hue = np.where(brightest > 0, colours[order] / np.maximum(brightest, 1e-9), 1)
        start["albedo"] = np.clip(hue * options.start("albedo"), *ALBEDO_RANGE)
    return init.from_points(
        points[order],
        normals[order],
        colours[order],
        rng=rng,
        primitive=options.primitive,
        attributes=options.attributes,
        degree={name: options.degree_of(name) for name in options.attributes},
        **start,
    )
