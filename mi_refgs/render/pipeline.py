"""Surfels to image, in the two orders that every method is made of.

    shade at surfels:  attributes ─ shade ─► radiance channel ─ blend ─► image
    shade at pixels:   attributes ─ blend ─► G-buffer ─ shade ─► image

The same `splat` and the same `shade` serve both. Everything is traced by Dr.Jit; the derivatives that are
absent on purpose are those of `splat.blend`, the visibility, the side to which a normal is turned, and the
camera.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import COVERAGE_FLOOR, FACING_TOLERANCE
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.primitives import primitive_of, widths_of
from mi_refgs.render.antialias import widened
from mi_refgs.render.gbuffer import GBuffer, inverse_alpha
from mi_refgs.shade.light import Light
from mi_refgs.shade.points import ShadingPoints, Terms, safe_normalize
from mi_refgs.shade.reflectance import SurfelView, TraceContext
from mi_refgs.shade.shading import Shading, shade
from mi_refgs.splat import Camera, splat
from mi_refgs.surfels.channels import channel
from mi_refgs.surfels.table import LOGIT_LIMIT, Surfels
from mi_refgs.timing import boundary


@dataclass(frozen=True)
class Frame:
    """One rendered view: mi arrays of H·W values in raster order.

    Radiance and its terms are linear and premultiplied by alpha; maps are divided by it and 0 where nothing
    is seen.
    """

    alpha: Any  # accumulated opacity
    depth: Any  # expected camera-z depth, 0 where nothing is seen
    normal: Any  # mi.Vector3f: blended world normal towards the camera, not normalised; None if not asked for
    radiance: Any  # mi.Color3f, over black
    terms: Terms | None = None  # diffuse, specular, indirect, whose sum it is, where known apart
    maps: dict[str, Any] = field(default_factory=dict)  # by channel (such as albedo), visibility, where known


def render(
    surfels: Surfels,
    camera: Camera,
    shading: Shading,
    light: Light | None = None,
    occluder: Occluder | None = None,
    sh_degree: int | None = None,
    shift: Any = None,
    aovs: bool = False,
    normals: bool = True,
) -> Frame:
    """Render a view.

    `light` is what `Shading.light_of` gives, needed unless the model asks for none. `sh_degree` limits the
    degree of the radiance channel, for coarse-to-fine schedules. `aovs` asks for the materials and the terms
    of the radiance even where the picture does not need them per pixel; without `normals`, they are absent
    where it does not. `shift`: see `splat.project`.
    `shading.accuracy.traced_bounces` needs an occluder whose `set_materials` has seen these surfels.
    Raises InputError for what `shading.check` refuses.
    """
    primitive_of(widths_of(surfels.raw))
    shading.check(surfels.raw, light is not None, occluder is not None)
    if surfels.count == 0:
        surfels, shift = _nothing(surfels), None
    seen = _seen(surfels, camera, sh_degree)
    attributes = shading.model.attributes(surfels, seen, shading)
    scene = _Scene(surfels, camera, shading, light, occluder, seen, attributes, shift)
    frame = (
        _shade_at_surfels(scene, aovs, normals) if shading.at == "surfel" else _shade_at_pixels(scene, aovs)
    )
    return boundary(frame, "shade backward")


def render_depth(surfels: Surfels, camera: Camera) -> tuple[Any, Any]:
    """Expected camera-z depth (0 where nothing is seen) and alpha of a view, and nothing else."""
    blended = splat(surfels, [], camera)
    return blended.depth * inverse_alpha(blended.alpha), blended.alpha


def _nothing(surfels: Surfels) -> Surfels:
    """One surfel that no camera sees, with the channels of an empty table: Dr.Jit refuses empty arrays."""
    unseen = {"opacity": -LOGIT_LIMIT}
    return Surfels(
        {n: dr.full(mi.TensorXf, unseen.get(n, 0), (1, int(x.shape[1]))) for n, x in surfels.raw.items()}
    )


# ---------------- the two orders ----------------


@dataclass(frozen=True)
class _Scene:
    """What both orders start from."""

    surfels: Surfels
    camera: Camera
    shading: Shading
    light: Any
    occluder: Any
    seen: SurfelView
    attributes: dict[str, Any]  # of the model, by name
    shift: Any

    @property
    def normal(self) -> Any:
        """The model's own normals (mi.Vector3f), or the surfels'."""
        return self.attributes.get("normal", self.seen.normal)

    @property
    def named(self) -> dict[str, Any]:
        """The attributes but the normal."""
        return {name: value for name, value in self.attributes.items() if name != "normal"}

    def materials(self) -> dict[str, Any]:
        """Activated channels that have an AOV, by name."""
        return {name: self.surfels.value(name) for name in self.surfels.raw if channel(name).aov}


def _seen(surfels: Surfels, camera: Camera, sh_degree: int | None) -> SurfelView:
    """Unit direction from the camera to each surfel, and its normal turned towards the camera.

    A normal that points away by less than FACING_TOLERANCE stays: such a surfel lies just behind a
    silhouette, and shows there through the low-pass; turned round it would oppose its neighbours and leave
    the outline without a normal.
    """
    # A surfel at the camera's own position has no direction; it is culled, so any will do.
    direction = safe_normalize(camera.towards(surfels.position()))
    normal = surfels.primitive.normal(surfels)
    facing = dr.select(dr.detach(dr.dot(normal, direction)) > FACING_TOLERANCE, -normal, normal)
    return SurfelView(direction, facing, sh_degree)


def _shade_at_surfels(scene: _Scene, aovs: bool, normals: bool) -> Frame:
    shading, direction = scene.shading, scene.seen.direction
    points = ShadingPoints(scene.normal, -direction, scene.named)
    if shading.occlusion:
        centre = scene.surfels.position()
        around = TraceContext(scene.occluder, scene.surfels, scene.light, centre, direction)
        points = shading.model.trace(points, around, shading)
    terms = shade(points, scene.light, shading)
    # A feature costs time in every pair, so what is not asked for is not blended.
    slots = {"radiance": terms.total()} | ({"normal": scene.normal} if normals else {})
    materials = scene.materials() if aovs else {}
    if aovs:
        slots |= terms.known() | materials
    buffer = GBuffer.blend(scene.surfels, slots, scene.camera, scene.shift)
    blended = buffer.slots
    apart = Terms(**{name: blended[name] for name in terms.known()}).filled() if aovs else None
    return Frame(
        alpha=buffer.alpha,
        depth=buffer.depth,
        normal=blended.get("normal"),
        radiance=blended["radiance"],
        terms=apart,
        maps={name: buffer.divided(name) for name in materials},
    )


def _shade_at_pixels(scene: _Scene, aovs: bool) -> Frame:
    shading, camera = scene.shading, scene.camera
    slots = {"normal": scene.normal} | scene.named
    if aovs:
        slots |= {name: value for name, value in scene.materials().items() if name not in slots}
    buffer = GBuffer.blend(scene.surfels, slots, camera, scene.shift)

    values = {name: buffer.divided(name) for name in slots if name != "normal"}
    normal, ray = buffer.slots["normal"], camera.rays()
    attributes = {name: values[name] for name in scene.named}
    if shading.accuracy.antialias:
        attributes["roughness"] = widened(attributes["roughness"], normal, buffer.alpha, camera)
    points = ShadingPoints(normal, -dr.normalize(ray), attributes)
    maps = {name: values[name] for name in scene.surfels.raw if name in values}
    if shading.occlusion:
        covered = dr.detach(buffer.alpha) > COVERAGE_FLOOR
        around = TraceContext(scene.occluder, scene.surfels, scene.light, camera.origin, ray, covered)
        points = shading.model.trace(points, around, shading)
        maps["visibility"] = points.visibility
    shaded = shade(points, scene.light, shading)
    terms = Terms(**{name: term * buffer.alpha for name, term in shaded.known().items()}).filled()
    return Frame(
        alpha=buffer.alpha,
        depth=buffer.depth,
        normal=normal,
        radiance=terms.total(),
        terms=terms,
        maps=maps,
    )
