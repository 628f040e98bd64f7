"""Arbitrary output variables (AOVs): Mitsuba's `name:type` lists, names of image channels, values."""

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import COVERAGE_FLOOR, NORM_FLOOR
from mi_refgs.errors import InputError
from mi_refgs.render.pipeline import Frame
from mi_refgs.render.samples import ray_distance
from mi_refgs.shade.points import TERMS
from mi_refgs.splat.camera import Camera
from mi_refgs.splat.composite import inverse_alpha
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.types import Float


def suffixes() -> dict[str, str]:
    """Suffixes of the image channels of every type, as of Mitsuba's own `aov` integrator."""
    materials = {name: declared.aov for name, declared in ATTRIBUTES.items() if declared.aov}
    geometry = {"normal": "XYZ", "depth": "T", "alpha": "Y", "visibility": "Y"}
    return materials | geometry | dict.fromkeys(TERMS, "RGB")


def parse_aovs(text: str) -> dict[str, str]:
    """Types, of `suffixes`, by layer name of a comma-separated list of `name:type`; else InputError."""
    aovs: dict[str, str] = {}
    for pair in filter(None, (part.strip() for part in text.split(","))):
        name, colon, kind = (part.strip() for part in pair.partition(":"))
        if not colon or not name:
            raise InputError(f"'{pair}' is not a <name>:<type> pair", "refgs", "aovs", "write 'nn:normal'")
        if kind not in suffixes():
            raise InputError(f"unknown type '{kind}'", "refgs", "aovs", f"use one of {', '.join(suffixes())}")
        if name in aovs:
            raise InputError(f"the name '{name}' occurs twice", "refgs", "aovs", "rename one of them")
        aovs[name] = kind
    return aovs


def aov_values(kind: str, frame: Frame, camera: Camera) -> list[Float]:
    """Planes of one type, as wide as the frame or 1.

    Materials, the unit normal and the visibility are means of what is seen, 0 where nothing is. Depth is the
    distance along the ray from the near plane, as Mitsuba's `depth` is. The three terms are premultiplied by
    alpha and sum to the image of the object over black. A supersampled frame was averaged premultiplied and
    divided by its mean alpha; `camera` is that of its pixels, not of the samples."""
    return _finished(kind, *_weighted(kind, frame, camera))


def aov_planes(kind: str, frame: Frame, camera: Camera) -> list[Float]:
    """Premultiplied planes of one type and their weight: means over samples, for `values_of_planes`."""
    values, weight = _weighted(kind, frame, camera)
    return [*(values if kind in PREMULTIPLIED else (value * weight for value in values)), weight]


def values_of_planes(kind: str, planes: list[Float]) -> list[Float]:
    """Planes of one type from means of `aov_planes`."""
    *values, weight = planes
    if kind not in PREMULTIPLIED:
        inverse = inverse_alpha(weight)
        values = [value * inverse for value in values]
    return _finished(kind, values, weight)


PREMULTIPLIED = (*TERMS, "alpha", "normal")  # in a frame; others are divided by alpha or the object's


def _weighted(kind: str, frame: Frame, camera: Camera) -> tuple[list[Float], Float]:
    """Planes of one type as in the frame, and the opacity of the surfels they belong to."""
    if kind in ATTRIBUTES:
        value = frame.maps[kind]
        return [*value] if len(ATTRIBUTES[kind].aov) > 1 else [value], frame.object_alpha
    if kind == "normal":
        return [*frame.normal], frame.object_alpha
    if kind == "depth":
        return [ray_distance(frame.depth, camera) if frame.distance is None else frame.distance], frame.alpha
    if kind == "alpha":
        return [frame.alpha], frame.alpha
    if kind == "visibility":
        return [frame.maps.get("visibility", mi.Float(1))], frame.object_alpha
    return [*getattr(frame.terms, kind)], frame.object_alpha


def _finished(kind: str, values: list[Float], weight: Float) -> list[Float]:
    """Planes for an image: unit normals, and 0 where nothing is seen."""
    if kind in TERMS or kind == "alpha":
        return values
    valid = weight > COVERAGE_FLOOR
    if kind == "normal":
        normal = mi.Vector3f(*values)
        length2 = dr.squared_norm(normal)
        valid &= length2 > NORM_FLOOR
        values = [*(normal * dr.rsqrt(dr.select(valid, length2, 1)))]
    return [dr.select(valid, value, 0) for value in values]
