"""Scenes that benchmarks share: lights, views of pixel centres, an object under a light.

An ordinary render spreads its samples over the pixel, so its image is the integral of radiance over the
pixel; a shader called once at the pixel's centre would be charged for that difference. Here Mitsuba's own
integrators are given a sensor that moves each of their samples to the centre of its pixel, the film has a box
filter, and the points to shade are the hits of the same rays: two images differ by shading only."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.shade.light import lobe_matrices
from mi_refgs.shade.light.envmap import RADIANCE_FLOOR, EnvironmentLight

ROOT = Path(__file__).parents[2]
STUDIO = ROOT / "scenes" / "lights" / "studio.exr"
SUN_ELEVATION, SUN_AZIMUTH = 12.0, -90.0
"""Degrees above the horizon, and from -z towards +x: so low that a floor glints at a grazing angle."""
SUBSAMPLES = 8
"""Samples per side of a texel when Mitsuba's sky is baked; the sun's disc is about a texel wide."""
CHECKS = 12  # checks from pole to pole: 15 degrees each
BUILT_IN = ("constant", "gradient", "studio", "checker", "sunsky")  # in rising order of frequency


@dataclass(frozen=True)
class Light:
    """A named map (h, 2h, 3), float32 linear radiance in Mitsuba's orientation, up = +y."""

    name: str
    radiance: np.ndarray

    def emitter(self) -> dict[str, Any]:
        """Mitsuba's `envmap` with this map."""
        return {"type": "envmap", "bitmap": mi.Bitmap(self.radiance)}

    def environment(self, height: int) -> EnvironmentLight:
        """The product's light, averaged down to `height` rows."""
        same = height == len(self.radiance)
        rows = self.radiance if same else lobe_matrices.resample(self.radiance, height)
        return EnvironmentLight.from_radiance(rows)

    def prefiltered(self, height: int) -> Any:
        """The light as `mi_refgs.shade` takes it."""
        prefiltered = self.environment(height).prefilter()
        dr.eval(prefiltered.levels)
        return prefiltered

    def frequency(self) -> float:
        """Angular frequency: root mean square of the gradient over the mean radiance, 1/radian."""
        grey = self.radiance.mean(-1).astype(np.float64)
        h = len(grey)
        sine = np.maximum(np.sin(lobe_matrices.row_angles(h)), 0.5 * np.pi / h)[:, None]
        down = np.gradient(grey, axis=0) * (h - 1) / np.pi
        along = 0.5 * (np.roll(grey, -1, 1) - np.roll(grey, 1, 1)) * h / np.pi / sine
        weight = lobe_matrices.row_areas(h)[:, None]
        return float(np.sqrt(np.sum(weight * (down**2 + along**2)) / np.sum(weight * np.ones_like(grey))))


def directions(height: int, subsamples: int = 1) -> np.ndarray:
    """World directions (h·s, 2h·s, 3) of texels, or of s × s samples inside each."""
    step = (np.arange(subsamples) + 0.5) / subsamples - 0.5
    rows = (np.arange(height)[:, None] + step).ravel() * np.pi / (height - 1)
    columns = (np.arange(2 * height)[:, None] + 0.5 + step).ravel() * np.pi / height
    θ, φ = np.meshgrid(np.clip(rows, 0, np.pi), columns, indexing="ij")
    return np.stack([np.sin(θ) * np.sin(φ), np.cos(θ), -np.sin(θ) * np.cos(φ)], axis=-1)


def _sunsky(height: int) -> np.ndarray:
    """Mitsuba's `sunsky`, turned from z up to y up and averaged over texels, energy kept."""
    e, a = np.radians([SUN_ELEVATION, SUN_AZIMUTH])
    sun = (np.cos(e) * np.sin(a), np.sin(e), -np.cos(e) * np.cos(a))
    up = [float(sun[0]), float(-sun[2]), float(sun[1])]  # z up
    emitter = mi.load_dict({"type": "sunsky", "sun_direction": up})
    emitter.set_scene(mi.load_dict({"type": "scene", "ball": {"type": "sphere"}}))
    out = np.empty((height, 2 * height, 3))
    d = directions(height, SUBSAMPLES)
    weight = np.sqrt(np.maximum(1 - d[:, 0, 1] ** 2, 0))  # sinθ of the sub-rows
    for row in range(height):
        sub = slice(row * SUBSAMPLES, (row + 1) * SUBSAMPLES)
        x, y, z = d[sub].reshape(-1, 3).T.astype(np.float32)
        si = dr.zeros(mi.SurfaceInteraction3f, len(x))
        si.wi = -mi.Vector3f(mi.Float(x), mi.Float(-z), mi.Float(y))
        values = np.array(emitter.eval(si)).T.reshape(SUBSAMPLES, 2 * height, SUBSAMPLES, 3)
        out[row] = np.einsum("s,sjtc->jc", weight[sub], values) / (SUBSAMPLES * weight[sub].sum())
    return out


def _built_in(name: str, height: int) -> np.ndarray:
    d = directions(height)
    if name == "constant":
        return np.ones((height, 2 * height, 3))
    if name == "gradient":
        return 1 + d[..., 1:2] * np.array([0.3, 0.6, 0.9]) + 0.3 * d[..., :1]
    if name == "checker":
        rows = np.arange(height) * CHECKS // height
        columns = np.arange(2 * height) * CHECKS // height
        odd = (rows[:, None] + columns[None]) % 2 == 1
        return np.where(odd[..., None], [1.9, 1.8, 1.6], [0.1, 0.2, 0.3])
    if name == "sunsky":
        return _sunsky(height)
    return EnvironmentLight.from_file(STUDIO, height).radiance().numpy().astype(np.float64)


def make_light(name: str, height: int) -> Light:
    """A built-in light, or the lat-long image file of that name, on `height` rows and scaled to a mean of 1.

    Raises InputError for a name that is neither."""
    if name in BUILT_IN:
        radiance = _built_in(name, height)
    elif Path(name).exists():
        radiance = EnvironmentLight.from_file(name, height).radiance().numpy().astype(np.float64)
    else:
        what = f"neither one of {', '.join(BUILT_IN)} nor a file"
        raise InputError(what, name, "light", "give an EXR or HDR file")
    mean = float(np.average(radiance.mean((1, 2)), weights=lobe_matrices.row_areas(height)))
    radiance = np.maximum(radiance / mean, RADIANCE_FLOOR)
    return Light(Path(name).stem, radiance.astype(np.float32))


SENSOR = "pixel_centres"  # name under which the sensor is registered

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
    """A perspective camera: position, target, and field of view in degrees."""

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

    size: int  # edge of the image
    pixel: Any  # mi.UInt32 (P), raster order
    position: Any  # mi.Point3f
    normal: Any  # mi.Vector3f, unit shading normals
    view: Any  # mi.Vector3f, unit, towards the camera
    offset: Any  # mi.Vector3f, geometric normals, for rays that leave the surface

    @property
    def count(self) -> int:
        """P."""
        return int(dr.width(self.pixel))

    def of_image(self, image: Any) -> np.ndarray:
        """The P values (P, 3) of an image, float64."""
        return np.asarray(image, np.float64).reshape(-1, 3)[self.pixel.numpy()]

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
