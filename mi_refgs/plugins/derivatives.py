"""Which parameters of a Mitsuba scene have derivatives through the `refgs` integrator, in both modes.

All parameters of the integrator have, SENSOR of the sensor that is rendered, and ENVIRONMENT of the scene's
environment, if the integrator has no light of its own. Any other raises InputError: none is zero in silence. A
parameter that the shading does not use, or of another sensor, has the derivative 0.

No derivative, on purpose: scale and shear of `to_world`; a background colour; the mesh, and the visibility
and radiance that rays find with it; the side to which a normal is turned; what `splat.composite` lists (sort
order, tile lists, cuts, clamps).
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.errors import InputError
from mi_refgs.types import Scene, Sensor

SENSOR = {"to_world", "x_fov", "principal_point_offset_x", "principal_point_offset_y"}
ENVIRONMENT = {"to_world", "scale", "data", "value"}  # the last: of the texture `radiance`


def require_derivatives(params: Any, scene: Scene, sensor: Sensor, integrator: Any) -> None:
    """Raise InputError, with name and reason, for a parameter that has gradients enabled and no derivative."""
    for key, value in () if params is None else params.items():
        if dr.grad_enabled(value) and (reason := _reason(params, key, scene, sensor, integrator)):
            remedy = "detach it, or leave it out of `params`"
            raise InputError(f"has no derivative, {reason}", "mi.render", key, remedy)


def _reason(params: Any, key: str, scene: Scene, sensor: Sensor, integrator: Any) -> str:
    """Why a parameter has no derivative; empty if it has."""
    name, node = key.rpartition(".")[2], params.properties[key][2]
    while node is not None and not isinstance(node, mi.Integrator | mi.Sensor | mi.Emitter | mi.Shape):
        node = params.hierarchy[node][0]
    if node is integrator:
        return ""
    if isinstance(node, mi.Sensor):
        return "" if node is not sensor or name in SENSOR else "refgs does not use it"
    if isinstance(node, mi.Emitter) and node is scene.environment():
        if integrator.light is not None:
            return "the integrator has a light of its own"
        return "" if name in ENVIRONMENT else "refgs does not use it"
    return "refgs renders surfels under an environment, and nothing else of the scene"
