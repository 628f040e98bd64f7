"""Blending weights of surfels: how much of an image each one is responsible for."""

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.splat import Camera, Composited, TileLists, composite, list_by_tile, project
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Float


@dataclass(frozen=True)
class BlendedView:
    """Features (N,) of all tables, one after the other, and their blended maps, attached to them alone."""

    features: list[Float]
    maps: Composited
    lists: TileLists

    @staticmethod
    def of(surfels: Sequence[Surfels], camera: Camera, values: Sequence[Float | float]) -> "BlendedView":
        count = sum(table.count for table in surfels)
        features = [dr.opaque(mi.Float, 0, count) + value for value in values]
        dr.enable_grad(features)
        footprints = project([table.detach() for table in surfels], camera)
        lists = list_by_tile(footprints, camera, features)
        return BlendedView(features, composite(footprints, features, lists), lists)

    @property
    def tiles(self) -> np.ndarray:
        """Tiles (N,) in whose lists each surfel is: what it costs, wherever it is hidden."""
        return np.bincount(np.array(self.lists.surfel_from_pair), minlength=len(self.features[0]))

    def sums(self, maps: Sequence[Float | float]) -> list[np.ndarray]:
        """Sums Σ w m (N,) float64 of blending weights, for a map m (H·W,) per feature f: gradients of
        Σ m Σ w f by f, whatever f is. A map of 1 gives pixels."""
        pairs = zip(dr.detach([*maps]), self.maps.features, strict=True)
        total = dr.sum(sum(m * image for m, image in pairs))
        if dr.grad_enabled(total):  # unless the view shows nothing
            dr.backward(total)
        return [np.array(dr.grad(feature), dtype=np.float64) for feature in self.features]
