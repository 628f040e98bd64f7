"""The state of a loop of one's own as a fitted scene."""

import warnings
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.plugins.light import light_of, own_light, used_emitters
from mi_refgs.render.surroundings import Surroundings, nothing_around
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import MIN_HEIGHT, EnvironmentLight
from mi_refgs.shade.light.latlong import lat_long
from mi_refgs.shade.light.light import RotatedLight
from mi_refgs.shade.light.light_file import CONVERTED_ROWS
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.reflectance import MODELS
from mi_refgs.shade.shading import Shading, spare
from mi_refgs.surfels.attributes import attribute
from mi_refgs.surfels.table import Surfels


def scene_of(params: Any, mesh: Mesh | None, shading: ShadingOptions | None) -> TrainedScene:
    """The scene of `Reconstruction.from_params`, detached."""
    if isinstance(params, mi.SceneParameters):  # the object that was traversed is nobody's child
        params = next(node for node, (parent, _) in params.hierarchy.items() if parent is None)
    if isinstance(params, Mapping):
        return _of_arrays(params, mesh, shading)
    integrator = params.integrator() if isinstance(params, mi.Scene) else params
    if type(integrator).__name__ != "RefGSIntegrator":
        what, remedy = "it has no `refgs` integrator", "give such a scene, its parameters, or raw arrays"
        raise InputError(what, "from_params", type(params).__name__, remedy)
    if shading is not None:
        raise InputError("a scene has its own", "from_params", "shading", "give arrays, or drop it")
    lights = used_emitters(integrator.shading, params) if isinstance(params, mi.Scene) else []
    if integrator.light is None and integrator.shading.model.light != "none":
        if not lights or not all(emitter.is_environment() for emitter in lights):
            what, remedy = "its light is not an environment alone", "nest an `envmap` in the integrator"
            raise InputError(what, "from_params", "light", remedy)
    integrator.surfels.detach().validate()
    with dr.suspend_grad():
        seen = light_of(integrator.shading, integrator.light, integrator.light_to_world, params)
    light = integrator.light
    if light is None and seen is not None:
        light = own_light(lights[0])[0]
    if isinstance(seen, RotatedLight):
        rows = max(light.height, min(4 * light.height, CONVERTED_ROWS))  # finer, so that little is blurred
        light = EnvironmentLight.from_radiance(lat_long(seen.radiance, rows))
    around, behind = integrator.around, integrator.behind
    if not isinstance(behind, EnvironmentLight | None):
        behind = EnvironmentLight.constant(np.array(behind).ravel(), MIN_HEIGHT)
    elif behind is None and around is not None:
        warnings.warn("background: behind surroundings it becomes black", RuntimeWarning, stacklevel=3)
    if around is not None or behind is not None:
        surfels = nothing_around(integrator.surfels) if around is None else Surfels(around.raw).detach()
        around = Surroundings(surfels, behind and EnvironmentLight(dr.detach(behind.raw)))
        around.surfels.validate()
    return TrainedScene(
        integrator.surfels.detach(),
        None if light is None else EnvironmentLight(dr.detach(light.raw)),
        mesh or integrator.mesh,
        integrator.shading,
        iteration=0,
        seconds=0.0,
        surroundings=around,
        near=integrator.near,
    )


def _of_arrays(params: Mapping[str, Any], mesh: Mesh | None, shading: ShadingOptions | None) -> TrainedScene:
    """The scene of raw values by attribute, and of a light."""
    values = {name.removeprefix("refgs."): value for name, value in params.items()}
    for name in values.keys() - {"light"}:
        attribute(name)  # is registered
    values = {name: np.array(value, np.float32) for name, value in values.items()}
    light = EnvironmentLight(mi.TensorXf(values.pop("light"))) if "light" in values else None
    surfels = Surfels.from_numpy(values)
    surfels.validate()
    if shading is None:
        reflectance, diffuse = Shading.default(surfels.raw)
        shading = ShadingOptions(MODELS[reflectance].shaded_at[0], reflectance, diffuse)
        if lost := spare(surfels.raw, MODELS[reflectance].required_attributes(shading)):
            what = f"{', '.join(lost)}: `{reflectance}` does not use it; name a model by `shading`"
            warnings.warn(what, RuntimeWarning, stacklevel=4)
    resolved = Shading(**asdict(shading)) if mesh is None else Shading.resolve(shading, True)
    resolved.require_inputs(surfels.raw, light is not None, mesh is not None)
    return TrainedScene(surfels, light, mesh, resolved, iteration=0, seconds=0.0)
