"""Any Mitsuba scene as a viewer scene, rendered by its own integrator."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.plugins.aovs import suffixes
from mi_refgs.plugins.properties import BackgroundProperties
from mi_refgs.render.pipeline import Frame, Request
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Float
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.reconstruction_view import box_of, sphere_around, variables_of
from mi_refgs.viewer.resolution import SAMPLES
from mi_refgs.viewer.tonemap import IMAGE, backdrops_of, premultiplied
from mi_refgs.viewer.viewer_scene import SampleRequest, SampleResult, ViewerScene

CLIP = 1e-3, 1e4
"""Near and far plane, in radii of the scene."""
OBJECT_ONLY = BackgroundProperties()
"""No background."""


class MitsubaScene(ViewerScene):
    """A loaded scene; each sample of a page is one sample per pixel of its integrator."""

    square_pixels = True  # as those of Mitsuba's `perspective`

    def __init__(self, scene: Any, path: str) -> None:
        """Display a scene; raises InputError, with its path, if it has no size or no sensor."""
        self.scene, self.params = scene, mi.traverse(scene)
        if not scene.sensors():
            raise InputError(f"{path}: sensor: the scene has none to begin at; add a `perspective`")
        self.centre, self.radius = self._bounds(path)
        integrator = scene.integrator()
        self._is_refgs = isinstance(getattr(integrator, "surfels", None), Surfels)
        if self._is_refgs:
            self.variables = variables_of(integrator.surfels, integrator.shading)
        else:
            prefixes = dict.fromkeys(name.partition(".")[0] for name in integrator.aov_names())
            self.variables = (IMAGE, *(name for name in prefixes if name in suffixes()))
        self._background = integrator.background if self._is_refgs else OBJECT_ONLY
        has_background = any(part is not None for part in vars(self._background).values())
        self.backdrops = backdrops_of(has_background, light=False)

        # The parameter that rotates the environment.
        environment = scene.environment()
        own = None if environment is None else environment.id()
        keys = [key for key in self.params.keys() if key.endswith(".to_world")]
        self._turn_key = next((key for key in keys if own is not None and key.startswith(own)), None)
        self.can_turn = self._turn_key is not None
        self._unturned = None if self._turn_key is None else mi.Transform4f(self.params[self._turn_key])

    def _bounds(self, path: str) -> tuple[np.ndarray, float]:
        positions = [np.array(self.params[key]) for key in self.params.keys() if key.endswith(".position")]
        surfels = [p for p in positions if p.ndim == 2 and p.shape[1] == 3 and len(p)]
        if surfels:
            return sphere_around(*box_of(np.concatenate(surfels)))
        if not self.scene.shapes():
            raise InputError(f"{path}: shapes: the scene has neither shapes nor surfels; add an object")
        box = self.scene.bbox()
        return sphere_around(np.array(box.min, np.float64), np.array(box.max, np.float64))

    def set_turn(self, degrees: float) -> None:
        """Rotate the environment to this angle about z, counter-clockwise seen from above."""
        turn = mi.Transform4f().rotate([0, 0, 1], dr.opaque(mi.Float, degrees))
        self.params[self._turn_key] = turn @ self._unturned
        self.params.update()

    def start(self) -> Pose:
        """Return the pose of the first sensor; raises InputError if that is not `perspective`."""
        sensor = self.scene.sensors()[0]
        params = mi.traverse(sensor)
        if "x_fov" not in params:
            raise InputError(f"sensor '{sensor.id()}': type: not perspective; a page needs such a camera")
        matrix = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
        matrix[:3, :3] /= np.cbrt(abs(np.linalg.det(matrix[:3, :3])))
        width, height = (int(x) for x in sensor.film().crop_size())
        across = math.tan(math.radians(float(np.array(params["x_fov"]).ravel()[0])) / 2)
        near = float(params["near_clip"]) if self._is_refgs else 0.0
        return Pose(matrix, 2 * math.atan(across * height / width), width / height, near)

    def frame(self, sample: SampleRequest) -> Frame:
        """See `ViewerScene`; for the integrator `refgs`."""
        background = OBJECT_ONLY if sample.look.object_only else self._background
        request = Request(sample.aovs, forward_only=True)
        frame: Frame = self.scene.integrator().frame(self.scene, request, background, sample.camera())
        return frame

    def draw(self, sample: SampleRequest) -> SampleResult:
        """See `ViewerScene`."""
        return super().draw(sample) if self._is_refgs else SampleResult(self._planes(sample, 1))

    def fine(self, request: SampleRequest) -> list[Float]:
        """See `ViewerScene`."""
        return super().fine(request) if self._is_refgs else self._planes(request, SAMPLES)

    def cost(self) -> tuple[Shading, int]:
        """See `ViewerScene`."""
        integrator = self.scene.integrator()
        return integrator.shading, integrator.surfel_count

    def _planes(self, request: SampleRequest, spp: int) -> list[Float]:
        """Render by Mitsuba, and return planes as `tonemap.planes_of` does."""
        pose, width, height, what = request.pose, request.width, request.height, request.look.what
        sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov": math.degrees(pose.fov),
                "fov_axis": "y",
                "near_clip": CLIP[0] * self.radius,
                "far_clip": CLIP[1] * self.radius,
                "principal_point_offset_x": -request.offset[0] / width,
                "principal_point_offset_y": -request.offset[1] / height,
                "to_world": mi.ScalarTransform4f(pose.to_world),
                "film": {
                    "type": "hdrfilm",
                    "width": width,
                    "height": height,
                    "pixel_format": "rgba",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "independent", "sample_count": spp},
            }
        )
        image = mi.render(self.scene, sensor=sensor, spp=spp, seed=request.index)
        names = [channel.name for channel in sensor.film().bitmap().struct_()]
        index = dr.arange(mi.UInt32, width * height) * len(names)
        planes = {name: dr.gather(mi.Float, image.array, index + i) for i, name in enumerate(names)}
        if what == IMAGE:
            return [planes[name] for name in "RGBA"]
        return premultiplied(what, [planes[f"{what}.{suffix}"] for suffix in suffixes()[what]], planes["A"])
