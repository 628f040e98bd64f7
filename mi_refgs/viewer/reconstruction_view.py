"""What a page displays: a reconstruction, with changed materials, under a rotated or another light."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.region import Region
from mi_refgs.formats.orbits import sphere_around
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.plugins.aovs import aov_planes, suffixes, values_of_planes
from mi_refgs.render.display import composited, display_image, srgb_from_linear
from mi_refgs.render.passes import in_passes
from mi_refgs.render.pipeline import Frame, Request, SurfelScene, render
from mi_refgs.runs.relightable import lacking, relightable
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.ambient import update_occluder_caches
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.light import Light, RotatedLight
from mi_refgs.shade.points import TERMS
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.types import Float
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.resolution import FINEST, SAMPLES

IMAGE = "image"  # what is displayed unless an AOV is chosen
BACKDROPS = {"white": 1.0, "grey": 0.25, "black": 0.0}  # display-encoded, behind the object
ENVIRONMENT, BACKGROUND = "environment map", "background"
"""More backdrops: with all but the photographed background the object only is displayed."""
Change = Callable[[TrainedScene], TrainedScene]  # keeps number and order of its surfels


@dataclass(frozen=True)
class DisplayOptions:
    """What is displayed of a scene, and how: on all pages, which share their controls."""

    what: str = IMAGE  # or a type of `plugins.aovs`
    exposure: float = 0.0  # stops
    backdrop: str = "white"  # one of those of the scene
    largest: int = FINEST  # finest resolution level at rest


class ReconstructionView:
    """A `TrainedScene` that a page displays and of which parts change: only what depends on a change is
    computed again. The methods are called on the render thread."""

    def __init__(self, scene: TrainedScene, region: Region | None = None) -> None:
        """Display a scene, whose data set may have a region of interest."""
        self.original = self._base = self.scene = scene
        centre, radius = sphere_around(scene.surfels) if region is None else (region.centre, region.radius)
        self.centre, self.radius = np.array(centre), radius  # of the object
        self.can_turn = scene.light is not None and scene.shading.model.light != "none"  # its environment map
        maps = [name for name in scene.surfels.raw if ATTRIBUTES[name].aov]
        traced = ["visibility"] if scene.shading.occlusion else []
        terms = () if scene.shading.model.light == "none" else TERMS if traced else TERMS[:2]
        self.variables = (IMAGE, *maps, "normal", "depth", "alpha", *traced, *terms)
        background = (BACKGROUND,) if scene.surroundings is not None else ()
        # The first is the initial one.
        self.backdrops = (*background, *BACKDROPS, *((ENVIRONMENT,) if self.can_turn else ()))
        self.materials = tuple(name for name in ("roughness", "metallic") if scene.surfels.has(name))
        self.can_relight = not lacking(scene)
        self.turn = 0.0  # rotation of the light about z, degrees, counter-clockwise seen from above
        self.environment = scene.light
        self.change: Change | None = None
        self.set_relit(False)

    def set_light(self, light: EnvironmentLight | None) -> None:
        """Replace the scene's light; None restores it."""
        self.environment = self.original.light if light is None else light
        self._filter()

    def set_turn(self, degrees: float) -> None:
        """Rotate the light to this angle about z, counter-clockwise seen from above."""
        self.turn = float(degrees)
        self._stale = True

    @cached_property
    def _relightable(self) -> TrainedScene:
        return relightable(self.original)

    def set_relit(self, relit: bool) -> None:
        """Display materials only, as `refgs relight` does, or the scene as fitted."""
        self._base = self._relightable if relit else self.original
        self.scene = self._base
        self._occluder = Occluder(self.scene.mesh)
        self._filter()
        self.set_change(self.change)

    def set_change(self, change: Change | None) -> None:
        """Display the scene after an edit; None: as fitted."""
        self.change = change
        changed = self._base if change is None else change(self._base)
        self.scene = replace(self.scene, surfels=changed.surfels)
        self._stale = True

    def _filter(self) -> None:
        with dr.suspend_grad():
            self._filtered = self.scene.shading.light_of(self.environment)
        self._stale = True  # caches of the occluder

    @property
    def light(self) -> Light | None:
        """The rotated light. The angle is opaque, so that no kernel depends on it."""
        if self._filtered is None:
            return None
        angle = math.radians(self.turn)
        cos, sin = dr.opaque(mi.Float, math.cos(angle)), dr.opaque(mi.Float, math.sin(angle))
        return RotatedLight(self._filtered, mi.Matrix3f([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]))

    def frame(self, camera: Camera, look: DisplayOptions, settled: bool) -> Frame:
        """Render one sample per pixel, with ambient shadows that may be outdated unless it is `settled`:
        nothing has moved for a while, so it may take longer. Callers suspend derivatives."""
        light, scene = self.light, self.scene
        shading, occluder = scene.shading, self._occluder
        lacks_ambient = shading.ambient_rays and occluder.ambient is None
        lacks_materials = shading.traced_bounces and occluder.vertex_surfels is None
        if self._stale and (settled or lacks_ambient or lacks_materials):
            update_occluder_caches(occluder, scene.surfels, light, shading)
            self._stale = False
        background = scene.surroundings if look.backdrop == BACKGROUND else None
        near = scene.near if self.environment is self.original.light and not self.turn else None
        rendered = SurfelScene(scene.surfels, shading, light, occluder, background, near)
        return render(rendered, camera, Request(frozenset({look.what} - {IMAGE, "alpha"}), forward_only=True))

    def draw(self, camera: Camera, look: DisplayOptions, settled: bool) -> list[Float]:
        """Render planes of `planes_of`."""
        with dr.suspend_grad():
            return planes_of(self.frame(camera, look, settled), camera, look, self.light)

    def depths(self, pose: Pose) -> tuple[float, float]:
        """Return the distances of the object's front and back, which are displayed as white and as black."""
        distance = float(np.linalg.norm(pose.position - self.centre))
        return max(distance - self.radius, 0.0), distance + self.radius

    def fine(self, camera: Camera, look: DisplayOptions, samples: int = SAMPLES) -> Frame:
        """Render an image to save as `refgs render` does, in passes that fit into memory."""
        size = self.scene.shading.neighbours, self.scene.count
        with dr.suspend_grad():
            return in_passes(lambda view: self.frame(view, look, True), camera, samples, *size)


def planes_of(frame: Frame, camera: Camera, look: DisplayOptions, light: Light | None) -> list[Float]:
    """Planes (H*W,) to average over samples: premultiplied image with what is behind, or AOV; alpha."""
    if look.what != IMAGE:
        return aov_planes(look.what, frame, camera)
    if frame.background is None and look.backdrop == ENVIRONMENT and light is not None:
        frame = replace(frame, background=light.radiance(dr.normalize(camera.rays())))
    radiance, alpha = composited(frame)
    return [*radiance, alpha]


def displayed_planes(planes: list[Float], look: DisplayOptions, depths: tuple[float, float]) -> list[Float]:
    """Display-encoded RGB planes, not clipped, of the mean of `planes_of`; `depths` are white and black."""
    what, alpha, behind = look.what, planes[-1], BACKDROPS.get(look.backdrop, 1.0)
    values = planes if what == IMAGE else values_of_planes(what, planes)
    if what == IMAGE or what in TERMS:
        gain = dr.opaque(mi.Float, 2.0**look.exposure)
        radiance = [value * gain for value in values[:3]]
        if what == IMAGE:
            return display_image(radiance, alpha, [behind] * 3)
        return [srgb_from_linear(value) for value in radiance]
    if what == "alpha":
        return values * 3
    match suffixes()[what]:
        case "XYZ":
            values = [0.5 + 0.5 * value for value in values]
        case "RGB":
            values = [srgb_from_linear(value) for value in values]
        case "T":
            near, far = (dr.opaque(mi.Float, x) for x in depths)
            values = [dr.clip((far - values[0]) / (far - near), 0, 1)]
    return [alpha * value + (1 - alpha) * behind for value in values * (3 // len(values))]
