"""A reconstruction as a page shows it: its surfels with changed materials, under a light that turns."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.region import Region
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.render.pipeline import Frame, Request, SurfelScene, render
from mi_refgs.runs.relightable import lacking, relightable
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.ambient import update_occluder_caches
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.light import Light, RotatedLight
from mi_refgs.shade.points import TERMS
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.surfels.table import Surfels
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.tonemap import IMAGE, DisplayOptions, backdrops_of, planes_of
from mi_refgs.viewer.viewer_scene import SampleRequest, SampleResult, fine_planes

OUTLIERS = 2.0
"""Percent of the surfels along each axis and side that do not count as the object."""

Change = Callable[[TrainedScene], TrainedScene]
"""An edit of a scene that keeps its rows."""


def bounds_of(surfels: Surfels, region: Region | None = None) -> tuple[np.ndarray, float]:
    """Centre (3,) and radius of the object: its region, else where most of its surfels are."""
    if region is not None:
        return np.array(region.centre), region.radius
    position = surfels.to_numpy()["position"].astype(np.float64)
    return around_box(*box_of(position)) if len(position) else (np.zeros(3), 1.0)


def box_of(position: np.ndarray) -> np.ndarray:
    """Lower and upper corner (2, 3) of the box of most positions (N, 3), N > 0."""
    return np.percentile(position, (OUTLIERS, 100 - OUTLIERS), axis=0)


def around_box(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (3,) and radius of the sphere around a box."""
    return (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)


def variables_of(surfels: Surfels, shading: Shading) -> tuple[str, ...]:
    """The picture and the variables that such surfels have."""
    maps = [name for name in surfels.raw if ATTRIBUTES[name].aov]
    traced = ["visibility"] if shading.occlusion else []
    terms = () if shading.model.light == "none" else TERMS if traced else TERMS[:2]
    return (IMAGE, *maps, "normal", "depth", "alpha", *traced, *terms)


class ReconstructionView:
    """A `TrainedScene` of which parts change. What costs time is made again only where it has to be."""

    square_pixels = False
    scene: TrainedScene

    def __init__(self, scene: TrainedScene, region: Region | None = None) -> None:
        """Show the scene as it is; `region` is what its data set is about."""
        self.original = scene
        self.centre, self.radius = bounds_of(scene.surfels, region)
        self.turn = 0.0  # degrees that the light is turned about z, counter-clockwise from above
        self.environment = scene.light
        self.changes: list[Change] = []
        self.relit = False
        self._relightable: TrainedScene | None = None
        self._put(scene)

    # ---------------- what there is ----------------

    @property
    def variables(self) -> tuple[str, ...]:
        """See `ViewerScene`."""
        return variables_of(self.scene.surfels, self.scene.shading)

    @property
    def backdrops(self) -> tuple[str, ...]:
        """See `ViewerScene`."""
        return backdrops_of(self.scene.surroundings is not None, self.lit)

    @property
    def lit(self) -> bool:
        """Whether it has a light that may turn."""
        return self.scene.light is not None and self.scene.shading.model.light != "none"

    @property
    def materials(self) -> tuple[str, ...]:
        """Channels of one number a surfel that may be set."""
        return tuple(name for name in ("roughness", "metallic") if self.scene.surfels.has(name))

    @property
    def can_relight(self) -> bool:
        """Whether `runs.relightable` takes it."""
        return not lacking(self.original)

    # ---------------- what changes it ----------------

    def set_light(self, light: EnvironmentLight | None) -> None:
        """Put another light in place of the scene's own; None brings that back."""
        self.environment = self.original.light if light is None else light
        self._filter()

    def set_turn(self, degrees: float) -> None:
        """Turn the light to this angle about z, counter-clockwise seen from above."""
        self.turn = float(degrees)
        self._stale = True

    def set_relit(self, relit: bool) -> None:
        """Show materials alone, as `refgs relight` does, or what was fitted; InputError as that raises."""
        if relit and self._relightable is None:
            self._relightable = relightable(self.original)
        self.relit = relit
        self._rebuild()

    def set_changes(self, changes: list[Change]) -> None:
        """Show the scene after these edits, in order."""
        self.changes = list(changes)
        before = self.scene
        scene = self._base()
        for change in self.changes:
            scene = change(scene)
        self.scene = replace(before, surfels=scene.surfels)
        self._stale = True

    def _base(self) -> TrainedScene:
        return self._relightable if self.relit and self._relightable is not None else self.original

    def _rebuild(self) -> None:
        self._put(self._base())
        self.set_changes(self.changes)

    def _put(self, scene: TrainedScene) -> None:
        """Show a scene with a mesh of its own."""
        self.scene = scene
        self._occluder = Occluder(scene.mesh)
        self._filter()

    def _filter(self) -> None:
        with dr.suspend_grad():
            self._filtered = self.scene.shading.light_of(self.environment)
        self._stale = True

    @property
    def light(self) -> Light | None:
        """The light as it is turned. The angle is opaque, so that no kernel depends on it."""
        if self._filtered is None:
            return None
        angle = math.radians(self.turn)
        cos, sin = dr.opaque(mi.Float, math.cos(angle)), dr.opaque(mi.Float, math.sin(angle))
        return RotatedLight(self._filtered, mi.Matrix3f([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]))

    # ---------------- pictures ----------------

    def frame(
        self, camera: Any, aovs: Collection[str] = (), settled: bool = True, alone: bool = False
    ) -> Frame:
        """A view, without derivatives; until it is `settled`, ambient shadows may be those of before.

        `aovs` as in `render`; `alone`: without the surroundings.
        """
        light = self.light
        with dr.suspend_grad():
            if self._stale and (settled or self._never):
                update_occluder_caches(self._occluder, self.scene.surfels, light, self.scene.shading)
                self._stale = False
            surroundings = None if alone else self.scene.surroundings
            scene = SurfelScene(self.scene.surfels, self.scene.shading, light, self._occluder, surroundings)
            return render(scene, camera, Request(aovs, forward_only=True))

    @property
    def _never(self) -> bool:
        """Whether the mesh lacks what the shading asks for altogether."""
        shading = self.scene.shading
        wanted = bool(shading.ambient_rays), bool(shading.traced_bounces)
        there = self._occluder.ambient is not None, self._occluder.vertex_surfels is not None
        return not self._occluder.empty and any(w and not t for w, t in zip(wanted, there, strict=True))

    def draw(self, sample: SampleRequest) -> SampleResult:
        """See `ViewerScene`."""
        camera = sample.camera()
        frame = self.frame(camera, sample.asked, sample.settled, sample.look.object_only)
        with dr.suspend_grad():
            return SampleResult(planes_of(frame, camera, sample.look, self.light), frame.depth)

    def fine(self, pose: Pose, width: int, height: int, look: DisplayOptions) -> list[Any]:
        """See `ViewerScene`."""
        scene = self.scene
        return fine_planes(self.draw, pose, width, height, look, scene.shading, scene.count)
