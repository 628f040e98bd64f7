"""The mesh that occludes: extracted from the rendered depth of training views. [Ref-Gaussian §3.3]"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

from mi_refgs.data.view import evenly_spread
from mi_refgs.fitting.exchange import exchange
from mi_refgs.fitting.train import FEW_VIEWS, Trainer
from mi_refgs.methods.extensions import Event, register_event
from mi_refgs.methods.fields import Window, at_least
from mi_refgs.occlusion.mesh import Mesh, extract_mesh
from mi_refgs.occlusion.tsdf import bounds_from_points, fuse
from mi_refgs.render.pipeline import render_depth
from mi_refgs.splat import Camera
from mi_refgs.surfels.table import Surfels

RELEASED = Window(20_000, 50_000, 2_000)  # of the released Ref-Gaussian code on synthetic scenes


@register_event
@dataclass(frozen=True)
class ExtractMesh(Event[Trainer]):
    """Fuses a new occluder from FEW_VIEWS training views, the last one, which is saved, from all."""

    name: ClassVar[str] = "mesh"
    when: Window = RELEASED  # iterations at which it happens
    resolution: int = field(default=128, metadata=at_least(2))  # voxels along the longest side

    def due(self, trainer: Trainer) -> bool:
        return self.when.due(trainer.iteration) and trainer.shading().traceable

    def apply(self, trainer: Trainer) -> None:
        trainer.check()
        # What moved since the last densification is the object's, or is not.
        exchange(trainer.setup, trainer.fit)
        views, method = len(trainer.data.views), trainer.method
        last = self.when.count(trainer.iteration) == self.when.count(method.iterations)
        seen = range(views) if last else evenly_spread(views, FEW_VIEWS)
        cameras = [trainer.read(i).camera() for i in seen]
        trainer.fit.occluder.update(surface_of(trainer.surfels.detach(), cameras, self.resolution))


def surface_of(surfels: Surfels, cameras: Sequence[Camera], resolution: int = 128) -> Mesh:
    """The surface of surfels as triangles, which occlude: fused from their depth in cameras from all around.
    resolution: voxels along the longest side of the box around the surfels, 2 … 1023. Raises InputError
    without a finite position."""
    views = ((*render_depth(surfels, camera), camera) for camera in cameras)
    return extract_mesh(fuse(views, bounds_from_points(surfels.to_numpy()["position"]), resolution))
