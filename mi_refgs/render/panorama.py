"""Panorama of the background: its radiance and distance in all directions from one point."""

from dataclasses import dataclass, replace
from itertools import product

import drjit as dr
import numpy as np
from scipy.ndimage import map_coordinates

from mi_refgs.render.pipeline import Request, SurfelScene, render
from mi_refgs.render.surroundings import Surroundings, nothing_around
from mi_refgs.shade.light.lobe_matrices import map_directions
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.table import Surfels

MARGIN = 2  # pixels of a cube face beyond its edges, so that interpolation never leaves an image
OPAQUE = 0.5  # opacity from which a pixel shows a surface
LARGEST = 0.2  # deviation over distance above which a Gaussian is left out: it would cover cube faces


@dataclass(frozen=True)
class Panorama:
    """Lat-long maps of h rows and 2 h columns, in the orientation of `EnvironmentLight`."""

    centre: np.ndarray  # (3,) scene units
    radiance: np.ndarray  # (h, 2h, 3) linear
    nearness: np.ndarray  # (h, 2h) 1 / distance from the centre; 0 where only the background map is seen

    def points(self, farthest: float) -> np.ndarray:
        """Points (h, 2h, 3) that are seen in the directions of the texels, at most `farthest` away."""
        distance = 1 / np.maximum(self.nearness, 1 / farthest)
        return self.centre + distance[..., None] * map_directions(len(distance))


def panorama(surroundings: Surroundings, centre: np.ndarray, height: int, near: float) -> Panorama:
    """Render surroundings beyond `near` from a `centre` (3,), by six cameras, to maps of `height` rows."""
    shading, nothing = Shading(reflectance="radiance", at="surfel"), nothing_around(surroundings.surfels)
    if surroundings.surfels.primitive.first_order:  # without those whose projection from there is wrong
        raw = surroundings.surfels.to_numpy()
        distance = np.linalg.norm(raw["position"] - centre, axis=-1)
        small = surroundings.surfels.primitive.extent(raw)[1].max(axis=-1) < LARGEST * distance
        kept = Surfels.from_numpy({name: values[small] for name, values in raw.items()})
        surroundings = replace(surroundings, surfels=kept)
    scene = SurfelScene(nothing, shading, surroundings=surroundings)
    directions = map_directions(height)
    radiance, nearness = np.zeros((height, 2 * height, 3)), np.zeros((height, 2 * height))
    size = height + 2 * MARGIN
    fov = 2 * np.degrees(np.arctan(size / height))
    for axis, sign in product(range(3), (1, -1)):
        forward, up = sign * np.eye(3)[axis], np.eye(3)[axis - 1]
        camera = Camera.look_at(centre, centre + forward, up, fov=fov, size=size, near=near)
        with dr.suspend_grad():
            frame = render(scene, camera, Request(("depth",), forward_only=True))
        alpha = frame.alpha.numpy()
        image = frame.radiance.numpy() + (1 - alpha) * frame.background.numpy()

        # Texels of this face, and where its image shows them.
        along = directions @ forward
        own = along >= np.abs(directions).max(axis=-1)
        local = directions[own] @ camera.pose()[:3, :3]
        column, row = (float(camera.fx[0]) * local[:, i] / local[:, 2] + size / 2 - 0.5 for i in (0, 1))
        planes = [map_coordinates(plane.reshape(size, size), (row, column), order=1) for plane in image]
        radiance[own] = np.stack(planes, axis=-1)
        # Distances jump at outlines: no mean of near and far.
        at = np.rint(row).astype(int), np.rint(column).astype(int)
        depth = np.where(alpha > OPAQUE, frame.depth.numpy(), np.inf).reshape(size, size)[at]
        nearness[own] = along[own] / depth
    return Panorama(np.asarray(centre, np.float64), radiance, nearness)
