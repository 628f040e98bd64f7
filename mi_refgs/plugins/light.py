"""Mitsuba's environment emitters as the lights of `mi_refgs.shade`."""

import warnings
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.kernels.device import upload
from mi_refgs.kernels.motion import motion_of, rotation_part
from mi_refgs.shade.light import envmap
from mi_refgs.shade.light.constant import ConstantLight
from mi_refgs.shade.light.envmap import MIN_HEIGHT, EnvironmentLight, bounded, is_height
from mi_refgs.shade.light.light import Light, RotatedLight
from mi_refgs.shade.light.lobe_matrices import resample
from mi_refgs.shade.light.prefilter import prefilter
from mi_refgs.shade.shading import Shading
from mi_refgs.types import Color3f, Float, Vector3f

MAX_HEIGHT = 512  # rows above which a map is downscaled: filtering 512 takes 45 ms on two cores
LOBES = 0.05, 0.99  # roughnesses of directional light: the closed integral loses its digits beyond them
NAMED = 8  # objects that a warning lists


def own_light(emitter: Any) -> tuple[Any, Any]:
    """A trainable copy of an `envmap` or `constant` emitter, and its `to_world`; InputError for any other."""
    params = mi.traverse(emitter)
    if "data" in params:
        radiance, _ = _map_radiance(params)
        turned = mi.Transform4f(params["to_world"])
        rotated(None, turned)  # checks it
        return EnvironmentLight.from_radiance(radiance.numpy()), turned
    return EnvironmentLight.constant(np.array(_constant_radiance(params, emitter)).ravel()), mi.Transform4f()


def emitter_light(emitter: Any, filtered: bool = True, other: Light | None = None) -> Light:
    """The light of an emitter, and the `other` if it is directional; `filtered`, or with `radiance` only;
    under AD by `scale`, `data` and `to_world`, `radiance.value`, or `irradiance.value` and `to_world`. Raises
    InputError for resampled `data` with gradients, and other emitters."""
    params = mi.traverse(emitter)
    if emitter.class_name() == "DirectionalEmitter":
        towards = -mi.Vector3f(params["to_world"] @ mi.Vector3f(0, 0, 1))
        other = other or ConstantLight(mi.Color3f(0))
        return DirectionalLight(other, dr.normalize(towards), _colour(params, emitter, "irradiance"))
    if "data" not in params:
        return ConstantLight(_constant_radiance(params, emitter))
    radiance, resampled = _map_radiance(params)
    if resampled and dr.grad_enabled(params["data"]):
        what = f"has no derivative: a map of {resampled} is resampled"
        remedy = f"use one of h x 2h, h a multiple of 4 from {MIN_HEIGHT} to {MAX_HEIGHT}"
        raise InputError(what, "mi.render", f"{emitter.id()}.data", remedy)
    light: Light = envmap.UnfilteredLight(radiance.shape[0], radiance.array)
    if filtered:
        light = envmap.PrefilteredLight(*prefilter(radiance))
    return rotated(light, params["to_world"])


@dataclass(frozen=True)
class DirectionalLight:
    """Light from one direction, beside another light: highlights and diffuse reflection, itself unseen."""

    other: Light
    towards: Vector3f  # unit, world, to the light
    arriving: Color3f  # irradiance on a surface that faces it, under AD

    def specular(self, direction: Vector3f, roughness: Float) -> Color3f:
        """Value of the normalised lobe of `lobe_matrices.lobe`, whose integral is closed."""
        α2 = dr.power(dr.clip(roughness, *LOBES), 4)
        a, b = 0.5 * (1 + α2), 0.5 * (1 - α2)
        whole = (a / α2 - 1 + dr.log(α2 / a)) / dr.square(b) * (2 * dr.pi)
        cosine = dr.dot(direction, self.towards)
        value = dr.maximum(cosine, 0) / (whole * dr.square(a - b * cosine))
        return self.other.specular(direction, roughness) + self.arriving * value

    def irradiance(self, normal: Vector3f) -> Color3f:
        cosine = dr.maximum(dr.dot(normal, self.towards), 0)
        return self.other.irradiance(normal) + self.arriving * (cosine / dr.pi)

    def radiance(self, direction: Vector3f) -> Color3f:
        return self.other.radiance(direction)


def light_of(shading: Shading, own: EnvironmentLight | None, to_world: Any, scene: Any) -> Light | None:
    """The integrator's light, else the sum of the scene's (else InputError); None if the model uses none."""
    if shading.model.light == "none":
        return None
    if (light := shading.light_of(own)) is not None:
        return rotated(light, to_world)
    found: Light | None = None
    for emitter in used_emitters(shading, scene):
        found = emitter_light(emitter, shading.model.light == "filtered", found)
    if found is None:
        what = f"refgs takes none of {_named(scene.emitters())}" if scene.emitters() else "there is none"
        raise InputError(what, "refgs", "light", "nest an `envmap` in integrator or scene")
    return found


def used_emitters(shading: Shading, scene: Any) -> list[Any]:
    """The scene's emitters that light surfels if the integrator has no light, the environment first."""
    if shading.model.light == "none":
        return []
    directional = ["DirectionalEmitter"] if shading.model.light == "filtered" else []
    found = [one for one in scene.emitters() if one.is_environment() or one.class_name() in directional]
    return sorted(found, key=lambda one: not one.is_environment())


def warn_of_ignored(scene: Any, used: list[Any]) -> None:
    """One warning that names the emitters that are not `used`, and one that names the scene's shapes."""
    unused = [emitter for emitter in scene.emitters() if not any(emitter is one for one in used)]
    for found, what, instead in (
        (unused, "use the scene's emitters", "its light is `light`, or an environment, if its model has one"),
        (scene.shapes(), "render the scene's shapes", "it renders surfels, which its `mesh` occludes"),
    ):
        if found:
            warnings.warn(f"refgs does not {what} {_named(found)}: {instead}", RuntimeWarning, stacklevel=3)


def _named(objects: list[Any]) -> str:
    names = [f"{one.class_name()} '{one.id()}'".removesuffix(" ''") for one in objects]
    more = [f"{len(objects) - NAMED} more"] if len(objects) > NAMED else []
    return ", ".join(sorted(names)[:NAMED] + more)


def rotated(light: Any, to_world: Any) -> Any:
    """The light, rotated or reflected by a mi.Transform4f, under AD as a rotation; else InputError."""
    matrix = rotation_part(to_world.matrix)
    value = np.array(to_world.matrix, dtype=np.float64).reshape(4, 4)[:3, :3]
    if not np.abs(value.T @ value - np.eye(3)).max() < 1e-4:
        raise InputError("not a rotation or reflection", "emitter", "to_world", "remove scale and shear")
    motion = motion_of(matrix) if dr.grad_enabled(matrix) else None
    if motion is None and np.abs(value - np.eye(3)).max() < 1e-7:
        return light
    return RotatedLight(light, mi.Matrix3f(np.linalg.inv(value).astype(np.float32)), motion)


def _map_radiance(params: Any) -> tuple[Any, str]:
    """Radiance (h, 2h, 3) of an `envmap` times its scale, and the size of the map if it was resampled."""
    data = params["data"]
    rows, columns, channels = (int(x) for x in data.shape)
    width = columns - 2  # Mitsuba keeps one more column on each side, for its interpolation
    texel = dr.arange(mi.UInt32, rows * width * 3)
    source = ((texel // (3 * width)) * columns + (texel // 3) % width + 1) * channels + texel % 3
    texels = dr.gather(mi.Float, data.array, source)
    resampled = not (width == 2 * rows and is_height(rows) and rows <= MAX_HEIGHT)
    shape = (rows, width, 3)
    if resampled:
        height = min(MAX_HEIGHT, max(MIN_HEIGHT, 4 * (width // 8)))
        known = mi.TensorXf(bounded(texels, texels), shape)
        texels, shape = upload(resample(known.numpy(), height)), (height, 2 * height, 3)
    radiance = texels * mi.Float(params["scale"])
    return mi.TensorXf(bounded(radiance, radiance), shape), f"{rows} x {width}" if resampled else ""


def _constant_radiance(params: Any, emitter: Any) -> Any:
    if emitter.class_name() != "ConstantBackgroundEmitter":
        what = f"emitter '{emitter.id()}': type: refgs takes no {emitter.class_name()}"
        raise InputError(what, remedy="use an `envmap` or a `constant` environment")
    return _colour(params, emitter, "radiance")


def _colour(params: Any, emitter: Any, name: str) -> Color3f:
    if f"{name}.value" not in params:
        raise InputError(f"emitter '{emitter.id()}': {name}: no colour", remedy="give an `rgb`")
    colour = mi.Color3f(params[f"{name}.value"])
    return bounded(colour, colour)
