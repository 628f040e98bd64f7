"""Any Mitsuba scene as a page shows it, drawn by its own integrator."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.plugins.aovs import suffixes
from mi_refgs.plugins.surroundings import Around
from mi_refgs.surfels.table import Surfels
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.reconstruction_view import around_box, box_of, variables_of
from mi_refgs.viewer.resolution import SAMPLES
from mi_refgs.viewer.tonemap import IMAGE, DisplayOptions, backdrops_of, planes_of
from mi_refgs.viewer.viewer_scene import SampleRequest, SampleResult, fine_planes

CLIP = 1e-3, 1e4
"""Near and far plane, in radii of the scene."""
ALONE = Around(None, None, None)
"""What is around an object without its surroundings."""


class MitsubaScene:
    """A scene, of which each sample of a page is one of its integrator's a pixel."""

    square_pixels = True  # as those of Mitsuba's `perspective`

    def __init__(self, scene: Any, path: str) -> None:
        """Show a loaded scene; raises InputError if it has no size or no sensor."""
        self.scene = scene
        self.params = mi.traverse(scene)
        if not scene.sensors():
            raise InputError(f"{path}: sensor: the scene has none to begin at; add a `perspective`")
        self.centre, self.radius = self._bounds(path)
        integrator = scene.integrator()
        self._surfels = isinstance(getattr(integrator, "surfels", None), Surfels)  # it is our own
        if self._surfels:
            self.variables = variables_of(integrator.surfels, integrator.shading)
        else:
            prefixes = dict.fromkeys(name.partition(".")[0] for name in integrator.aov_names())
            self.variables = (IMAGE, *(name for name in prefixes if name in suffixes()))
        self._around = integrator.around if self._surfels else ALONE
        surrounded = any(part is not None for part in vars(self._around).values())
        self.backdrops = backdrops_of(surrounded, light=False)
        turns = [key for key in self.params.keys() if key.endswith(".to_world")]
        environment = scene.environment()
        own = None if environment is None else environment.id()
        self._turn_key = next((key for key in turns if own is not None and key.startswith(own)), None)
        self._unturned = None if self._turn_key is None else mi.Transform4f(self.params[self._turn_key])

    def _bounds(self, path: str) -> tuple[np.ndarray, float]:
        positions = [np.array(self.params[key]) for key in self.params.keys() if key.endswith(".position")]
        surfels = [p for p in positions if p.ndim == 2 and p.shape[1] == 3 and len(p)]
        if surfels:
            low, high = box_of(np.concatenate(surfels))
        elif self.scene.shapes():
            box = self.scene.bbox()
            low, high = np.array(box.min, np.float64), np.array(box.max, np.float64)
        else:
            raise InputError(f"{path}: shapes: the scene has neither shapes nor surfels; add an object")
        return around_box(low, high)

    @property
    def lit(self) -> bool:
        """Whether its environment may turn."""
        return self._turn_key is not None

    def set_turn(self, degrees: float) -> None:
        """Turn the environment to this angle about z, counter-clockwise seen from above."""
        turn = mi.Transform4f().rotate([0, 0, 1], dr.opaque(mi.Float, degrees))
        self.params[self._turn_key] = turn @ self._unturned
        self.params.update()

    def start(self) -> Pose:
        """What the first sensor sees; raises InputError for one that is not `perspective`."""
        sensor = self.scene.sensors()[0]
        params = mi.traverse(sensor)
        if "x_fov" not in params:
            raise InputError(f"sensor '{sensor.id()}': type: not perspective; pages have such cameras alone")
        matrix = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
        matrix[:3, :3] /= np.cbrt(abs(np.linalg.det(matrix[:3, :3])))
        width, height = (int(x) for x in sensor.film().crop_size())
        across = math.tan(math.radians(float(np.array(params["x_fov"]).ravel()[0])) / 2)
        near = float(params["near_clip"]) if self._surfels else 0.0
        return Pose(matrix, 2 * math.atan(across * height / width), width / height, near)

    def draw(self, sample: SampleRequest) -> SampleResult:
        """See `ViewerScene`."""
        if self._surfels:
            camera, integrator = sample.camera(), self.scene.integrator()
            around = ALONE if sample.look.object_only else self._around
            with dr.suspend_grad():
                frame = integrator.frame(self.scene, False, sample.asked, around, camera)
                return SampleResult(planes_of(frame, camera, sample.look, None), frame.depth)
        return SampleResult(
            self._planes(
                sample.pose, sample.width, sample.height, sample.look, sample.index, 1, sample.offset
            )
        )

    def fine(self, pose: Pose, width: int, height: int, look: DisplayOptions) -> list[Any]:
        """See `ViewerScene`."""
        if self._surfels:
            of = self.scene.integrator()
            count = of.around.count(of.surfels)
            return fine_planes(self.draw, pose, width, height, look, of.shading, count)
        return self._planes(pose, width, height, look, 0, SAMPLES)

    def _planes(
        self,
        pose: Pose,
        width: int,
        height: int,
        look: DisplayOptions,
        seed: int,
        spp: int,
        offset: tuple[float, float] = (0.0, 0.0),
    ) -> list[Any]:
        sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov": math.degrees(pose.fov),
                "fov_axis": "y",
                "near_clip": CLIP[0] * self.radius,
                "far_clip": CLIP[1] * self.radius,
                "principal_point_offset_x": -offset[0] / width,
                "principal_point_offset_y": -offset[1] / height,
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
        image = mi.render(self.scene, sensor=sensor, spp=spp, seed=seed)
        names = [channel.name for channel in sensor.film().bitmap().struct_()]
        index = dr.arange(mi.UInt32, width * height) * len(names)
        planes = {name: dr.gather(mi.Float, image.array, index + i) for i, name in enumerate(names)}
        if look.what == IMAGE:
            return [planes[name] for name in "RGBA"]
        alpha = planes["A"]
        values = [planes[f"{look.what}.{suffix}"] for suffix in suffixes()[look.what]]
        premultiplied = look.what in ("diffuse", "specular", "indirect", "alpha")
        return [*(value if premultiplied else value * alpha for value in values), alpha]
