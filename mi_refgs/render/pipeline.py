"""Surfels to image, in the two orders that every method is made of.

    shade at surfels:  attributes ─ shade ─► radiance channel ─ blend ─► image
    shade at pixels:   attributes ─ blend ─► G-buffer ─ shade ─► image

The same `splat` and the same `shade` serve both. Everything is traced by Dr.Jit; derivatives are left out of
visibility, the side to which a normal is turned, the camera, and those that `splat.blend` lists.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import COVERAGE_FLOOR, FACING_TOLERANCE
from mi_refgs.kernels.device import require_supported_variant
from mi_refgs.kernels.timing import boundary
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.render.antialias import widened
from mi_refgs.render.gbuffer import GBuffer, inverse_alpha
from mi_refgs.render.surroundings import AROUND, OBJECT, Surroundings, joined_slots, together
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.points import TERMS, RadianceTerms, ShadingPoints, safe_normalize
from mi_refgs.shade.reflectance import SurfelView, TraceContext
from mi_refgs.shade.shading import Shading, shade
from mi_refgs.splat import Camera, splat
from mi_refgs.splat.lanes import Places
from mi_refgs.surfels.attributes import channel
from mi_refgs.surfels.primitives import primitive_of, widths_of
from mi_refgs.surfels.table import LOGIT_LIMIT, Surfels


@dataclass(frozen=True)
class Frame:
    """One rendered view: mi arrays of H·W values in raster order.

    Radiance and its terms are linear and premultiplied by alpha; maps are divided by it and 0 where nothing
    is seen. With `Surroundings`, alpha, depth and radiance are of both, terms and maps of the object.
    """

    alpha: Any  # accumulated opacity
    depth: Any  # expected camera-z depth, 0 where nothing is seen; None if not asked for
    normal: Any  # mi.Vector3f: blended world normal towards the camera, not normalised; None if not asked for
    radiance: Any  # mi.Color3f, over black
    terms: RadianceTerms | None = None  # diffuse, specular, indirect, whose sum it is, where known apart
    maps: dict[str, Any] = field(default_factory=dict)  # by channel (such as albedo), visibility, where known
    background: Any = None  # mi.Color3f: linear, seen through 1 - alpha; only with surroundings
    share: Any = None  # opacity of the object alone, where it is known and not alpha
    distance: Any = None  # along the ray from the near plane, mean of several samples; None of one
    own_normal: bool = False  # `normal` is of the object alone, and premultiplied by `share`

    def only(self, asked: Collection[str]) -> Frame:
        """The same frame without depth, normal, terms and maps that are not asked for by name."""
        return replace(
            self,
            depth=self.depth if "depth" in asked else None,
            normal=self.normal if "normal" in asked else None,
            terms=self.terms if {*TERMS}.intersection(asked) else None,
            maps={name: value for name, value in self.maps.items() if name in asked},
        )


def render(
    surfels: Surfels,
    camera: Camera,
    shading: Shading,
    light: Light | None = None,
    occluder: Occluder | None = None,
    sh_degree: int | None = None,
    shift: Any = None,
    aovs: bool | Collection[str] = False,
    normals: bool = True,
    surroundings: Surroundings | None = None,
    derivatives: bool = True,
) -> Frame:
    """Render a view.

    `light` is what `Shading.light_of` gives, needed unless the model asks for none. `sh_degree` limits the
    degree of the radiance channel, for coarse-to-fine schedules. `aovs` asks for materials, "visibility",
    "normal", "depth" and the terms of the radiance, by name or (True) all, even where the picture does not
    need them per pixel; without `normals`, they are absent where it does not. `shift`: see `splat.project`;
    with `surroundings` it is of their rows too, after the object's. Without `derivatives`, the frame has
    radiance, alpha and what `aovs` asks for alone; images differ by rounding. `traced_bounces` needs an
    occluder whose `set_materials` has seen these surfels. Raises InputError as `shading.check` does.
    """
    require_supported_variant("mi_refgs.render_frame")
    primitive_of(widths_of(surfels.raw))
    shading.check(surfels.raw, light is not None, occluder is not None)
    if surfels.count == 0:
        surfels, shift = _nothing(surfels), None
    if surroundings is not None and surroundings.surfels.count == 0:
        surroundings, shift = replace(surroundings, surfels=_nothing(surroundings.surfels)), None
    seen = _seen(surfels, camera, sh_degree)
    attributes = shading.model.attributes(surfels, seen, shading)
    around = None if surroundings is None else _Around.of(surroundings, surfels, camera, sh_degree)
    asked = _asked(surfels, aovs) | ({"normal"} if normals and derivatives else frozenset())
    alone = not derivatives and not shading.accuracy.antialias  # whose neighbours are those of the image
    scene = _Scene(surfels, camera, shading, light, occluder, seen, attributes, shift, around, asked, alone)
    frame, buffer = _shade_at_surfels(scene) if shading.at == "surfel" else _shade_at_pixels(scene)
    if not derivatives:
        frame = _in_raster_order(frame.only(asked), buffer.places)
    return boundary(frame, "shade backward")


def render_depth(surfels: Surfels, camera: Camera, around: Surfels | None = None) -> tuple[Any, Any]:
    """Expected camera-z depth (0 where nothing is seen) and alpha of a view, and nothing else.

    `around`: of the surfels and of these, which surround them, together.
    """
    if around is not None:
        surfels = together(surfels, around)
    blended = splat(surfels, [], camera)
    return blended.depth * inverse_alpha(blended.alpha), blended.alpha


def _asked(surfels: Surfels, aovs: bool | Collection[str]) -> frozenset[str]:
    if isinstance(aovs, bool):
        materials = (name for name in surfels.raw if channel(name).aov)
        return frozenset({*materials, *TERMS, "visibility", "normal", "depth"} if aovs else ())
    return frozenset(aovs)


def _in_raster_order(frame: Frame, places: Places | None) -> Frame:
    if places is None:
        return frame
    dr.eval(frame.alpha, frame.depth, frame.normal, frame.radiance, frame.terms, frame.maps, frame.share)
    raster = places.to_raster
    terms = frame.terms and RadianceTerms(
        **{name: raster(term) for name, term in frame.terms.known().items()}
    )
    return replace(
        frame,
        alpha=raster(frame.alpha),
        depth=raster(frame.depth),
        normal=raster(frame.normal),
        radiance=raster(frame.radiance),
        terms=terms,
        maps={name: raster(value) for name, value in frame.maps.items()},
        share=raster(frame.share),
    )


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
    around: _Around | None
    asked: frozenset[str]  # what the frame has beside radiance and alpha
    alone: bool  # for a picture alone, without derivatives

    @property
    def normal(self) -> Any:
        """The model's own normals (mi.Vector3f), or the surfels'."""
        return self.attributes.get("normal", self.seen.normal)

    @property
    def named(self) -> dict[str, Any]:
        """The attributes but the normal."""
        return {name: value for name, value in self.attributes.items() if name != "normal"}

    def materials(self) -> dict[str, Any]:
        """Activated channels that are asked for, by name."""
        return {name: self.surfels.value(name) for name in self.surfels.raw if name in self.asked}

    def presence(self) -> dict[str, Any]:
        """The slot of the object's opacity, where alpha is not that."""
        return {} if self.around is None else {OBJECT: dr.full(mi.Float, 1, self.surfels.count)}

    def blend(self, slots: dict[str, Any], others: dict[str, Any]) -> GBuffer:
        """Slots of the object's rows, and those that the surroundings have, if there are any, in one sort."""
        table, share = self.surfels, ""
        if self.around is not None:
            table, share = self.around.table, OBJECT if OBJECT in slots else ""
            slots = joined_slots(slots, others, (self.surfels.count, self.around.count))
        depth = not self.alone or "depth" in self.asked
        return GBuffer.blend(table, slots, self.camera, self.shift, share, self.alone, depth)


@dataclass(frozen=True)
class _Around:
    """Surroundings in a camera."""

    table: Surfels  # geometry of the object and of them
    count: int  # their rows
    normal: Any  # mi.Vector3f of width `count`, towards the camera
    radiance: Any  # mi.Color3f of width `count`
    background: Any  # mi.Color3f, pixel by pixel

    @staticmethod
    def of(surroundings: Surroundings, surfels: Surfels, camera: Camera, sh_degree: int | None) -> _Around:
        others = surroundings.surfels
        seen = _seen(others, camera, sh_degree)
        radiance = seen.harmonic_colour(others.value("radiance_sh"))
        table = together(surfels, others)
        return _Around(table, others.count, seen.normal, radiance, surroundings.behind(camera))


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


def _shade_at_surfels(scene: _Scene) -> tuple[Frame, GBuffer]:
    shading, direction, normals = scene.shading, scene.seen.direction, "normal" in scene.asked
    points = ShadingPoints(scene.normal, -direction, scene.named)
    if shading.occlusion:
        centre = scene.surfels.position()
        meets = TraceContext(scene.occluder, scene.surfels, scene.light, centre, direction)
        points = shading.model.trace(points, meets, shading)
    terms, around = shade(points, scene.light, shading), scene.around
    # A feature costs time in every pair, so what is not asked for is not blended.
    slots = {"radiance": terms.total()} | ({"normal": scene.normal} if normals else {})
    materials, others = scene.materials(), {}
    apart = {name: term for name, term in terms.known().items() if name in scene.asked}
    if scene.asked - {"normal"}:
        slots |= apart | materials | scene.presence()
    if around is not None:
        others = {"radiance": around.radiance} | ({"normal": around.normal} if normals else {})
    buffer = scene.blend(slots, others)
    blended = buffer.slots
    known = RadianceTerms(**{"diffuse": None} | {name: blended[name] for name in apart}).filled()
    frame = Frame(
        alpha=buffer.alpha,
        depth=buffer.depth,
        normal=blended.get("normal"),
        radiance=blended["radiance"],
        terms=known if scene.asked & {*TERMS} else None,
        maps={name: buffer.divided(name) for name in materials},
        background=None if around is None else around.background,
        share=blended.get(OBJECT),
    )
    return frame, buffer


def _shade_at_pixels(scene: _Scene) -> tuple[Frame, GBuffer]:
    shading, camera = scene.shading, scene.camera
    slots, around = {"normal": scene.normal} | scene.named, scene.around
    slots |= {name: value for name, value in scene.materials().items() if name not in slots}
    others = {} if around is None else {AROUND: around.radiance}
    buffer = scene.blend(slots | scene.presence(), others)

    values = {name: buffer.divided(name) for name in slots if name != "normal"}
    normal = buffer.slots["normal"]
    pixel = None if buffer.places is None else buffer.places.raster
    ray, index = camera.rays(pixel), camera.image_index(pixel)
    alpha = buffer.slots.get(OBJECT, buffer.alpha)
    attributes = {name: values[name] for name in scene.named}
    if shading.accuracy.antialias:
        attributes["roughness"] = widened(attributes["roughness"], normal, alpha, camera)
    points = ShadingPoints(normal, -dr.normalize(ray), attributes)
    maps = {name: values[name] for name in scene.surfels.raw if name in values}
    if shading.occlusion:
        covered = dr.detach(alpha) > COVERAGE_FLOOR
        meets = TraceContext(scene.occluder, scene.surfels, scene.light, camera.origin, ray, covered, index)
        points = shading.model.trace(points, meets, shading)
        maps["visibility"] = points.visibility
    shaded = shade(points, scene.light, shading)
    terms = RadianceTerms(**{name: term * alpha for name, term in shaded.known().items()}).filled()
    frame = Frame(
        alpha=buffer.alpha,
        depth=buffer.depth,
        normal=normal,
        radiance=terms.total() if around is None else terms.total() + buffer.slots[AROUND],
        terms=terms,
        maps=maps,
        background=None if around is None else around.background,
        share=buffer.slots.get(OBJECT),
        own_normal=around is not None,
    )
    return frame, buffer
