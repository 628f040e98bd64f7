"""Interface and registry of reflectance models."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import mitsuba as mi

from mi_refgs.errors import InputError, abbreviated
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.registry import Registry
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.options import QUALITY, ShadedAt, ShadingOptions
from mi_refgs.shade.points import RadianceTerms, ShadingPoints, safe_normalize
from mi_refgs.shade.sh import clamp_positive, eval_sh
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Bool, Color3f, Float, Point3f, UInt32, Vector3f

Lookup = Literal["none", "radiance", "filtered"]
Rays = Literal["none", "mirror", "own"]

LIT = ("radiance_sh", "indirect_sh", "residual_sh")  # attributes that are fitted to one light


@dataclass(frozen=True)
class SurfelView:
    """How a camera sees N surfels, in the world frame."""

    direction: Vector3f  # (N,) unit, from the camera to each surfel
    normal: Vector3f  # (N,) unit, turned towards the camera
    sh_degree: int | None = None  # largest SH degree of radiance_sh, for coarse-to-fine schedules

    def harmonic_colour(self, coefficients: list[Color3f]) -> Color3f:
        """SH colour max(0, ½ + Σ c Y(direction)), up to `sh_degree` [3DGS, §4]."""
        if self.sh_degree is not None:
            coefficients = coefficients[: (self.sh_degree + 1) ** 2]
        return clamp_positive(eval_sh(coefficients, self.direction) + 0.5)


@dataclass(frozen=True)
class TraceContext:
    """The scene that rays from N shading points are traced in, and the primary rays to the points."""

    occluder: Occluder
    surfels: Surfels
    light: Light | None  # None if the model looks none up
    origin: Point3f  # (1,) the camera
    ray: Vector3f  # (N,) from the camera to the points, of any length
    covered: Bool = True  # (N,) or a literal; nothing is traced for the other points
    pixel: UInt32 = None  # (N,) image index that seeds the random numbers; None: 0 … N - 1

    def start(self, normal: Vector3f) -> tuple[Point3f, Vector3f, Bool]:
        """Where the primary rays meet the mesh, the unit normals there, and whether they do; detached. Not
        the blended depth, which lies inside the object at a silhouette and draws a dark outline."""
        distance, hit = self.occluder.first_hit(self.origin, self.ray, self.covered)
        return mi.Point3f(mi.Vector3f(self.origin) + distance * self.ray), safe_normalize(normal), hit


class Reflectance:
    """A reflectance model: declares its inputs and shades points, as separate terms. Register one object per
    subclass. In forward shading ("surfel"), `values` per surfel are shaded and radiance is blended; in
    deferred shading ("pixel") they are blended and shaded; traced hits have those of surfels around."""

    name: str = ""
    shaded_at: tuple[ShadedAt, ...] = ("pixel", "surfel")  # where it may be shaded, the default first
    order_independent: bool = False  # both orders give the same image; surfels are shaded, which blends less
    light: Lookup = "filtered"  # lookups that it uses: none, `radiance` only, all
    encoded: bool = False  # its radiance_sh are display-encoded colours and blended as such
    visibility: Rays = "none"  # traced rays: none, mirror rays of pixels, those of its own `trace`
    honoured: tuple[str, ...] = ()  # names of the QUALITY options that it honours

    def required_attributes(self, options: ShadingOptions) -> tuple[str, ...]:
        """Attributes beside the geometry that the surfels must have."""
        raise NotImplementedError

    def values(self, surfels: Surfels, seen: SurfelView, options: ShadingOptions) -> dict[str, Any]:
        """Values (N,) by name (mi.Float, mi.Color3f, mi.Vector3f), under AD; a "normal" replaces
        `seen.normal`. For hits of traced rays, `surfels` has only `has` and `value`."""
        raise NotImplementedError

    def shade(self, points: ShadingPoints, light: Light, options: ShadingOptions) -> RadianceTerms:
        """Outgoing radiance of points with the attributes; finite for every finite input."""
        raise NotImplementedError

    def trace(self, points: ShadingPoints, context: TraceContext, options: ShadingOptions) -> ShadingPoints:
        """The points with what rays find, called if `options.occlusion` and visibility is "own". Pixels have
        no `position`: rays from them begin at `context.start`."""
        raise NotImplementedError

    def lobe(self, points: ShadingPoints) -> tuple[Float, Color3f]:
        """Roughness and reflectance at normal incidence of the GGX lobe that `visibility_rays` sample."""
        raise NotImplementedError

    def relit(self, options: ShadingOptions) -> ShadingOptions | None:
        """The options with which the model shows a fit under another light; None: it cannot."""
        options = replace(options, diffuse="irradiance")
        lit = {*LIT}.intersection(self.required_attributes(options))
        return None if lit or self.light == "none" else options

    def textures(self, values: Mapping[str, Any]) -> dict[str, Any] | None:
        """Albedo, metallic and roughness of `split_sum` that reflect as `values`, both by name, as Dr.Jit or
        NumPy arrays; None: exports to meshes are refused."""
        return None


def require_complete(model: Reflectance) -> None:
    """Raise InputError for a model that cannot render: a method is missing, or a value does not exist."""
    traced = ("trace",) if model.visibility == "own" else ()
    sampled = ("lobe",) if "visibility_rays" in model.honoured else ()
    for name in ("required_attributes", "values", "shade", *traced, *sampled):
        if getattr(type(model), name) is getattr(Reflectance, name):
            raise InputError(f"{name} is missing", "reflectance model", model.name, "write that method")
    for name, values, allowed in (
        ("shaded_at", model.shaded_at or (None,), get_args(ShadedAt)),
        ("light", (model.light,), get_args(Lookup)),
        ("visibility", (model.visibility,), get_args(Rays)),
        ("honoured", model.honoured, QUALITY),
    ):
        if not {*values} <= {*allowed}:
            what = f"{name}: {abbreviated(getattr(model, name))} is not allowed"
            raise InputError(what, "reflectance model", model.name, f"use {' or '.join(allowed)}")
    both = {"visibility_rays", "traced_bounces"} <= {*model.honoured}
    filtered = model.light == "filtered" or not (both or "ambient_rays" in model.honoured)
    if not filtered or (model.light == "none" and "traced_bounces" in model.honoured):
        what = f"honoured: hits are not lit, since light is {model.light!r}"
        raise InputError(what, "reflectance model", model.name, "use filtered light, or honour less")


MODELS: Registry[Reflectance] = Registry("reflectance model", require_complete, of=Reflectance)
"""Every model by name. The first one that uses all attributes, or else some, is the plugin's default."""
