"""Mitsuba's environment emitters as the lights of `mi_refgs.shade`."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.kernels.device import upload
from mi_refgs.shade.light.constant import ConstantLight
from mi_refgs.shade.light.envmap import (
    DEFAULT_HEIGHT,
    MIN_HEIGHT,
    EnvironmentLight,
    PrefilteredLight,
    UnfilteredLight,
    bounded,
    is_height,
)
from mi_refgs.shade.light.light import Light, RotatedLight
from mi_refgs.shade.light.lobe_matrices import resample
from mi_refgs.shade.light.prefilter import prefilter
from mi_refgs.shade.shading import Shading

MAX_HEIGHT = 512  # rows above which a map is downscaled: filtering 512 takes 45 ms on two cores


def own_light(emitter: Any) -> tuple[Any, Any]:
    """A trainable copy of an `envmap` or `constant` emitter and its rotation; InputError for any other."""
    params = mi.traverse(emitter)
    if "data" in params:
        radiance, _ = _map_radiance(params, emitter)
        return EnvironmentLight.from_radiance(radiance.numpy()), _light_from_world(params)
    colour = np.array(_constant_radiance(params, emitter)).ravel()
    return EnvironmentLight.from_radiance(np.tile(colour, (DEFAULT_HEIGHT, 2 * DEFAULT_HEIGHT, 1))), None


def emitter_light(emitter: Any, filtered: bool = True) -> Light:
    """The light of an emitter, `filtered` or with `radiance` only, under AD: gradients flow to `scale` and
    `data`, or `radiance.value`. Raises InputError for resampled `data` with gradients, and other emitters."""
    params = mi.traverse(emitter)
    if "data" not in params:
        return ConstantLight(_constant_radiance(params, emitter))
    radiance, resampled = _map_radiance(params, emitter)
    if resampled and dr.grad_enabled(params["data"]):
        raise InputError(
            f"emitter '{emitter.id()}': data: a map of {resampled} has no derivative",
            remedy=f"use one of h x 2h, h a multiple of 4 from {MIN_HEIGHT} to {MAX_HEIGHT}",
        )
    light: Light = UnfilteredLight(radiance.shape[0], radiance.array)
    if filtered:
        light = PrefilteredLight(*prefilter(radiance))
    return rotated(light, _light_from_world(params))


def light_of(shading: Shading, own: EnvironmentLight | None, rotation: Any, scene: Any) -> Light | None:
    """The integrator's light, else the scene's (InputError without one); None if the model uses none."""
    if shading.model.light == "none":
        return None
    if (light := shading.light_of(own)) is not None:
        return rotated(light, rotation)
    if (emitter := scene.environment()) is None:
        raise InputError("there is none", "refgs", "light", "nest an `envmap` in integrator or scene")
    return emitter_light(emitter, shading.model.light == "filtered")


def rotated(light: Light, light_from_world: Any) -> Light:
    return light if light_from_world is None else RotatedLight(light, light_from_world)


def _map_radiance(params: Any, emitter: Any) -> tuple[Any, str]:
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
    if emitter.class_name() != "ConstantBackgroundEmitter" or "radiance.value" not in params:
        what = f"emitter '{emitter.id()}': type: refgs takes no {emitter.class_name()}"
        raise InputError(what, remedy="use an `envmap` or a `constant` environment")
    colour = mi.Color3f(params["radiance.value"])
    return bounded(colour, colour)


def _light_from_world(params: Any) -> Any:
    """Rotation or reflection (mi.Matrix3f, detached), None for the identity; InputError for scale or
    shear."""
    matrix = np.array(params["to_world"].matrix, dtype=np.float64).reshape(4, 4)[:3, :3]
    if np.abs(matrix - np.eye(3)).max() < 1e-7:
        return None
    if not np.abs(matrix.T @ matrix - np.eye(3)).max() < 1e-4:
        raise InputError("not a rotation or reflection", "emitter", "to_world", "remove scale and shear")
    return mi.Matrix3f(np.linalg.inv(matrix).astype(np.float32))
