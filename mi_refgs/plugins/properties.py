"""The properties of the `refgs` integrator, read once while it is made.

No Mitsuba class is defined here, so that this module need not be reloaded when the variant changes.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import mitsuba as mi

from mi_refgs.errors import InputError
from mi_refgs.occlusion.mesh import read_mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.plugins.light import own_light
from mi_refgs.render.pipeline import MATERIALS, Shading
from mi_refgs.shade.envmap import EnvironmentLight
from mi_refgs.shade.models import Accuracy
from mi_refgs.surfels.ply import read_ply
from mi_refgs.surfels.table import CHANNELS, Surfels

TERMS = ("diffuse", "specular", "indirect")


def _path(props: Any, name: str) -> str | None:
    """A file property, found beside the XML first; Mitsuba knows that folder only while it makes plugins."""
    value = props.get(name, None)
    return None if value is None else str(mi.file_resolver().resolve(str(value)))


def _choice(props: Any, name: str, default: str, options: tuple[str, ...]) -> Any:
    value = str(props.get(name, default))
    if value not in options:
        raise InputError(f"refgs: {name}: '{value}' is unknown; use {' or '.join(options)}")
    return value


def read_surfels(props: Any) -> Surfels:
    """The table of the PLY file, with channels replaced by those given as tensors."""
    path = _path(props, "filename")
    raw = {} if path is None else dict(read_ply(path).raw)
    for name in CHANNELS:
        value = props.get(name, None)
        if value is not None:
            raw[name] = mi.TensorXf(value)
    if not raw:
        raise InputError(
            "refgs: filename: there are no surfels; name a PLY file, or give the channels as tensors"
        )
    return Surfels(raw)


def read_light(props: Any) -> tuple[Any, Any]:
    """The integrator's own EnvironmentLight and its rotation (see `own_light`), or None twice."""
    emitters = [child for _, child in props.objects() if isinstance(child, mi.Emitter)]
    if len(emitters) > 1:
        raise InputError("refgs: light: two emitters are nested in the integrator; keep one")
    if emitters:
        return own_light(emitters[0])
    raw = props.get("light", None)
    return (None, None) if raw is None else (EnvironmentLight(mi.TensorXf(raw)), None)


def read_shading(props: Any, surfels: Surfels) -> tuple[Shading, Occluder | None]:
    """How to shade, by defaults that fit the channels; and the occluder if that traces visibility."""
    materials = all(surfels.has(name) for name in MATERIALS)
    default = "split_sum" if materials else "radiance"
    reflectance = _choice(props, "reflectance", default, ("split_sum", "radiance"))
    default = "sh" if surfels.has("radiance_sh") or reflectance == "radiance" else "irradiance"
    diffuse = _choice(props, "diffuse", default, ("sh", "irradiance"))
    at: Any = _choice(props, "shade_at", "pixel", ("pixel", "surfel"))
    mesh = _path(props, "mesh")
    deferred = at == "pixel" and reflectance == "split_sum"
    occlusion = bool(props.get("occlusion", mesh is not None and deferred))
    shading = Shading(at, reflectance, diffuse, occlusion, _accuracy(props))
    shading.check(surfels.raw, mesh=mesh is not None)
    if not (occlusion and mesh):
        return shading, None
    occluder = Occluder(read_mesh(mesh))
    if shading.accuracy.traced_bounces:
        occluder.set_materials(surfels)
    return shading, occluder


def _accuracy(props: Any) -> Accuracy:
    """The knobs that buy accuracy, of which `Accuracy` refuses what is no bool or no number."""
    return Accuracy(**{knob.name: props.get(knob.name, knob.default) for knob in fields(Accuracy)})


def read_terms(props: Any) -> list[str]:
    """The terms that the image sums, by their names in `shade.models.Terms`."""
    text = str(props.get("terms", ",".join(TERMS)))
    names = [name.strip() for name in text.split(",") if name.strip()]
    for name in names:
        if name not in TERMS or names.count(name) > 1:
            raise InputError(f"refgs: terms: '{name}' is unknown or repeated; use some of {', '.join(TERMS)}")
    return names
