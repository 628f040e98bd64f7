"""One sample through the middle of each pixel, for every method alike.

An ordinary render spreads its samples over the pixel, so its picture is the integral of radiance over the
pixel; a shader called once at the pixel's centre would be charged for that difference. Here Mitsuba's own
integrators are given a sensor that moves each of their samples to the centre of its pixel, the film has a box
filter, and the points to shade are the hits of the same rays: what differs between two pictures is shading.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

SENSOR = "pixel_centres"
"""Name under which the sensor is registered."""

VIEW_BINS = ((0.0, 0.1), (0.1, 0.2), (0.2, 0.5), (0.5, 1.0))
"""Ranges of n·v: 84° from the normal and beyond, 78° to 84°, 60° to 78°, and the rest."""


@functools.cache
def _register(variant: str) -> None:
    """Define and register the sensor for a variant; Mitsuba's base classes differ from one to the next."""

    class PixelCentres(mi.Sensor):
        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.inner = props["inner"]

        def sample_ray_differential(
            self, time: Any, sample1: Any, position: Any, sample3: Any, active: Any = True
        ) -> Any:
            size = mi.Vector2f(self.film().crop_size())
            centre = (dr.floor(dr.minimum(position * size, size - 1)) + 0.5) / size
            ray, weight = self.inner.sample_ray(time, sample1, centre, sample3, active)
            return mi.RayDifferential3f(ray), weight

        def to_string(self) -> str:
            return f"PixelCentres[{self.inner}]"

    mi.register_sensor(SENSOR, PixelCentres)


@dataclass(frozen=True)
class Look:
    """A perspective camera: where it stands, where it looks, and its field of view in degrees."""

    origin: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float


def make_sensor(look: Look, size: int) -> Any:
    """Sensor of size × size pixels that samples pixel centres only."""
    _register(mi.variant())
    box = {"type": "box"}
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": box, "component_format": "float32"}
    to_world = mi.ScalarTransform4f().look_at(look.origin, look.target, [0, 1, 0])
    camera = {"type": "perspective", "fov": look.fov, "to_world": to_world, "film": film}
    return mi.load_dict({"type": SENSOR, "inner": camera, "film": film, "sampler": {"type": "independent"}})


@dataclass(frozen=True)
class Points:
    """The P pixels of a view that show the object from its front, and what is seen there."""

    size: int  # edge of the picture
    pixel: Any  # mi.UInt32 (P), raster order
    position: Any  # mi.Point3f
    normal: Any  # mi.Vector3f, unit shading normals
    view: Any  # mi.Vector3f, unit, towards the camera
    offset: Any  # mi.Vector3f, geometric normals, for rays that leave the surface

    @property
    def count(self) -> int:
        """P."""
        return int(dr.width(self.pixel))

    def image(self, values: np.ndarray) -> np.ndarray:
        """(P, C) values as a picture (size, size, C), 0 elsewhere."""
        picture = np.zeros((self.size * self.size, values.shape[-1]), np.float32)
        picture[self.pixel.numpy()] = values
        return picture.reshape(self.size, self.size, -1)

    def of_image(self, picture: Any) -> np.ndarray:
        """The P values (P, 3) of a picture, float64."""
        return np.asarray(picture, np.float64).reshape(-1, 3)[self.pixel.numpy()]

    def n_dot_v(self) -> np.ndarray:
        """cos of the view angle (P,)."""
        return np.array(dr.dot(self.normal, self.view), np.float64)

    def gather(self, index: Any) -> Points:
        """The points at `index` (mi.UInt32)."""
        return Points(
            self.size,
            dr.gather(mi.UInt32, self.pixel, index),
            *(dr.gather(type(x), x, index) for x in (self.position, self.normal, self.view, self.offset)),
        )


def first_hits(scene: Any, sensor: Any, size: int) -> Any:
    """Mitsuba's intersections along the rays through all pixel centres, raster order, and the rays."""
    index = dr.arange(mi.UInt32, size * size)
    centre = mi.Point2f(mi.Float(index % size) + 0.5, mi.Float(index // size) + 0.5) / size
    ray, _ = sensor.sample_ray_differential(0.0, 0.5, centre, mi.Point2f(0.5))
    return scene.ray_intersect(ray), ray


def surface(scene: Any, sensor: Any, size: int) -> Points:
    """The points to shade; pixels whose shading normal faces away from the camera are left out."""
    hit, ray = first_hits(scene, sensor, size)
    front = hit.is_valid() & (dr.dot(hit.sh_frame.n, -ray.d) > 0)
    every = Points(size, dr.arange(mi.UInt32, size * size), hit.p, hit.sh_frame.n, -ray.d, hit.n)
    dr.eval(every.position, every.normal, every.view, every.offset)
    found = every.gather(dr.compress(front))
    dr.eval(found.position, found.normal, found.view, found.offset)
    return found


def rows(vectors: Any) -> np.ndarray:
    """Dr.Jit's vectors or colours of P points as (P, 3) float64."""
    return np.array(vectors, np.float64).T


def view_bins(n_dot_v: np.ndarray) -> dict[str, np.ndarray]:
    """Masks of the points (P,) in each range of VIEW_BINS that has any."""
    masks = {f"{a:g}-{b:g}": (n_dot_v > a) & (n_dot_v <= b) for a, b in VIEW_BINS}
    return {name: mask for name, mask in masks.items() if mask.any()}
