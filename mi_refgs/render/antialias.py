"""Antialiasing of reflections: each pixel, composited once, is shaded at four interpolated points."""

import math
from collections.abc import Callable, Iterable

import drjit as dr
import mitsuba as mi

from mi_refgs.render.stencil import STEPS, ChosenPixels, neighbours
from mi_refgs.shade.points import RadianceTerms, ShadingPoints
from mi_refgs.splat import Camera
from mi_refgs.types import Bool, Float, UInt32, Vector3f

NODE = 0.5 / math.sqrt(3)  # pixels from the centre, per axis: Gauss-Legendre, exact for cubic radiance
NODES = [(x, y) for y in (-1, 1) for x in (-1, 1)]  # quadrant of each point
ONE_RAY = 0.015  # rad, between normals of opposite nodes: below, one ray serves a pixel among blocked ones

Trace = Callable[[ShadingPoints, UInt32], ShadingPoints]  # points of the pixels of these places


def averaged(
    shade: Callable[[ShadingPoints], RadianceTerms],
    points: ShadingPoints,  # (P,) at the pixels' centres, with the normals as they were blended
    camera: Camera,
    pixels: ChosenPixels | None,  # those of the P; None: all, in raster order
    trace: Trace | None = None,
) -> RadianceTerms:
    """Mean over each pixel of the radiance at NODES, under AD. Normals and visibility are interpolated, or
    beside blocked rays those of NODES found by `trace`, or of the centre where all around are blocked and
    normals hardly turn; materials are the centre's: textures stay sharp."""
    ray = None if pixels is None else pixels.raster
    normals = [_interpolated(plane, camera, pixels) for plane in points.normal]
    nodes = []
    for (x, y), *normal in zip(NODES, *normals, strict=True):
        view = -dr.normalize(camera.rays(ray, (NODE * x, NODE * y)))
        nodes.append(ShadingPoints(mi.Vector3f(*normal), view, points.attributes))
    if (seen := points.get("visibility")) is not None:
        blocked = 1 - seen  # 0 beside the object, too
        free = (1 - x for x in _interpolated(blocked, camera, pixels))
        nodes = [node.replaced(visibility=x) for node, x in zip(nodes, free, strict=True)]
        if trace is not None:
            around = sum(neighbours(blocked, camera.width, camera.height, STEPS, pixels), blocked)
            nodes = _traced(nodes, points, trace, around > 0, (around < len(STEPS) + 1) | _turned(nodes))
    found = [shade(node).known() for node in nodes]
    return RadianceTerms(**{name: sum(terms[name] for terms in found) / len(found) for name in found[0]})


def _turned(nodes: list[ShadingPoints]) -> Bool:
    """Whether normals, which are as long as the pixels are opaque, differ by more than ONE_RAY."""
    first, second, third, fourth = (node.normal for node in nodes)
    across = dr.maximum(dr.squared_norm(first - fourth), dr.squared_norm(second - third))
    return across > ONE_RAY**2 * dr.squared_norm(first)


def _traced(
    nodes: list[ShadingPoints], centre: ShadingPoints, trace: Trace, active: Bool, each: Bool
) -> list[ShadingPoints]:
    """The nodes with what rays of active pixels find, all traced together: in pixels `each` (P,) a ray of
    every node, in the others one of the centre, whose visibility and indirect light all nodes have."""
    points = [*nodes, centre]
    lane = dr.arange(mi.UInt32, len(points) * dr.width(each))
    dr.eval(active, each, nodes, centre)  # in one kernel, not in each gather's
    pixel, node = lane // len(points), lane % len(points)
    wanted = dr.gather(mi.Bool, each, pixel) == (node < len(nodes))
    chosen = dr.compress(dr.gather(mi.Bool, active, pixel) & wanted)
    if not dr.width(chosen):
        return nodes
    pixel, node = chosen // len(points), chosen % len(points)

    def joined(vectors: Iterable[Vector3f]) -> Vector3f:
        return sum(
            dr.gather(type(v), v, pixel, node == i, dr.ReduceMode.NoConflicts) for i, v in enumerate(vectors)
        )

    normal, view = joined(at.normal for at in points), joined(at.view for at in points)
    attributes = {name: dr.gather(type(x), x, pixel) for name, x in centre.attributes.items()}
    found = trace(ShadingPoints(normal, view, attributes), pixel)
    for i in range(len(nodes)):
        for name, elsewhere in (("visibility", 1), ("indirect", 0)):
            if (values := found.get(name)) is not None:
                whole = dr.full(type(values), elsewhere, dr.width(each))
                dr.scatter(whole, values, pixel, (node == i) | (node == len(nodes)))
                nodes[i] = nodes[i].replaced(**{name: whole})
    return nodes


def _interpolated(plane: Float, camera: Camera, pixels: ChosenPixels | None) -> list[Float]:
    """Values (P,) at each of NODES of a plane (P,) given at pixel centres."""
    at = dict(zip(STEPS, neighbours(plane, camera.width, camera.height, STEPS, pixels), strict=True))
    side, corner = NODE * (1 - NODE), NODE**2
    centre = (1 - NODE) ** 2 * plane
    return [centre + side * (at[x, 0] + at[0, y]) + corner * at[x, y] for x, y in NODES]
