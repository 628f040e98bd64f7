"""The properties of the `refgs` integrator, read once while it is made.

No Mitsuba class is defined here, so that this module need not be reloaded when the variant changes.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi

from mi_refgs.errors import InputError, abbreviated
from mi_refgs.occlusion.mesh import read_mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.plugins.aovs import AOV, parse_aovs
from mi_refgs.plugins.light import own_light
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.options import DIFFUSE, QUALITY, ShadingOptions
from mi_refgs.shade.points import TERMS
from mi_refgs.shade.reflectance import MODELS
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.surfels.ply import read_ply
from mi_refgs.surfels.table import Surfels

AROUND = "surroundings_"
"""What the names of the surroundings' channels begin with."""


def _get(props: Any, name: str, default: Any) -> Any:
    """A property, or the default where it is absent."""
    try:
        return props.get(name, default)
    except UnicodeError as error:
        raise InputError(f"refgs: {name}: not UTF-8; save the scene as UTF-8") from error


def read_aovs(props: Any) -> list[AOV]:
    """The maps that are asked for besides the image."""
    return parse_aovs(str(_get(props, "aovs", "")))


def _path(props: Any, name: str) -> str | None:
    """A file property, searched beside the XML first; Mitsuba searches there only while it makes plugins."""
    value = _get(props, name, None)
    return None if value is None else str(mi.file_resolver().resolve(str(value)))


def _choice(props: Any, name: str, default: str, options: tuple[str, ...]) -> Any:
    value = str(_get(props, name, default))
    if value not in options:
        raise InputError(f"refgs: {name}: '{value}' is unknown; use {' or '.join(options)}")
    return value


def _flag(props: Any, name: str, default: bool) -> bool:
    value = _get(props, name, default)
    if not isinstance(value, bool):
        raise InputError(f"refgs: {name}: {abbreviated(value)} is neither true nor false; give a boolean")
    return value


def _tensor(props: Any, name: str) -> Any:
    """A tensor property as mi.TensorXf; None where it is absent."""
    value = _get(props, name, None)
    if value is None:
        return None
    try:
        if isinstance(value, str):  # Dr.Jit looks for the numbers of a string without end
            raise TypeError("a string")
        tensor = mi.TensorXf(value)
        if not tensor.ndim:
            raise TypeError("a single number")
        return tensor
    except Exception as error:  # what Dr.Jit raises depends on the type
        raise InputError(
            f"refgs: {name}: {abbreviated(value)} is not a tensor; give a number array"
        ) from error


def read_background(props: Any) -> Any:
    """What is behind everything: a colour (mi.Color3f), an EnvironmentLight, or None: transparent."""
    value = _get(props, "background", None)
    if isinstance(value, str):
        try:
            return EnvironmentLight.from_file(Path(_path(props, "background") or ""))
        except InputError as error:
            raise InputError(f"refgs: background: {error}") from error
    try:
        if getattr(value, "ndim", 0) == 3:
            return EnvironmentLight(mi.TensorXf(value))
        return None if value is None else mi.Color3f(value)
    except InputError:
        raise
    except Exception as error:
        raise InputError(
            f"refgs: background: {abbreviated(value)} is no colour; give an rgb value or a map"
        ) from error


def read_surfels(props: Any) -> Surfels:
    """The table of the PLY file, with channels replaced by those given as tensors."""
    raw = _channels(props, "filename", "")
    if not raw:
        raise InputError(
            "refgs: filename: there are no surfels; name a PLY file, or give the channels as tensors"
        )
    return Surfels(raw)


def read_surroundings(props: Any, surfels: Surfels) -> Surfels | None:
    """The surfels around the object, of a PLY file or tensors likewise; None without either."""
    raw = _channels(props, "surroundings", AROUND)
    if not raw:
        return None
    found = Surfels({name: raw[name] for name in (*surfels.primitive.widths, "radiance_sh") if name in raw})
    Surroundings(found).check(surfels)
    return found


def _channels(props: Any, file: str, prefix: str) -> dict[str, Any]:
    """Raw channels of the PLY file that a property names, and those given as tensors, `prefix` + name."""
    path = _path(props, file)
    raw = {} if path is None else dict(read_ply(path).raw)
    for name in ATTRIBUTES:
        value = _tensor(props, prefix + name)
        if value is not None:
            raw[name] = value
    return raw


def read_light(props: Any) -> tuple[Any, Any]:
    """The integrator's own EnvironmentLight and its rotation (see `own_light`), or None twice."""
    emitters = [child for _, child in props.objects() if isinstance(child, mi.Emitter)]
    if len(emitters) > 1:
        raise InputError("refgs: light: two emitters are nested in the integrator; keep one")
    if emitters:
        return own_light(emitters[0])
    raw = _tensor(props, "light")
    return (None, None) if raw is None else (EnvironmentLight(raw), None)


def read_shading(props: Any, surfels: Surfels) -> tuple[Shading, Occluder | None]:
    """How to shade, by defaults that fit the channels; and the occluder if that traces visibility."""
    default = Shading.default_reflectance(surfels.raw)
    reflectance = _choice(props, "reflectance", default, tuple(MODELS))
    diffuse = _choice(props, "diffuse", Shading.default_diffuse(reflectance, surfels.raw), DIFFUSE)
    at: Any = _choice(props, "shade_at", MODELS[reflectance].orders[0], ("pixel", "surfel"))
    mesh = _path(props, "mesh")
    shading = Shading(at, reflectance, diffuse)
    occlusion = _flag(props, "occlusion", mesh is not None and shading.traceable)
    quality = {name: _get(props, name, getattr(ShadingOptions, name)) for name in QUALITY}
    shading = replace(shading, occlusion=occlusion, **quality)
    shading.require_inputs(surfels.raw, mesh=mesh is not None)
    if not (occlusion and mesh):
        return shading, None
    return shading, Occluder(read_mesh(mesh))


def read_terms(props: Any) -> list[str]:
    """The terms that the image sums, by name."""
    text = str(_get(props, "terms", ",".join(TERMS)))
    names = [name.strip() for name in text.split(",") if name.strip()]
    for name in names:
        if name not in TERMS or names.count(name) > 1:
            raise InputError(f"refgs: terms: '{name}' is unknown or repeated; use some of {', '.join(TERMS)}")
    if not names:
        raise InputError(f"refgs: terms: {abbreviated(text)} names none; use some of {', '.join(TERMS)}")
    return names
