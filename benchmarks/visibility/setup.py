"""One concave scene under the light, its images by each rule of visibility and by the path tracer."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from benchmarks.common import setup
from benchmarks.common.view import Points, make_light, rows
from benchmarks.visibility.cases import METALLIC, VOXEL, Concave, Rule
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.render.pipeline import SurfelScene, render
from mi_refgs.shade.points import ShadingPoints
from mi_refgs.shade.reflectance import TraceContext
from mi_refgs.shade.reflectance.split_sum import SplitSum
from mi_refgs.shade.reflection import reflection
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera

TIMED_ROUGHNESS = 0.3


class Setup(setup.Setup):
    """One scene under a light of that name."""

    def __init__(
        self,
        concave: Concave,
        settings: Any,
        light: str = "studio",
        metallic: float = METALLIC,
        roughness: float = TIMED_ROUGHNESS,
    ) -> None:
        self.map, self.metallic, mesh = make_light(light, settings.light_height), metallic, concave.mesh
        self.file = mesh.export(file_type="ply", vertex_normal=True)
        with self.mesh_file() as path:
            shape = {"type": "ply", "filename": path}
            super().__init__(concave.name, shape, self.map, concave.look, settings)
        self.light = self.map.prefiltered(settings.light_height)
        self.origin = mi.Point3f(concave.look.origin)
        self.vertices, self.normals = np.asarray(mesh.vertices, np.float32), np.array(mesh.vertex_normals)
        self.occluder = Occluder(Mesh(self.vertices, np.asarray(mesh.faces, np.uint32), VOXEL))
        self.material(roughness)
        self.occluder.set_materials(self.surfels)

    @contextmanager
    def mesh_file(self) -> Iterator[str]:
        """A file of the mesh while a scene that names it is loaded."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "mesh.ply"
            path.write_bytes(self.file)
            yield str(path)

    def material(self, roughness: float) -> None:
        """Give the scene this roughness; surfels at the mesh's vertices, of the same material."""
        self.surface = self.set_material(self.metallic, roughness)
        given = {"albedo": self.albedo, "metallic": self.metallic, "roughness": roughness}
        self.surfels = setup.covering(self.vertices, self.normals.astype(np.float32), **given)

    def seen(self, points: Points, rule: Rule) -> ShadingPoints:
        """The points with what the rule finds."""
        at = ShadingPoints(points.normal, points.view, **self.surface)
        if not rule.rays:
            return at
        context = TraceContext(self.occluder, self.surfels, self.light, self.origin, -points.view)
        return reflection(at, context, rule.options())

    def image(self, rule: Rule, indirect: np.ndarray | None = None) -> np.ndarray:
        """(P, 3); with indirect light (P, 3) of blocked rays in place of the rule's own."""
        at = self.seen(self.points, rule)
        if indirect is not None:
            at = at.replaced(indirect=mi.Color3f(np.ascontiguousarray(indirect.T, np.float32)))
        shaded = SplitSum().shade(at, self.light, rule.options())
        return rows(shaded.total())

    def reference(self, depth: int) -> np.ndarray:
        """The path tracer's images: batches (B, P, 3), one seed each."""
        path, settings = setup.path_tracer(depth), self.settings
        return np.stack([self.render(path, settings.spp, seed) for seed in range(1, settings.batches + 1)])

    def frame_call(self, rule: Rule) -> Callable[[], Any]:
        """The product's own frame: the surfels splatted, visibility, shading."""
        camera = Camera.from_sensor(self.timing_sensor.inner)
        shading = Shading.resolve(rule.options(), mesh=rule.rays > 0)
        scene = SurfelScene(self.surfels, shading, self.light, self.occluder)
        return lambda: render(scene, camera).radiance
