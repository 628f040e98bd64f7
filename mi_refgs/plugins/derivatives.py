"""Which parameters of a Mitsuba scene have derivatives through the `refgs` integrator, in both modes.

All parameters of the integrator have, SENSOR of the sensor that is rendered, and EMITTER of the emitters that
`light.used_emitters` lists, if the integrator has no light of its own. All others raise InputError. The
derivative is 0 only by parameters that the shading does not use, and by those of other sensors.

No derivative, on purpose: scale and shear of `to_world`; a background colour; the mesh; the visibility that
rays find with it, their number, where they start, and where they hit it after the first time; the side to
which a normal is turned; what `splat.composite` lists (sort order, tile lists, cuts, clamps)."""

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.errors import InputError
from mi_refgs.plugins.light import used_emitters
from mi_refgs.types import Scene, Sensor

SENSOR = {"to_world", "x_fov", "principal_point_offset_x", "principal_point_offset_y"}
EMITTER = {"to_world", "scale", "data", "value"}  # the last: of the texture `radiance` or `irradiance`


def require_derivatives(params: Any, scene: Scene, sensor: Sensor, integrator: Any) -> None:
    """Raise InputError for a parameter with gradients enabled and without derivative, and say why."""
    for key, value in () if params is None else params.items():
        if dr.grad_enabled(value) and (reason := _reason(params, key, scene, sensor, integrator)):
            remedy = "detach it, or leave it out of `params`"
            raise InputError(f"has no derivative: {reason}", "mi.render", key, remedy)


def _reason(params: Any, key: str, scene: Scene, sensor: Sensor, integrator: Any) -> str:
    """Why a parameter has no derivative; empty if it has."""
    name, node = key.rpartition(".")[2], params.properties[key][2]
    while node is not None and not isinstance(node, mi.Integrator | mi.Sensor | mi.Emitter | mi.Shape):
        node = params.hierarchy[node][0]
    if node is integrator:
        return ""
    if isinstance(node, mi.Sensor):
        return "" if node is not sensor or name in SENSOR else "refgs does not use it"
    if any(node is emitter for emitter in used_emitters(integrator.shading, scene)):
        if integrator.light is not None:
            return "the integrator has a light of its own"
        return "" if name in EMITTER else "refgs does not use it"
    return "refgs renders surfels under environments and directional emitters only"
