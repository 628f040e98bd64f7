"""What pixels see in their mirrors: is the light free there, and what stands in its way?

The paper traces one mirror ray for the whole lobe and leaves what it hits to the indirect attribute. The
option `visibility_rays` averages over samples of the lobe instead, and `traced_bounces` shades what blocked
rays hit.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.shade.ggx_sampling import Lobe
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import ShadingPoints, reflect
from mi_refgs.shade.reflectance.model import TraceContext
from mi_refgs.shade.split_sum import base_reflectance
from mi_refgs.shade.traced_light import MeshRadiance
from mi_refgs.shade.visibility import mirror_visibility, start_on_mesh

CLAMP_MAX_ALPHA = 1 / 3
"""α of a lobe from which single bright rays are not clamped. In the concave scenes of
`benchmarks.visibility`, 4 rays and 6 bounces, the clamp takes 17 to 42 % off relMSE at α = 0.01, 0 to 33 % at
0.09, and adds up to 15 % at 0.36."""


def reflection(points: ShadingPoints, context: TraceContext, options: ShadingOptions) -> ShadingPoints:
    """`points` with the visibility (mi.Float, 0 … 1, detached) and indirect light that `options` asks for.

    `points.indirect` (of the indirect channel) stays unless `options.traced_bounces` replaces it by the mean
    radiance of what blocked rays hit (`MeshRadiance`), single bright ones clamped (`_firefly_clamp`). Its
    gradient goes to the light and to the materials of the surfels around all hits, in both modes; rays, hits
    and the clamp are detached, and so is what the pixel's own roughness does to the rays.
    """
    occluder, origin, ray, covered = context.occluder, context.origin, context.ray, context.covered
    normal = dr.detach(points.normal)
    if options.visibility_rays == 1 and not options.traced_bounces:
        visibility = mirror_visibility(occluder, origin, ray, normal, points.view, covered)
        return points.replaced(visibility=visibility)
    if occluder.empty:
        return points.replaced(visibility=dr.full(mi.Float, 1, dr.width(ray)), indirect=None)
    scene = None
    if options.traced_bounces:
        scene = MeshRadiance.of(occluder, context.surfels, context.light, options)
    with dr.suspend_grad():
        point, facing, seen = start_on_mesh(occluder, origin, ray, normal, covered)
    if options.visibility_rays > 1:
        with dr.suspend_grad():
            lobe = Lobe.of(facing, points.view, points.roughness, base_reflectance(points), context.pixel)
            open_ = None if scene is None else scene.light_from(facing, points.view, points.roughness)
        visibility, indirect = _average(
            occluder, scene, lobe, options.visibility_rays, point, facing, seen, open_
        )
    else:
        assert scene is not None
        mirror = dr.detach(reflect(view=points.view, normal=facing))
        hit = scene.trace(point, mirror, facing, seen, options.traced_bounces)
        dr.eval(hit)  # now, once, as for the visibility alone
        visibility = dr.select(hit.valid, mi.Float(0), mi.Float(1))
        indirect = dr.select(hit.valid, scene.radiance(hit, mirror), 0)
    if scene is None:
        return points.replaced(visibility=visibility)
    return points.replaced(visibility=visibility, indirect=indirect)


def _average(
    occluder: Occluder,
    scene: MeshRadiance | None,
    lobe: Lobe,
    rays: int,
    point: Any,
    facing: Any,
    seen: Any,
    open_: Any,
) -> tuple[Any, Any]:
    """Mean visibility over rays of the lobe, weighted as the specular integrand weights them, and the mean
    radiance of the blocked ones (None without a `scene` to see there), in one loop.

    `open_` (mi.Color3f, detached): the mean radiance of the others.
    """
    count = dr.opaque(mi.UInt32, rays)

    def body(index: Any, free: Any, blocked: Any, total: Any, largest: Any) -> tuple[Any, ...]:
        with dr.suspend_grad():
            direction, weight = lobe.sample(index, count)
            if scene is None:
                stopped = occluder.visible(point, direction, facing, weight > 0) == 0
            else:
                hit = scene.trace(point, direction, facing, weight > 0, scene.options.traced_bounces)
                stopped = hit.valid
        if scene is not None:
            found = dr.select(stopped, weight * scene.radiance(hit, direction), 0)
            total = total + found
            largest = dr.maximum(largest, dr.detach(found))
        free, blocked = free + dr.select(stopped, 0, weight), blocked + dr.select(stopped, weight, 0)
        return index + 1, free, blocked, total, largest

    # A sum over rays, whose derivative keeps no state of an iteration: Dr.Jit's max_iterations = -1.
    start = (mi.UInt32(0), mi.Float(0), mi.Float(0), mi.Color3f(0), mi.Color3f(0))
    _, free, blocked, total, largest = dr.while_loop(
        start, lambda index, *_: seen & (index < count), body, max_iterations=-1, label="lobe"
    )
    every = free + blocked
    visibility = dr.select(every > 0, free / dr.select(every > 0, every, 1), 1)
    if scene is None:
        dr.eval(visibility)
        return dr.detach(visibility), None
    total = total * _firefly_clamp(dr.detach(total), largest, free * open_, mi.Float(count), lobe.α)
    indirect = total * dr.select(blocked > 0, dr.rcp(dr.select(blocked > 0, blocked, 1)), 0)
    dr.eval(visibility, indirect)
    return dr.detach(visibility), indirect


def _firefly_clamp(total: Any, largest: Any, free: Any, count: Any, α: Any) -> Any:
    """What share (0 … 1, detached) of the sum over blocked rays counts, in each colour.

    The `largest` of `count` rays counts for no more than all rays would at the mean of the others, `free`
    ones included: one of a few rays of a narrow lobe that finds a lamp in a reflection speckles the picture.
    In a wide lobe rays differ anyway, so this fades out with its α (see CLAMP_MAX_ALPHA). The more rays, the
    less is clamped: the limit is the true mean.
    """
    others = dr.maximum(total - largest, 0)
    excess = dr.maximum(largest - (others + free) * count / (count - 1), 0) * dr.maximum(
        1 - α / CLAMP_MAX_ALPHA, 0
    )
    return dr.select(total > 0, dr.maximum(1 - excess / dr.select(total > 0, total, 1), 0), 1)
