"""Antialiasing of reflections: each pixel, composited once, is shaded at four interpolated points."""

import math
from collections.abc import Callable, Iterable

import drjit as dr
import mitsuba as mi

from mi_refgs.render.stencil import ChosenPixels, neighbours
from mi_refgs.shade.points import RadianceTerms, ShadingPoints
from mi_refgs.splat import Camera
from mi_refgs.types import Float, UInt32, Vector3f

NODE = 0.5 / math.sqrt(3)  # pixels from the centre, per axis: Gauss-Legendre, exact for cubic radiance
NODES = [(x, y) for y in (-1, 1) for x in (-1, 1)]  # quadrant of each point
STEPS = [(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1) if (x, y) != (0, 0)]  # steps to the neighbours

Trace = Callable[[ShadingPoints, UInt32], ShadingPoints]  # points of the pixels of these places


def averaged(
    shade: Callable[[ShadingPoints], RadianceTerms],
    points: ShadingPoints,  # (P,) at the pixels' centres, with the normals as they were blended
    camera: Camera,
    pixels: ChosenPixels | None,  # those of the P; None: all, in raster order
    trace: Trace | None = None,
) -> RadianceTerms:
    """Mean over each pixel of the radiance at NODES, under AD. Normals and visibility are interpolated, or
    beside blocked rays those of NODES found by `trace`; materials are the centre's: textures stay sharp."""
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
            near = sum(neighbours(blocked, camera.width, camera.height, STEPS, pixels), blocked) > 0
            nodes = _traced(nodes, trace, dr.compress(near))
    found = [shade(node).known() for node in nodes]
    return RadianceTerms(**{name: sum(terms[name] for terms in found) / len(found) for name in found[0]})


def _traced(nodes: list[ShadingPoints], trace: Trace, chosen: UInt32) -> list[ShadingPoints]:
    """The nodes with what the rays of the chosen pixels find, all traced together."""
    if not (count := dr.width(chosen)):
        return nodes
    dr.eval(nodes)  # in one kernel, not in each gather's
    # Literal sizes, also those of expanded adjoints, would be other kernels in each step of a fit.
    lane, size = dr.arange(mi.UInt32, len(nodes) * count), dr.opaque(mi.UInt32, count)
    every = dr.gather(mi.UInt32, chosen, lane % size)

    def joined(vectors: Iterable[Vector3f]) -> Vector3f:
        return sum(
            dr.gather(type(v), v, every, lane // size == i, dr.ReduceMode.NoConflicts)
            for i, v in enumerate(vectors)
        )

    normal, view = joined(node.normal for node in nodes), joined(node.view for node in nodes)
    attributes = {name: dr.gather(type(x), x, every) for name, x in nodes[0].attributes.items()}
    found = trace(ShadingPoints(normal, view, attributes), every)
    for i, node in enumerate(nodes):
        own = dr.arange(mi.UInt32, count) + i * size
        for name, elsewhere in (("visibility", 1), ("indirect", 0)):
            if (values := found.get(name)) is not None:
                whole = dr.full(type(values), elsewhere, dr.width(node.view))
                values = dr.gather(type(values), values, own, mode=dr.ReduceMode.NoConflicts)
                dr.scatter(whole, values, chosen)
                nodes[i] = nodes[i].replaced(**{name: whole})
    return nodes


def _interpolated(plane: Float, camera: Camera, pixels: ChosenPixels | None) -> list[Float]:
    """Values (P,) at each of NODES of a plane (P,) given at pixel centres."""
    at = dict(zip(STEPS, neighbours(plane, camera.width, camera.height, STEPS, pixels), strict=True))
    side, corner = NODE * (1 - NODE), NODE**2
    centre = (1 - NODE) ** 2 * plane
    return [centre + side * (at[x, 0] + at[0, y]) + corner * at[x, y] for x, y in NODES]
