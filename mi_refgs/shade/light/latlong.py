"""Lat-long images of radiance that is known by direction: of lights, and of emitters of Mitsuba."""

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.shade.light.lobe_matrices import resample
from mi_refgs.types import Color3f, Scene, Vector3f

Z_UP = (1, 0, 0), 90.0  # axis and degrees that rotate y of a lat-long map to z
OVERSAMPLING = 4  # directions per texel and axis of a rotated map: a small sun keeps its energy


def lat_long(
    radiance: Callable[[Vector3f], Color3f], height: int, oversampling: int = OVERSAMPLING
) -> np.ndarray:
    """Radiance (height, 2·height, 3) by world direction, on the grid of `environment_image`."""
    rows = (height - 1) * oversampling + 1
    columns = 2 * height * oversampling
    index = dr.arange(mi.UInt32, rows * columns)
    phi = (index % columns + 0.5) * (2 * dr.pi / columns)
    theta = (index // columns) * (dr.pi / (rows - 1))
    direction = mi.Vector3f(dr.sin(theta) * dr.sin(phi), dr.cos(theta), -dr.sin(theta) * dr.cos(phi))
    # A constant emitter returns one value for all directions.
    found = np.array(radiance(direction) + dr.zeros(mi.Float, rows * columns), np.float64)
    image = resample(found.T.reshape(rows, columns, 3), height)
    image[[0, -1]] = image[[0, -1]].mean(axis=1, keepdims=True)  # a pole is one point
    return image.astype(np.float32)


def environment_image(scene: Scene, height: int) -> np.ndarray:
    """Radiance (height, 2·height, 3) of the scene's environment, on the grid of Mitsuba's `envmap`. First row
    at +y, last at -y; column 0 beside −z, turning to +x. An `envmap` of this size that is not rotated is
    returned unchanged; finer ones are averaged."""
    emitter = scene.environment()
    params = mi.traverse(emitter)
    if "data" in params and np.array_equal(np.array(params["to_world"].matrix).reshape(4, 4), np.eye(4)):
        # Without the columns that Mitsuba adds on either side for its interpolation.
        texels = np.array(params["data"], dtype=np.float64)[:, 1:-1, :3]
        return (resample(texels, height) * np.array(params["scale"])).astype(np.float32)

    def radiance(direction: Vector3f) -> Color3f:
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
        si.wi = -direction
        return emitter.eval(si)

    return lat_long(radiance, height)
