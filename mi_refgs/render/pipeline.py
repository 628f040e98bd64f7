"""Surfels to image, in the two orders that every method is made of.

    shade at surfels:  attributes ─ shade ─► radiance channel ─ blend ─► image
    shade at pixels:   attributes ─ blend ─► G-buffer ─ shade ─► image

The same `splat` and the same `shade` serve both. Everything is traced by Dr.Jit; the derivatives that are
absent on purpose are those of `splat.blend`, the visibility, the side to which a normal is turned, and the
camera.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args, get_type_hints

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import COVERAGE_FLOOR, FACING_TOLERANCE
from mi_refgs.errors import InputError, shown
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.primitives import primitive_of, widths_of
from mi_refgs.render.reflection import reflection
from mi_refgs.shade.models import Accuracy, ShadingPoints, Terms, reflect, safe_normalize, shade
from mi_refgs.shade.sh import clamp_positive, eval_sh
from mi_refgs.splat import Blended, Camera, splat
from mi_refgs.surfels.table import LOGIT_LIMIT, Surfels
from mi_refgs.timing import boundary, phase

MATERIALS = ("albedo", "metallic", "roughness")
"""Channels of what is shaded by a light."""


_shade = phase("shade forward")(shade)


@dataclass(frozen=True)
class Shading:
    """How a method turns surfels into radiance: data, chosen per stage. The one place of its rules.

    Radiance is blended linearly, so that the two orders are one for reflectance "radiance"; `at` is then
    "surfel", which blends less. Raises InputError for what is not allowed together.
    """

    at: Literal["surfel", "pixel"] = "pixel"  # shade before or after blending
    reflectance: Literal["radiance", "split_sum"] = "split_sum"  # SH colour alone, or diffuse + GGX specular
    diffuse: Literal["sh", "irradiance"] = "sh"  # view-dependent SH colour, or of albedo and light
    occlusion: bool = False  # trace visibility along the mirror direction, and fill with the indirect channel
    accuracy: Accuracy = field(default_factory=Accuracy)  # what to pay for less error; rays need occlusion

    def __post_init__(self) -> None:
        """Raise InputError, or TypeError for an unknown key of `accuracy`, for what JSON may hold."""
        if isinstance(self.accuracy, Mapping):  # as JSON keeps it
            object.__setattr__(self, "accuracy", Accuracy(**self.accuracy))
        for name, kind in get_type_hints(Shading).items():
            value, allowed = getattr(self, name), get_args(kind)
            if not (value in allowed if allowed else isinstance(value, kind)):
                raise InputError(f"shading: {name}: {shown(value)} is not allowed; correct it")
        if self.reflectance == "radiance":
            object.__setattr__(self, "at", "surfel")
        accuracy = self.accuracy
        if self.occlusion and self.at != "pixel":
            raise InputError(
                "shading: occlusion: needs shade_at = pixel and reflectance = split_sum; set these"
            )
        if (accuracy.dominant or accuracy.multiscatter) and self.reflectance != "split_sum":
            raise InputError("shading: dominant, multiscatter: need reflectance = split_sum; set it")
        if (accuracy.visibility_rays > 1 or accuracy.traced_bounces) and not self.occlusion:
            raise InputError("shading: visibility_rays, traced_bounces: need occlusion; trace a `mesh`")

    @staticmethod
    def of(stage: Any, mesh: bool) -> Shading:
        """The shading of a stage (`at`, `reflectance`, `diffuse`); occluded if pixels are shaded and a `mesh`
        is there."""
        shading = Shading(stage.at, stage.reflectance, stage.diffuse)
        return replace(shading, occlusion=mesh and shading.at == "pixel")

    def check(self, channels: Collection[str], light: bool = True, mesh: bool = True) -> None:
        """Raise InputError if surfels with these channels, and what is there beside them, lack something."""
        needed: list[str] = []
        if self.reflectance == "split_sum":
            needed += MATERIALS
        if self.reflectance == "radiance" or self.diffuse == "sh":
            needed += ["radiance_sh"]
        for name in needed:
            if name not in channels:
                raise InputError(
                    f"shading: {name}: the surfels have no such channel; add it, or do without it"
                )
        if self.reflectance == "split_sum" and not light:
            raise InputError(
                "shading: light: reflectance = split_sum needs one; add it, or set reflectance = radiance"
            )
        if self.occlusion and not mesh:
            raise InputError("shading: occlusion: there is no mesh to trace; give one, or trace nothing")


@dataclass(frozen=True)
class Frame:
    """One rendered view: mi arrays of H·W values in raster order.

    Radiance and its terms are linear and premultiplied by alpha; maps are divided by it and 0 where nothing
    is seen.
    """

    alpha: Any  # accumulated opacity
    depth: Any  # expected camera-z depth, 0 where nothing is seen
    normal: Any  # mi.Vector3f: blended world normal towards the camera, not normalised
    radiance: Any  # mi.Color3f, over black
    terms: Terms | None = None  # diffuse, specular, indirect, whose sum it is, where known apart
    maps: dict[str, Any] = field(default_factory=dict)  # albedo, metallic, roughness, visibility where known


def render(
    surfels: Surfels,
    camera: Camera,
    shading: Shading,
    light: Any = None,
    occluder: Occluder | None = None,
    sh_degree: int | None = None,
    shift: Any = None,
    aovs: bool = False,
) -> Frame:
    """Render a view.

    `light` is a `shade.PrefilteredLight`, needed unless `shading.reflectance` is "radiance". `sh_degree`
    limits the degree of the radiance channel, for coarse-to-fine schedules. `aovs` asks for albedo, metallic,
    roughness and the terms of the radiance even where the picture does not need them per pixel.
    `shift`: see `splat.project`.
    `shading.accuracy.traced_bounces` needs an occluder whose `set_materials` has seen these surfels.
    Raises InputError for what `shading.check` refuses.
    """
    primitive_of(widths_of(surfels.raw))
    shading.check(surfels.raw, light is not None, occluder is not None)
    if surfels.count == 0:
        surfels, shift = _nothing(surfels), None
    if shading.at == "surfel":
        frame = _shade_at_surfels(surfels, camera, shading, light, sh_degree, shift, aovs)
    else:
        frame = _shade_at_pixels(surfels, camera, shading, light, occluder, sh_degree, shift)
    return boundary(frame, "shade backward")


def render_depth(surfels: Surfels, camera: Camera) -> tuple[Any, Any]:
    """Expected camera-z depth (0 where nothing is seen) and alpha of a view, and nothing else."""
    blended = splat(surfels, [], camera)
    return blended.depth * _inverse_alpha(blended), blended.alpha


def _nothing(surfels: Surfels) -> Surfels:
    """One surfel that no camera sees, with the channels of an empty table: Dr.Jit refuses empty arrays."""
    unseen = {"opacity": -LOGIT_LIMIT}
    return Surfels(
        {n: dr.full(mi.TensorXf, unseen.get(n, 0), (1, int(x.shape[1]))) for n, x in surfels.raw.items()}
    )


# ---------------- attributes of surfels ----------------


def _facing(surfels: Surfels, camera: Camera) -> tuple[Any, Any]:
    """Unit direction from the camera to each surfel, and its normal turned towards the camera.

    A normal that points away by less than FACING_TOLERANCE stays: such a surfel lies just behind a
    silhouette, and shows there through the low-pass; turned round it would oppose its neighbours and leave
    the outline without a normal.
    """
    # A surfel at the camera's own position has no direction; it is culled, so any will do.
    direction = safe_normalize(camera.towards(surfels.position()))
    normal = surfels.primitive.normal(surfels)
    return direction, dr.select(dr.detach(dr.dot(normal, direction)) > FACING_TOLERANCE, -normal, normal)


def _radiance(surfels: Surfels, direction: Any, sh_degree: int | None) -> Any:
    """SH colour max(0, ½ + Σ c Y(direction)) [3DGS, §4]."""
    coefficients = surfels.radiance_sh()
    if sh_degree is not None:
        coefficients = coefficients[: (sh_degree + 1) ** 2]
    return clamp_positive(eval_sh(coefficients, direction) + 0.5)


def _materials(surfels: Surfels) -> list[Any]:
    return [*surfels.albedo(), surfels.metallic(), surfels.roughness()]


# ---------------- the two orders ----------------


def _shade_at_surfels(
    surfels: Surfels,
    camera: Camera,
    shading: Shading,
    light: Any,
    sh_degree: int | None,
    shift: Any,
    aovs: bool,
) -> Frame:
    direction, normal = _facing(surfels, camera)
    if shading.reflectance == "radiance":
        terms = Terms(_radiance(surfels, direction, sh_degree), *[dr.zeros(mi.Color3f, 1)] * 2)
    else:
        points = ShadingPoints(
            normal=normal,
            view=-direction,
            albedo=surfels.albedo(),
            metallic=surfels.metallic(),
            roughness=surfels.roughness(),
            radiance=_radiance(surfels, direction, sh_degree) if shading.diffuse == "sh" else None,
        )
        terms = _shade(points, light, shading.diffuse, shading.accuracy)
    # A feature costs time in every pair, so what is not asked for is not blended.
    features = [*terms.total(), *normal]
    if aovs:
        features += [*terms.diffuse, *terms.specular]
    show_materials = aovs and surfels.has("albedo")
    if show_materials:
        features += _materials(surfels)
    blended = splat(surfels, features, camera, shift)

    inverse = _inverse_alpha(blended)
    maps = blended.features
    apart = Terms(mi.Color3f(*maps[6:9]), mi.Color3f(*maps[9:12]), dr.zeros(mi.Color3f, 1)) if aovs else None
    return Frame(
        alpha=blended.alpha,
        depth=blended.depth * inverse,
        normal=mi.Vector3f(*maps[3:6]),
        radiance=mi.Color3f(*maps[0:3]),
        terms=apart,
        maps=_material_maps(maps[12:17], inverse) if show_materials else {},
    )


def _shade_at_pixels(
    surfels: Surfels,
    camera: Camera,
    shading: Shading,
    light: Any,
    occluder: Occluder | None,
    sh_degree: int | None,
    shift: Any,
) -> Frame:
    direction, normal = _facing(surfels, camera)
    features = [*normal, *_materials(surfels)]
    if shading.diffuse == "sh":
        features += [*_radiance(surfels, direction, sh_degree)]
    if shading.occlusion and surfels.has("indirect_sh") and not shading.accuracy.traced_bounces:
        # The mirror direction of the surfel's centre [Ref-Gaussian, §3.3]; starts at exactly 0 and must train
        # from there.
        mirrored = reflect(view=-direction, normal=normal)
        features += [*clamp_positive(eval_sh(surfels.indirect_sh(), mirrored))]
    blended = splat(surfels, features, camera, shift)

    inverse = _inverse_alpha(blended)
    normal = mi.Vector3f(*blended.features[0:3])
    maps = _material_maps(blended.features[3:8], inverse)
    rest = [x * inverse for x in blended.features[8:]]
    radiance = None
    if shading.diffuse == "sh":
        radiance, rest = mi.Color3f(*rest[:3]), rest[3:]
    depth = blended.depth * inverse
    ray = camera.rays()
    view = -dr.normalize(ray)
    points = ShadingPoints(
        normal=normal,
        view=view,
        albedo=maps["albedo"],
        metallic=maps["metallic"],
        roughness=maps["roughness"],
        radiance=radiance,
        indirect=mi.Color3f(*rest) if rest else None,
    )
    if shading.occlusion:
        assert occluder is not None  # see `Shading.check`
        covered = dr.detach(blended.alpha) > COVERAGE_FLOOR
        points = reflection(
            occluder, surfels, light, shading.accuracy, shading.diffuse, camera.origin, ray, points, covered
        )
        maps["visibility"] = points.visibility
    shaded = _shade(points, light, shading.diffuse, shading.accuracy)
    terms = Terms(*(term * blended.alpha for term in (shaded.diffuse, shaded.specular, shaded.indirect)))
    return Frame(
        alpha=blended.alpha,
        depth=depth,
        normal=normal,
        radiance=terms.total(),
        terms=terms,
        maps=maps,
    )


def _inverse_alpha(blended: Blended) -> Any:
    """1/A where anything is seen, else 0, with a finite gradient everywhere."""
    seen = blended.alpha > COVERAGE_FLOOR
    return dr.select(seen, dr.rcp(dr.select(seen, blended.alpha, 1)), 0)


def _material_maps(features: list[Any], inverse: Any) -> dict[str, Any]:
    albedo = mi.Color3f(*(x * inverse for x in features[0:3]))
    return {"albedo": albedo, "metallic": features[3] * inverse, "roughness": features[4] * inverse}
