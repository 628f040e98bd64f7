"""The light that photographs show: a panorama of the fitted background, near which the environment map stays.
What no photograph shows, such as a ceiling, is left to the reflections."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.region import Region
from mi_refgs.data.view import View
from mi_refgs.fitting.losses import light_difference
from mi_refgs.kernels.device import upload
from mi_refgs.render.panorama import OPAQUE, Panorama, panorama
from mi_refgs.render.pipeline import render_depth
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.light.lobe_matrices import map_directions, row_areas
from mi_refgs.shade.light.near_field import NearField
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Float

NEAR = 0.05  # radii of the region: what is nearer to its centre is not background
FARTHEST = 1e4  # radii of the region: distance of the background map
SEEN_SHARE = 0.05  # fraction of the views from which a texel counts fully: fewer views may show a floater
PANORAMA = ("centre", "radiance", "nearness")  # arrays of a panorama in a checkpoint
BEHIND = 1.1  # factor of the rendered depth up to which a point is on the surface that a view shows


@dataclass(frozen=True, eq=False)
class PhotographedLight:
    """Radiance that the photographs show in all directions, and how much each direction counts."""

    panorama: Panorama
    weight: np.ndarray  # (h, 2h) 0 … 1

    @staticmethod
    def of(
        surfels: Surfels, surroundings: Surroundings, region: Region, views: Sequence[View], height: int
    ) -> "PhotographedLight":
        """Render the background from the region's centre, with `height` rows; what views show counts."""
        centre, radius = np.array(region.centre), region.radius
        seen = panorama(surroundings, centre, height, NEAR * radius)
        points = seen.points(FARTHEST * radius).reshape(-1, 3)
        shown = np.zeros(len(points))
        for view in views:
            with dr.suspend_grad():
                depth, alpha = render_depth(surfels, view.camera(), surroundings.surfels)
            shown += _shown(points, view, depth.numpy(), alpha.numpy())
        weight = np.minimum(shown / (SEEN_SHARE * len(views)), 1)
        return PhotographedLight(seen, weight.reshape(height, 2 * height))

    @cached_property
    def near(self) -> NearField:
        """The distances of the panorama."""
        return NearField(self.panorama.centre, self.panorama.nearness)

    @cached_property
    def _texels(self) -> tuple[Any, ...]:
        """Directions and radiance of the texels, the mean where it is unseen; how far seen; areas."""
        height, seen = len(self.weight), self.weight[..., None]
        area = np.broadcast_to(row_areas(height)[:, None] / (4 * height), self.weight.shape)
        shown = seen * area[..., None]
        mean = np.sum(shown * self.panorama.radiance, axis=(0, 1)) / max(shown.sum(), 1e-9)
        radiance = seen * self.panorama.radiance + (1 - seen) * mean
        direction, colour = (x.reshape(-1, 3).T.astype("f4") for x in (map_directions(height), radiance))
        weight, size = (upload(x.astype(np.float32)) for x in (self.weight, area))
        return mi.Vector3f(direction), mi.Color3f(colour), weight, size

    def difference(self, light: Light) -> Float:
        """How far a light is from the panorama, as `losses.light_difference` weighs it (width 1)."""
        direction, *photographed = self._texels
        return light_difference(light.radiance(direction), *photographed)

    def arrays(self) -> dict[str, np.ndarray]:
        """Its part of a checkpoint."""
        return {name: getattr(self.panorama, name) for name in PANORAMA} | {"weight": self.weight}

    @staticmethod
    def restored(arrays: Mapping[str, np.ndarray]) -> "PhotographedLight":
        """Restore `arrays`, bit for bit."""
        return PhotographedLight(Panorama(*(arrays[name] for name in PANORAMA)), arrays["weight"])


def _shown(points: np.ndarray, view: View, depth: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Whether points (N, 3) are visible in a view, not hidden by what is in front of them: (N,) bool."""
    row, column, inside = view.project(points)
    pixel = (np.clip(np.rint(x), 0, n - 1).astype(int) for x, n in ((row, view.height), (column, view.width)))
    surface = np.where(alpha > OPAQUE, depth, np.inf).reshape(view.height, view.width)
    return inside & (view.depth_of(points) <= BEHIND * surface[tuple(pixel)])
