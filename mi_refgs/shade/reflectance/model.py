"""The seam of reflectance models: what one declares, and the registry of all."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal, get_args

from mi_refgs.errors import InputError, abbreviated
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.shade.accuracy import Accuracy
from mi_refgs.shade.points import RadianceTerms, ShadingPoints
from mi_refgs.shade.sh import clamp_positive, eval_sh
from mi_refgs.shade.visibility import mirror_visibility
from mi_refgs.surfels.table import Surfels

if TYPE_CHECKING:
    from mi_refgs.shade.shading import Shading

Order = Literal["pixel", "surfel"]
Lookup = Literal["none", "radiance", "filtered"]
Rays = Literal["none", "mirror", "own"]


@dataclass(frozen=True)
class SurfelView:
    """How a camera sees the surfels: arrays of width N, world frame."""

    direction: Any  # mi.Vector3f, unit, from the camera to each surfel
    normal: Any  # mi.Vector3f, unit, turned towards the camera
    sh_degree: int | None = None  # limit of the radiance channel's degree, for coarse-to-fine schedules

    def harmonic_colour(self, coefficients: list[Any]) -> Any:
        """SH colour max(0, ½ + Σ c Y(direction)), up to `sh_degree` [3DGS, §4]."""
        if self.sh_degree is not None:
            coefficients = coefficients[: (self.sh_degree + 1) ** 2]
        return clamp_positive(eval_sh(coefficients, self.direction) + 0.5)


@dataclass(frozen=True)
class TraceContext:
    """What rays from shaded points may meet, and where the points come from."""

    occluder: Occluder
    surfels: Surfels
    light: Any  # a `light.Light`
    origin: Any  # mi.Point3f: the camera; at surfels, their positions
    ray: Any  # mi.Vector3f from `origin` to the points, not unit; at surfels, from the camera to them
    covered: Any = True  # mi.Bool: nothing is traced for the others
    pixel: Any = None  # mi.UInt32: index in the picture, which random numbers depend on; None: their own


class Reflectance:
    """A reflectance model: a subclass declares what it needs and turns points into terms of radiance.

    One object of it is `register`ed. Attributes are the named values that a model computes for each surfel:
    at "surfel" they are shaded, and radiance is blended; at "pixel" they are blended as slots of the
    G-buffer, divided by alpha, and shaded.
    """

    name: str = ""
    orders: tuple[Order, ...] = ("pixel", "surfel")  # where it may be shaded, the usual one first
    order_independent: bool = False  # both orders give the same image; surfels are shaded, which blends less
    light: Lookup = "filtered"  # lookups: none, `radiance` alone, all
    encoded: bool = False  # its radiance_sh are colours as a display shows them, and blended as such
    visibility: Rays = "none"  # rays: none, of pixels in mirrors, by `trace`
    accuracy: tuple[str, ...] = ()  # options of `Accuracy` that it honours

    @property
    def honours(self) -> tuple[str, ...]:
        """Options of `Accuracy` that change something: its own, and the levels of a light that it filters."""
        return (*self.accuracy, "light_levels") if self.light == "filtered" else self.accuracy

    def channels(self, diffuse: str) -> tuple[str, ...]:
        """Channels beside the geometry that the surfels must have, for a choice of `Shading.diffuse`."""
        raise NotImplementedError

    def attributes(self, surfels: Surfels, seen: SurfelView, shading: Shading) -> dict[str, Any]:
        """Values of width N by name (mi.Float, mi.Color3f or mi.Vector3f), under AD.

        A "normal" among them replaces the surfel's own, `seen.normal`.
        """
        raise NotImplementedError

    def shade(self, points: ShadingPoints, light: Any, shading: Shading) -> RadianceTerms:
        """Outgoing radiance of points with the attributes, under a `light.Light`.

        Finite for every finite input.
        """
        raise NotImplementedError

    def trace(self, points: ShadingPoints, context: TraceContext, shading: Shading) -> ShadingPoints:
        """The points with what rays find, where `shading.occlusion` asks for it: here the visibility of the
        mirror direction."""
        visibility = mirror_visibility(
            context.occluder, context.origin, context.ray, points.normal, points.view, context.covered
        )
        return points.replaced(visibility=visibility)


MODELS: dict[str, Reflectance] = {}
"""Every model by name. The first one whose channels the surfels have is the plugin's default."""


def register(model: Reflectance) -> Reflectance:
    """Make a model known to method files, the plugin and `Shading`; returns it.

    Raises InputError without a name, if another model has it, and for a model that cannot render: a method is
    missing, or an attribute has a value that does not exist.
    """
    if not isinstance(model, Reflectance):
        raise InputError(
            f"reflectance: {abbreviated(model)} is no model; give an object of a subclass of Reflectance"
        )
    if not model.name or model.name in MODELS:
        raise InputError(f"reflectance: '{model.name}': no name, or another model's; rename the model")
    traced = ("trace",) if model.visibility == "own" else ()
    for name in ("channels", "attributes", "shade", *traced):
        if getattr(type(model), name) is getattr(Reflectance, name):
            raise InputError(f"reflectance: {model.name}: {name} is missing; write that method")
    for name, allowed in (
        ("orders", get_args(Order)),
        ("light", get_args(Lookup)),
        ("visibility", get_args(Rays)),
        ("accuracy", [option.name for option in fields(Accuracy)]),
    ):
        value = getattr(model, name)
        values = value if name in ("orders", "accuracy") else (value,)
        if not {*values} <= {*allowed} or (name == "orders" and not values):
            choices = " or ".join(allowed)
            raise InputError(
                f"reflectance: {model.name}: {name}: {abbreviated(value)} is not allowed; use {choices}"
            )
    MODELS[model.name] = model
    return model


def unregister(name: str) -> None:
    """Forget a registered model."""
    del MODELS[name]
