"""Render surfels to an image, in the two orders that every method is made of.

    forward shading:   attributes ─ shade ─► radiance ─ blend ─► image      (`Shading.shaded_at` is "surfel")
    deferred shading:  attributes ─ blend ─► G-buffer ─ shade ─► image      (`Shading.shaded_at` is "pixel")

Both use the same splatter and the same `shade`; only deferred shading lets normals vary over a surfel
(`curvature`). `mi_refgs.plugins.derivatives` lists what has no derivative.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import COVERAGE_FLOOR, FACING_TOLERANCE
from mi_refgs.kernels.device import require_supported_variant
from mi_refgs.kernels.timing import boundary
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.render.antialias import averaged
from mi_refgs.render.gbuffer import OBJECT, SURROUNDINGS, GBuffer, features, joined_slots
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.shade.light.light import Light, RotatedLight
from mi_refgs.shade.light.near_field import LocalLight, NearField
from mi_refgs.shade.points import TERMS, RadianceTerms, ShadingPoints, safe_normalize
from mi_refgs.shade.reflectance import SurfelView, TraceContext
from mi_refgs.shade.shading import Shading, shade, trace
from mi_refgs.splat import Camera, splat
from mi_refgs.surfels.attributes import attribute
from mi_refgs.surfels.primitives.primitive import primitive_of
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Color3f, Float, Point3f, TensorXf, UInt32, Vector3f


@dataclass(frozen=True)
class SurfelScene:
    """Surfels, how they are shaded, and what lights, occludes and surrounds them."""

    surfels: Surfels
    shading: Shading
    light: Light | None = None  # as `Shading.light_of` returns it; required unless the model uses none
    occluder: Occluder | None = None  # `traced_bounces` requires that it has the surfels' materials
    surroundings: Surroundings | None = None
    near: NearField | None = None  # distances of what the light shows; None: infinitely far
    turntable: TensorXf | None = None  # axes (3, 3) of the camera that sees `light`; it turns with others

    @property
    def all_aovs(self) -> frozenset[str]:
        """Names of all AOVs that a frame of this scene may have."""
        inputs = {x for x in self.shading.required_attributes if not attribute(x).harmonics}
        materials = {name for name in self.surfels.raw if attribute(name).aov or name in inputs}
        return frozenset({*materials, *TERMS, "visibility", "normal", "depth"})

    def light_at(self, position: Point3f) -> Light | None:
        """The light as it is seen from points."""
        if self.light is None or self.near is None:
            return self.light
        return LocalLight(self.light, self.near, position)

    def lit_for(self, camera: Camera) -> "SurfelScene":
        """The scene as a camera sees it: on a turntable, the light is turned by its rotation."""
        if self.light is None or self.turntable is None:
            return self
        axes = mi.Matrix3f(*(dr.gather(mi.Float, self.turntable.array, i) for i in range(9)))
        return replace(self, light=RotatedLight(self.light, axes @ camera.rotation))


@dataclass(frozen=True)
class Request:
    """Requested outputs of a render, and how they are computed."""

    aovs: Collection[str] = ()  # materials, terms of the radiance, "visibility", "normal", "depth", by name
    forward_only: bool = False  # for images without derivatives: frames have what was asked for only
    sh_degree: int | None = None  # highest SH degree of the radiance, for coarse-to-fine schedules
    attribution: Float | None = None  # (N,) zeros, which get Σ w δ for adjoints δ of the frame's


RADIANCE = Request()  # radiance and alpha, with derivatives


@dataclass(frozen=True)
class Frame:
    """One rendered view: arrays of H·W linear values in raster order.

        field      of object and surroundings  weight                   where nothing is seen
        radiance   both                        times alpha              0
        depth      both                        divided by alpha         0
        normal     object                      times object_alpha       0
        terms      object                      times object_alpha       0
        maps       object                      divided by object_alpha  0

    Without derivatives, AOVs that were not requested are None or absent."""

    alpha: Float  # accumulated opacity
    depth: Float  # expected camera-z depth
    normal: Vector3f  # blended world normal towards the camera
    radiance: Color3f  # over black
    terms: RadianceTerms | None = None  # diffuse, specular, indirect; they sum to the radiance of the object
    maps: dict[str, Any] = field(default_factory=dict)  # by name: materials such as albedo, visibility
    background: Color3f = None  # linear, seen through 1 - alpha; None without surroundings
    object_alpha: Float = None  # opacity of the object, `alpha` itself without surroundings
    distance: Float = None  # mean along the ray from the near plane, of several samples per pixel
    attribution: Float = None  # blend of `Request.attribution`, zeros

    def only(self, aovs: Collection[str]) -> "Frame":
        """The same frame without depth, normal, terms and maps that are not named."""
        return replace(
            self,
            depth=self.depth if "depth" in aovs else None,
            normal=self.normal if "normal" in aovs else None,
            terms=self.terms if {*TERMS}.intersection(aovs) else None,
            maps={name: value for name, value in self.maps.items() if name in aovs},
        )


def render(scene: SurfelScene, camera: Camera, request: Request = RADIANCE) -> Frame:
    """Render a view; rows of `attribution` are the object's, then the surroundings'. Raises InputError."""
    require_supported_variant("mi_refgs.render_frame")
    primitive_of(scene.surfels.raw)
    scene.shading.require_inputs(scene.surfels.raw, scene.light is not None, scene.occluder is not None)
    around, count = scene.surroundings, scene.surfels.count
    if not count or (around is not None and not around.surfels.count):
        request = replace(request, attribution=None)  # is nobody's
    if around is not None:
        around = replace(around, surfels=around.surfels.never_empty())
    scene = replace(scene.lit_for(camera), surfels=scene.surfels.never_empty(), surroundings=around)
    with dr.suspend_grad(when=request.forward_only):
        view = _View(scene, request, camera)
        frame = _shade_at_surfels(view) if scene.shading.shaded_at == "surfel" else _shade_at_pixels(view)
        return boundary(frame, "shade backward")


def render_depth(surfels: Surfels, camera: Camera, around: Surfels | None = None) -> tuple[Float, Float]:
    """Expected camera-z depth (0 where nothing is seen) and alpha of surfels, with those around them."""
    blended = splat([surfels] if around is None else [surfels, around], [], camera)
    return blended.expected_depth, blended.alpha


class _View:
    """A scene, as a camera sees its surfels: what both orders start from."""

    def __init__(self, scene: SurfelScene, request: Request, camera: Camera) -> None:
        surfels, surroundings = scene.surfels, scene.surroundings
        self.scene, self.request, self.camera = scene, request, camera
        seen = _seen(surfels, camera, request.sh_degree)
        attributes = {**scene.shading.model.values(surfels, seen, scene.shading)}
        normal = attributes.pop("normal", seen.normal)  # the model's own, or the surfels'
        self.points = ShadingPoints(normal, -seen.direction, attributes)
        self.geometry, self.background = [surfels], None
        self.presence: dict[str, Any] = {}  # the slot of the object's opacity, where alpha is not that
        self.others: dict[str, Any] = {}  # radiance of the surroundings' surfels, if there are any
        if surroundings is not None:
            beside = _seen(surroundings.surfels, camera, request.sh_degree)
            self.others["radiance"] = beside.harmonic_colour(surroundings.surfels.value("radiance_sh"))
            self.presence[OBJECT] = dr.full(mi.Float, 1, surfels.count)
            self.geometry.append(surroundings.surfels)
            self.background = surroundings.behind(camera)

    @property
    def asked(self) -> frozenset[str]:
        return frozenset(self.request.aovs)

    def blend(self, slots: dict[str, Any], others: dict[str, Any], turns: Mapping[str, Vector3f]) -> GBuffer:
        """Blend slots of the object's surfels together with those of the surroundings, in one sort; the first
        slot varies over a surfel by its `turns`."""
        few, place = len(features(slots)), None  # features that all surfels have; place of the attribution
        if self.others:
            own, beside = (table.count for table in self.geometry)
            first = dict.fromkeys([*slots][:1], mi.Vector3f(0)) if turns else {}
            few = len(features(first | others))
            slots = joined_slots(slots, first | others, (own, beside))  # begin with those of the surroundings
            turns = joined_slots(turns, {}, (own, beside))
        values = features(slots)
        if self.request.attribution is not None:
            values.insert(few, self.request.attribution)
            place = few
        blended = splat(self.geometry, values, self.camera, features(turns), few + (place is not None))
        return GBuffer(blended, slots, place)

    def frame(self, buffer: GBuffer, **fields: Any) -> Frame:
        """The frame of a G-buffer and of what was shaded, in raster order."""
        frame = Frame(buffer.alpha, buffer.depth, attribution=buffer.attribution, **fields)
        if self.request.forward_only:
            frame = frame.only(self.request.aovs)
        return replace(frame, background=self.background)


def _seen(surfels: Surfels, camera: Camera, sh_degree: int | None) -> SurfelView:
    """Unit direction from the camera to each surfel, and its normal turned towards the camera, but for one
    that points away by less than FACING_TOLERANCE, behind a silhouette: it would oppose its neighbours."""
    # A surfel at the camera's own position has no direction; it is culled, so any will do.
    direction = safe_normalize(camera.towards(surfels.position()))
    normal = surfels.primitive.normal(surfels)
    facing = dr.select(dr.detach(dr.dot(normal, direction)) > FACING_TOLERANCE, -normal, normal)
    return SurfelView(direction, facing, sh_degree)


def _shade_at_surfels(view: _View) -> Frame:
    """Forward shading: shade the surfels, then blend their radiance."""
    scene, points, asked = view.scene, view.points, view.asked
    # Radiance of each surfel.
    if scene.shading.occlusion:
        assert scene.occluder is not None  # by `Shading.require_inputs`
        points = points.replaced(position=scene.surfels.position())
        origin, ray = view.camera.origin, -points.view
        context = TraceContext(scene.occluder, scene.surfels, scene.light, origin, ray)
        points = trace(points, context, scene.shading)
    terms = shade(points, scene.light_at(scene.surfels.position()), scene.shading)

    # Slots: the radiance and the requested AOVs only, since each costs time in every surfel-tile pair.
    asked_terms = {name: term for name, term in terms.known().items() if name in asked}
    slots = {"radiance": terms.total()} | ({"normal": points.normal} if "normal" in asked else {})
    materials = scene.surfels.values(asked)
    if "visibility" in asked and (seen := points.get("visibility")) is not None:
        materials["visibility"] = seen
    slots |= asked_terms | materials
    if asked - {"depth"}:  # normals, terms and maps are those of the object: they need its opacity
        slots |= view.presence
    buffer = view.blend(slots, view.others, {})

    # Frame.
    blended = buffer.slots
    blended_terms = RadianceTerms(**{name: blended[name] for name in asked_terms}).filled()
    return view.frame(
        buffer,
        normal=blended.get("normal"),
        radiance=blended["radiance"],
        terms=blended_terms if asked & {*TERMS} else None,
        maps={name: buffer.divided(name) for name in materials},
        object_alpha=blended.get(OBJECT, None if view.others else buffer.alpha),
    )


def _shade_at_pixels(view: _View) -> Frame:
    """Deferred shading: blend the attributes of the surfels, then shade the pixels."""
    scene, camera, shading = view.scene, view.camera, view.scene.shading
    # G-buffer: the model's attributes and the requested ones.
    slots = {"normal": view.points.normal} | view.points.attributes
    slots |= scene.surfels.values(view.asked - slots.keys())
    others = {SURROUNDINGS: view.others["radiance"]} if view.others else {}
    turns = scene.surfels.primitive.turns(scene.surfels, view.points.normal)
    buffer = view.blend(slots | view.presence, others, turns)

    # Points to shade: the background has no materials.
    shown = buffer.of_object()
    pixel = None if shown.pixels is None else shown.pixels.raster
    ray, index = camera.rays(pixel), camera.image_index(pixel)
    attributes = {name: shown.divided(name) for name in view.points.attributes}
    points = ShadingPoints(shown.slots["normal"], -dr.normalize(ray), attributes)
    maps = {name: buffer.divided(name) for name in scene.surfels.raw if name in slots and name != "normal"}

    # Visibility along the mirror direction, where there is something to reflect.
    at_nodes = shading.antialias and shading.traced_bounces > 0
    unshaded = at_nodes and shading.model.visibility == "mirror"  # of the centre, visibility is enough
    if shading.occlusion:
        assert scene.occluder is not None  # by `Shading.require_inputs`
        covered = dr.detach(shown.opacity) > COVERAGE_FLOOR
        context = TraceContext(scene.occluder, scene.surfels, scene.light, camera.origin, ray, covered, index)
        points = trace(points, context, replace(shading, traced_bounces=0) if unshaded else shading)

    # Radiance, premultiplied.
    light = scene.light
    if scene.near is not None:
        light = scene.light_at(camera.along(ray, shown.depth))
    shaded_at = partial(shade, light=light, shading=shading)
    if shading.antialias:

        def again(at: ShadingPoints, of: UInt32) -> ShadingPoints:
            place = of if index is None else dr.gather(mi.UInt32, index, of)
            return trace(at, replace(context, ray=-at.view, covered=True, pixel=place), shading)

        shaded = averaged(shaded_at, points, camera, shown.pixels, again if at_nodes else None)
    else:
        shaded = shaded_at(points)
    found = {name: term * shown.opacity for name, term in shaded.known().items()}
    there = dr.detach(shown.opacity) > 0
    seen = {n: dr.select(there, x, 0) for n, x in points.attributes.items() if n == "visibility"}
    found, seen = shown.placed((found, seen))
    terms = RadianceTerms(**found).filled()
    radiance = terms.total() + buffer.slots[SURROUNDINGS] if view.others else terms.total()
    own = {"normal": buffer.slots["normal"], "object_alpha": buffer.opacity, "maps": maps | seen}
    return view.frame(buffer, radiance=radiance, terms=terms, **own)
