"""Input and output of reflectance models: points to shade, and named terms of outgoing radiance."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import NORM_FLOOR
from mi_refgs.errors import InputError
from mi_refgs.types import Vector3f


@dataclass(init=False, eq=False)
class ShadingPoints:
    """N points to shade: normal, view and the attributes that a model names, all arrays of width N.

    `normal` and `view`, towards the camera (mi.Vector3f), are in the world frame and of any length. Further
    attributes are read as `points.roughness` (InputError without it), or by `get`. For every model,
    `visibility` (mi.Float, 0 … 1) is that of the light in the reflected direction, `indirect` (mi.Color3f)
    the radiance from there where it is blocked, and `position` (mi.Point3f) where rays start in the world."""

    normal: Any
    view: Any
    attributes: dict[str, Any]  # by name

    def __init__(
        self, normal: Any, view: Any, attributes: Mapping[str, Any] | None = None, **named: Any
    ) -> None:
        self.normal, self.view = normal, view
        given = {**(attributes or {}), **named}
        self.attributes = {name: value for name, value in given.items() if value is not None}

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "attributes":
            raise AttributeError(name)
        if name not in self.attributes:
            raise InputError("missing", "shade", name, "the reflectance model needs it, so add it")
        return self.attributes[name]

    def get(self, name: str, otherwise: Any = None) -> Any:
        """An attribute, or another value if the points do not have it."""
        return self.attributes.get(name, otherwise)

    def replaced(self, **attributes: Any) -> "ShadingPoints":
        """The same points with these attributes; None removes one."""
        return ShadingPoints(self.normal, self.view, self.attributes, **attributes)


@dataclass(frozen=True)
class RadianceTerms:
    """Outgoing radiance (mi.Color3f) as terms, None for those that do not exist; the image is their sum."""

    diffuse: Any = None
    specular: Any = None
    indirect: Any = None

    def known(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in TERMS if getattr(self, name) is not None}

    def total(self) -> Any:
        return sum(self.known().values(), mi.Color3f(0))

    def filled(self) -> "RadianceTerms":
        """The same, with zeros for terms that do not exist."""
        return RadianceTerms(**{name: dr.zeros(mi.Color3f, 1) for name in TERMS} | self.known())


TERMS = ("diffuse", "specular", "indirect")  # names of the terms


def safe_normalize(v: Vector3f) -> Vector3f:
    """v / |v|, and (0, 0, 1) with zero gradient where |v|² < NORM_FLOOR."""
    # Scaling by the largest component first keeps the square of a huge or tiny vector inside float32.
    largest = dr.detach(dr.maximum(dr.maximum(dr.abs(v.x), dr.abs(v.y)), dr.abs(v.z)))
    valid = largest > NORM_FLOOR**0.5
    scaled = dr.select(valid, v * dr.rcp(dr.select(valid, largest, 1)), mi.Vector3f(0, 0, 1))
    return scaled * dr.rsqrt(dr.squared_norm(scaled))


def reflect(view: Vector3f, normal: Vector3f) -> Vector3f:
    """Mirror direction 2 (n·v) n - v of unit vectors that both point away from the surface."""
    return dr.fma(2 * dr.dot(normal, view), normal, -view)
