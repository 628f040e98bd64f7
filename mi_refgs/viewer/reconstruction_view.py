"""A reconstruction as a viewer scene: with changed materials, under a rotated or another light."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.region import Region
from mi_refgs.editing.painting import selected_alpha
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.render.pipeline import Frame, Request, SurfelScene, render
from mi_refgs.runs.relightable import lacking, relightable
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.ambient import update_occluder_caches
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.light import Light, RotatedLight
from mi_refgs.shade.light.near_field import NearField
from mi_refgs.shade.points import TERMS
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.surfels.table import Surfels
from mi_refgs.viewer.tonemap import IMAGE, backdrops_of
from mi_refgs.viewer.viewer_scene import SampleRequest, SampleResult, ViewerScene

OUTLIERS = 2.0
"""Percent of the surfels along each axis and side that do not count as the object."""
TINT, TINT_SHARE = (1.0, 0.3, 0.0), 0.5
"""Linear colour of highlighted surfels, and its share of theirs."""

Change = Callable[[TrainedScene], TrainedScene]
"""An edit of a scene that keeps number and order of its surfels."""


def bounds_of(surfels: Surfels, region: Region | None = None) -> tuple[np.ndarray, float]:
    """Return centre (3,) and radius of the object: its region, else where most of its surfels are."""
    if region is not None:
        return np.array(region.centre), region.radius
    position = surfels.to_numpy()["position"].astype(np.float64)
    return sphere_around(*box_of(position)) if len(position) else (np.zeros(3), 1.0)


def box_of(position: np.ndarray) -> np.ndarray:
    """Return lower and upper corner (2, 3) of the box of most positions (N, 3), N > 0."""
    return np.percentile(position, (OUTLIERS, 100 - OUTLIERS), axis=0)


def sphere_around(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
    """Return centre (3,) and radius of the sphere around a box."""
    return (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)


def variables_of(surfels: Surfels, shading: Shading) -> tuple[str, ...]:
    """Return the image and the AOVs that such surfels have."""
    maps = [name for name in surfels.raw if ATTRIBUTES[name].aov]
    traced = ["visibility"] if shading.occlusion else []
    terms = () if shading.model.light == "none" else TERMS if traced else TERMS[:2]
    return (IMAGE, *maps, "normal", "depth", "alpha", *traced, *terms)


class ReconstructionView(ViewerScene):
    """A `TrainedScene` of which parts change; only what depends on a change is computed again."""

    def __init__(self, scene: TrainedScene, region: Region | None = None) -> None:
        """Display a scene, whose data set may have a region of interest."""
        self.original = self._base = self.scene = scene
        self.centre, self.radius = bounds_of(scene.surfels, region)
        self.can_turn = scene.light is not None and scene.shading.model.light != "none"  # its environment map
        self.variables = variables_of(scene.surfels, scene.shading)
        self.backdrops = backdrops_of(scene.surroundings is not None, self.can_turn)
        self.materials = tuple(name for name in ("roughness", "metallic") if scene.surfels.has(name))
        self.can_relight = not lacking(scene)
        self.turn = 0.0  # rotation of the light about z, degrees, counter-clockwise seen from above
        self.environment = scene.light
        self.changes: list[Change] = []
        self.highlighted: np.ndarray | None = None  # surfels (N,) bool that are displayed in TINT
        self._relightable: TrainedScene | None = None
        self.set_relit(False)

    # ---------------- changes ----------------

    def set_light(self, light: EnvironmentLight | None) -> None:
        """Replace the scene's light; None restores it."""
        self.environment = self.original.light if light is None else light
        self._filter()

    def set_turn(self, degrees: float) -> None:
        """Rotate the light to this angle about z, counter-clockwise seen from above."""
        self.turn = float(degrees)
        self._stale = True

    def set_relit(self, relit: bool) -> None:
        """Display materials only, as `refgs relight` does, or the scene as fitted.

        Raises InputError as `runs.relightable` does.
        """
        if relit and self._relightable is None:
            self._relightable = relightable(self.original)
        self._base = self._relightable if relit and self._relightable is not None else self.original
        self.scene = self._base
        self._occluder = Occluder(self.scene.mesh)
        self._filter()
        self.set_changes(self.changes)

    def set_changes(self, changes: list[Change]) -> None:
        """Display the scene after these edits, in order."""
        self.changes = list(changes)
        scene = self._base
        for change in self.changes:
            scene = change(scene)
        self.scene = replace(self.scene, surfels=scene.surfels)
        self._stale = True

    def _filter(self) -> None:
        with dr.suspend_grad():
            self._filtered = self.scene.shading.light_of(self.environment)
        self._stale = True  # caches of the occluder

    @property
    def light(self) -> Light | None:  # type: ignore[override]
        """The rotated light. The angle is opaque, so that no kernel depends on it."""
        if self._filtered is None:
            return None
        angle = math.radians(self.turn)
        cos, sin = dr.opaque(mi.Float, math.cos(angle)), dr.opaque(mi.Float, math.sin(angle))
        return RotatedLight(self._filtered, mi.Matrix3f([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]))

    @property
    def _near(self) -> NearField | None:
        """Distances of what the scene's own light shows, unless it is rotated."""
        return self.scene.near if self.environment is self.original.light and not self.turn else None

    # ---------------- images ----------------

    def draw(self, sample: SampleRequest) -> SampleResult:
        """See `ViewerScene`; displayed images, but not saved ones, have highlighted surfels in another
        colour."""
        drawn = super().draw(sample)
        if self.highlighted is None or sample.look.what != IMAGE or sample.exact is not None:
            return drawn
        share = TINT_SHARE * selected_alpha(self.original, self.highlighted, sample.camera())
        tinted = [dr.lerp(x, colour, share) for x, colour in zip(drawn.planes[:3], TINT, strict=True)]
        return drawn._replace(planes=[*tinted, *drawn.planes[3:]])

    def frame(self, sample: SampleRequest) -> Frame:
        """See `ViewerScene`; with ambient shadows that may be outdated unless it is `settled`."""
        light, scene = self.light, self.scene
        with dr.suspend_grad():
            if self._stale and (sample.settled or self._lacks_caches):
                update_occluder_caches(self._occluder, scene.surfels, light, scene.shading)
                self._stale = False
            background = None if sample.look.object_only else scene.surroundings
            rendered = SurfelScene(
                scene.surfels, scene.shading, light, self._occluder, background, self._near
            )
            request = Request(sample.aovs, forward_only=True)
            return render(rendered, sample.camera(), request)

    @property
    def _lacks_caches(self) -> bool:
        """Whether the occluder has no ambient visibility, or no vertex materials, that the shading needs."""
        shading, occluder = self.scene.shading, self._occluder
        ambient = bool(shading.ambient_rays) and occluder.ambient is None
        traced = bool(shading.traced_bounces) and occluder.vertex_surfels is None
        return not occluder.empty and (ambient or traced)

    def cost(self) -> tuple[Shading, int]:
        """See `ViewerScene`."""
        return self.scene.shading, self.scene.count
