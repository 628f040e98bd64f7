"""Events of open scenes: the region follows the object, the background becomes the light of photographs."""

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np

from mi_refgs.data.object_region import camera_positions, fitted_region, seen_share
from mi_refgs.data.view import View, evenly_spread
from mi_refgs.fitting.exchange import exchange
from mi_refgs.fitting.photographed_light import PhotographedLight
from mi_refgs.fitting.train import FEW_VIEWS, Trainer
from mi_refgs.methods.extensions import Event, register_event
from mi_refgs.methods.fields import Window
from mi_refgs.render.panorama import OPAQUE
from mi_refgs.render.pipeline import render_depth
from mi_refgs.types import Float

AFTER = 1 / 3  # fraction of the iterations after which the region follows the object
LEVEL = 0.05  # difference of depth, in radii of the region, up to which two pixels show one surface
LEVEL_COUNT = 3  # of the eight neighbours of a pixel; fewer are where an outline mixes near and far


@register_event
@dataclass(frozen=True)
class FollowObject(Event[Trainer]):
    """Adapts an estimated region of interest to the object, once; one that a user gave stays."""

    name: ClassVar[str] = "follow_object"
    always: ClassVar[bool] = True

    def due(self, trainer: Trainer) -> bool:
        region = trainer.data.region
        open_ = trainer.setup.open_scene and region is not None and region.estimated
        return open_ and trainer.iteration >= AFTER * trainer.method.iterations and trainer.fit.region is None

    def apply(self, trainer: Trainer) -> None:
        trainer.check()
        region, around, views = trainer.region, trainer.fit.surroundings, trainer.data.views
        assert region is not None and around is not None
        tables = trainer.surfels.detach(), around.surfels.detach()
        points = []
        for view in map(trainer.read, evenly_spread(len(views), FEW_VIEWS)):
            depth, alpha = render_depth(tables[0], view.camera(), tables[1])
            points.append(surface_points(view, depth, alpha, region.radius))
        seen, cameras = partial(seen_share, views), camera_positions(views)
        found = fitted_region(region, cameras, np.concatenate(points), seen)
        trainer.fit.region = found or region
        if found is None:
            trainer.tell("region of interest: no object is separate from the scene, so it stays")
            return
        centre = ", ".join(f"{x:.3g}" for x in found.centre)
        trainer.tell(f"region of interest: the object is within {found.radius:.3g} units of ({centre})")
        exchange(trainer.setup, trainer.fit)


@register_event
@dataclass(frozen=True)
class PhotographLight(Event[Trainer]):
    """Renders the background from the object, for the loss `photographed`; of scenes with a light only."""

    name: ClassVar[str] = "photograph_light"
    when: Window  # iterations at which it happens

    def due(self, trainer: Trainer) -> bool:
        open_ = trainer.fit.surroundings is not None and trainer.region is not None
        return open_ and trainer.method.light is not None and self.when.due(trainer.iteration)

    def apply(self, trainer: Trainer) -> None:
        trainer.check()
        light, around, region = trainer.fit.light, trainer.fit.surroundings, trainer.region
        assert light is not None and around is not None and region is not None
        posed = [*map(trainer.read, evenly_spread(len(trainer.data.views), FEW_VIEWS))]
        given = (around, region, posed, light.environment().height)
        trainer.fit.photographed = PhotographedLight.of(trainer.surfels.detach(), *given)


def surface_points(view: View, depth: Float, alpha: Float, radius: float) -> np.ndarray:
    """World points (P, 3) of pixels that show a surface, not a hidden floater; `radius` of the region."""
    z, opaque = (np.array(x).reshape(view.height, view.width) for x in (depth, alpha))
    around = np.pad(z, 1, constant_values=np.inf)
    shifts = [(row, column) for row in range(3) for column in range(3) if (row, column) != (1, 1)]
    beside = np.stack([around[r : r + view.height, c : c + view.width] for r, c in shifts])
    level = np.count_nonzero(abs(beside - z) < LEVEL * radius, axis=0) >= LEVEL_COUNT
    row, column = np.nonzero((opaque > OPAQUE) & level)
    return np.asarray(view.to_world[:3, 3] + view.rays(row, column) * z[row, column, None])
