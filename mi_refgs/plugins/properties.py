"""The properties of the `refgs` integrator, read once while it is constructed."""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.errors import InputError, abbreviated
from mi_refgs.occlusion.mesh import Mesh, read_mesh
from mi_refgs.plugins.light import own_light
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.near_field import NearField
from mi_refgs.shade.options import DIFFUSE, QUALITY, ShadingOptions
from mi_refgs.shade.reflectance import MODELS
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.surfels.ply import read_ply
from mi_refgs.surfels.primitives.primitive import PRIMITIVES
from mi_refgs.surfels.table import Surfels

AROUND = "surroundings_"  # prefix of the parameters of the surroundings' surfels


def get(props: Any, name: str, default: Any) -> Any:
    try:
        return props.get(name, default)
    except UnicodeError as error:
        raise InputError("not UTF-8", "refgs", name, "save the scene as UTF-8") from error


def _path(props: Any, name: str) -> str | None:
    """A file property, which Mitsuba resolves beside the XML only while it constructs plugins."""
    value = get(props, name, None)
    return None if value is None else str(mi.file_resolver().resolve(str(value)))


def _choice(props: Any, name: str, default: str, options: tuple[str, ...]) -> Any:
    value = str(get(props, name, default))
    if value not in options:
        raise InputError(f"'{value}' is unknown", "refgs", name, f"use {' or '.join(options)}")
    return value


def _tensor(props: Any, name: str) -> Any:
    value = get(props, name, None)
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
        found = f"{abbreviated(value)} is not a tensor"
        raise InputError(found, "refgs", name, "give a number array") from error


def read_surfels(props: Any) -> Surfels:
    """Read the surfels of the PLY file; attributes given as tensors replace its own."""
    if raw := _attributes(props, "filename", ""):
        return Surfels(raw)
    raise InputError("there are no surfels", "refgs", "filename", "name a PLY file, or give tensors")


def _attributes(props: Any, file: str, prefix: str) -> dict[str, Any]:
    """Raw attributes of the file that a property names, and of tensors named `prefix` + attribute."""
    path = _path(props, file)
    raw = {} if path is None else dict(read_ply(path).raw)
    given = {name: _tensor(props, prefix + name) for name in ATTRIBUTES}
    return raw | {name: value for name, value in given.items() if value is not None}


def read_background(props: Any) -> tuple[Surfels | None, Any]:
    """Read the surfels around the object, or None, and what is behind everything: an EnvironmentLight,
    mi.Color3f, or None for transparency."""
    raw = _attributes(props, "surroundings", AROUND)
    names = {"radiance_sh", *(n for primitive in PRIMITIVES.values() for n in primitive.widths)}
    around = Surfels({n: tensor for n, tensor in raw.items() if n in names}) if raw else None
    value = get(props, "background", None)
    if isinstance(value, str):
        return around, EnvironmentLight.from_file(_path(props, "background") or "")
    if getattr(value, "ndim", 0) == 3:
        return around, EnvironmentLight(mi.TensorXf(value))
    try:
        colour = None if value is None else mi.Color3f(value)
        if colour is None or dr.all(dr.isfinite(colour), axis=None):
            return around, colour
        raise ValueError
    except Exception as error:
        found = f"{abbreviated(value)} is no colour"
        raise InputError(found, "refgs", "background", "give an rgb value or a map") from error


def read_light(props: Any) -> tuple[Any, Any, NearField | None]:
    """Read the integrator's own EnvironmentLight, or None, its `to_world` (see `own_light`), and the
    distances of what it shows; None: infinitely far."""
    path = _path(props, "near_field")
    near = None if path is None else NearField.read(path)
    nested = dict(props.objects())
    emitters = [child for child in nested.values() if isinstance(child, mi.Emitter)]
    for name, child in nested.items():
        if not isinstance(child, mi.Emitter):
            what = f"refgs takes no {type(child).__name__}"
            raise InputError(what, "refgs", name, "nest it in the scene, or remove it")
    if len(emitters) > 1:
        raise InputError("two emitters are nested in the integrator", "refgs", "light", "keep one")
    if emitters:
        return *own_light(emitters[0]), near
    raw = _tensor(props, "light")
    return None if raw is None else EnvironmentLight(raw), mi.Transform4f(), near


def read_shading(props: Any, surfels: Surfels) -> tuple[Shading, Mesh | None]:
    """Read the shading, whose defaults fit the attributes, and the mesh."""
    reflectance = str(get(props, "reflectance", Shading.default(surfels.raw)[0]))
    MODELS.find(reflectance, "refgs: reflectance")
    diffuse = _choice(props, "diffuse", Shading.default(surfels.raw, [reflectance])[1], DIFFUSE)
    at: Any = _choice(props, "shade_at", MODELS[reflectance].shaded_at[0], ("pixel", "surfel"))
    mesh = _path(props, "mesh")
    shading = Shading(at, reflectance, diffuse)
    occlusion = get(props, "occlusion", mesh is not None)
    quality = {name: get(props, name, getattr(ShadingOptions, name)) for name in QUALITY}
    shading = replace(shading, occlusion=occlusion, **quality)
    return shading, None if mesh is None else read_mesh(mesh)
