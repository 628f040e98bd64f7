"""Initial parameters of a fit: surfels where an initialiser says, the background, and the light."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mi_refgs.data import hull
from mi_refgs.data.dataset import Dataset
from mi_refgs.errors import InputError
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods.extensions import INITIALISERS, Start, Wanted
from mi_refgs.methods.method import AROUND, BACKGROUND, LIGHT, TURNTABLE, Method
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.lobe_matrices import map_directions
from mi_refgs.shade.light.maps import Learnt
from mi_refgs.surfels import init
from mi_refgs.surfels.attributes import attribute
from mi_refgs.surfels.init import morton_order
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import TensorXf

BACKGROUND_START = ("points", "along_pixels", "random")  # initialisers of the background
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
    if open_scene and isinstance(method.light, Learnt):
        return params | {LIGHT: seen_around(data, method.light.rows).raw}
    placement = {f"{LIGHT}_{name}": upload_tensor(np.zeros((1, 3))) for name in method.light.placement}
    if method.light.turntable:
        placement[TURNTABLE] = upload_tensor(data.views[0].to_world[:3, :3])
    return params | {LIGHT: method.light.start()} | placement


def started(names: Sequence[str], wanted: Wanted) -> Start:
    """The start by the first initialiser of these that fits the data; raises InputError if none does."""
    for name in names:
        if (start := INITIALISERS.find(name, "surfels.start").start(wanted)) is not None:
            return start
    raise InputError("no initialiser fits the data", field="surfels.start", remedy="add 'random'")


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
        else attribute(name).start(len(rows["position"]), width, rng, method.surfels.first(name))
        for name, width in widths.items()
    }
    return {name: values.astype(np.float32) for name, values in made.items()}


def seen_around(data: Dataset, height: int) -> EnvironmentLight:
    """The background of the images as a map: colours at the distance of sparse points, else far away."""
    assert data.region is not None
    directions, centre = map_directions(height), np.array(data.region.centre)
    distance = FAR * data.scene_extent
    if data.points is not None:
        outside = data.points.position[~data.region.contains(data.points.position)]
        if len(outside):
            distance = float(np.median(np.linalg.norm(outside - centre, axis=1)))
    seen = hull.median_colours(centre + distance * directions.reshape(-1, 3), data.views, data.background)
    return EnvironmentLight.from_radiance(seen.reshape(directions.shape))


def initial_surroundings(method: Method, data: Dataset, rng: np.random.Generator) -> dict[str, TensorXf]:
    """The parameters of the background by name: surfels, and a map of the median of their colours."""
    options, region = method.surroundings, data.region
    assert options is not None and region is not None
    wanted = Wanted(options.count, data, rng, options.scattered, region, inside=False)
    start = started(BACKGROUND_START, wanted)
    order = morton_order(start.position)
    points, colours = start.position[order], start.colour
    distance = np.linalg.norm(points - np.array(region.centre), axis=1)
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
    background = EnvironmentLight.constant(np.median(colours, axis=0), options.height)
    return {AROUND + name: tensor for name, tensor in table.raw.items()} | {BACKGROUND: background.raw}


def initial_surfels(
    method: Method, data: Dataset, rng: np.random.Generator, open_scene: bool = False
) -> Surfels:
    """Surfels where the first initialiser in `surfels.start` that fits the data says; in an `open_scene`
    inside the region. Raises InputError as initialisers do."""
    options = method.surfels
    start: dict[str, Any] = dict(options.initial)
    if open_scene:
        assert method.surroundings is not None
        start["opacity"] = method.surroundings.opacity
    region = data.region if open_scene else None
    found = started(options.start, Wanted(options.count, data, rng, options.inside, region))
    points, colours = found.position, found.colour
    normals = init.random_normals(len(points), rng) if found.normal is None else found.normal
    order = morton_order(points)
    if "albedo" in options.from_images and method.light is not None:
        # The hue only: brightness is left to the light until it has been estimated.
        brightest = colours[order].max(axis=1, keepdims=True)
        hue = np.where(brightest > 0, colours[order] / np.maximum(brightest, 1e-9), 1)
        start["albedo"] = np.clip(hue * options.first("albedo"), *ALBEDO_RANGE)
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
