"""Path tracing of views of a Mitsuba scene: its size, cameras, images and maps, the environment map."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.random import Generator

from mi_refgs.constants import GOLDEN_ANGLE, MAX_NUMBER
from mi_refgs.data.poses import poses_around
from mi_refgs.kernels.memory import BASE, PER_PATH, PER_STACKED_VALUE, require
from mi_refgs.render.display import image_array
from mi_refgs.shade.light.latlong import OVERSAMPLING, lat_long
from mi_refgs.splat.camera import Camera
from mi_refgs.synthesis.ground_truth import materials_at, triangles
from mi_refgs.synthesis.options import DatasetOptions, Range
from mi_refgs.types import Color3f, Scene, Vector3f

SAMPLES_PER_LAUNCH = 1 << 24  # most paths per launch; the path tracer keeps about 100 bytes for each
NEAR = 1e-4  # least distance of the near plane of a given sensor, radii of the object
FILL = 0.95  # of the shorter side that the object's bounding sphere fills, unless distances are given
BACKDROP = 2.0  # radii of the object: a flat shape that is larger is a floor or a wall
FLAT = 0.05  # least over largest spread of the points of a flat shape: the top of a table is one
MAPS = {"normal": "XYZ", "depth": "Y", "albedo": "RGBA", "roughness": "YA", "metallic": "YA"}
"""Channels of the maps of a view; A is 1 where the BSDF defines the material, 0 where it does not."""


def bounding_sphere(shapes: Sequence[Any]) -> tuple[np.ndarray, float]:
    """Centre (3,) of the shapes' bounding box, and the radius around it that contains every surface."""
    boxes = [shape.bbox() for shape in shapes]
    low, high = np.min([box.min for box in boxes], axis=0), np.max([box.max for box in boxes], axis=0)
    centre = (low.astype(np.float64) + high) / 2
    return centre, reach(shapes, centre)


def reach(shapes: Sequence[Any], centre: np.ndarray) -> float:
    """The radius around a centre (3,) that contains every surface of shapes; raises as `surface_mesh`."""
    return max(float(np.linalg.norm(triangles(shape)[0] - centre, axis=1).max()) for shape in shapes)


def object_of(shapes: Sequence[Any], options: DatasetOptions) -> tuple[list[Any], list[Any]]:
    """The shapes that are an object, and what is around it: floors and walls, flat and more than BACKDROP
    times as large, and domes and rooms, in whose bounding boxes its cameras stand. Lamps are neither."""
    solid = [shape for shape in shapes if not shape.is_emitter()]
    flat = [shape for shape in solid if _flat(triangles(shape)[0])]
    body = sorted(all_but(solid, flat), key=lambda shape: bounding_sphere([shape])[1])
    around = []
    while len(body) > 1:
        centre, radius = bounding_sphere(body[:-1])
        box, far = body[-1].bbox(), distances(options, radius)[0]
        if np.any(np.array(box.min) > centre - far) or np.any(np.array(box.max) < centre + far):
            break
        around.append(body.pop())
    if body:
        largest = BACKDROP * bounding_sphere(body)[1]
        around += [shape for shape in flat if bounding_sphere([shape])[1] > largest]
    return all_but(solid, around) or list(shapes), around


def _flat(points: np.ndarray) -> bool:
    spread = np.linalg.svd(np.cov(points.T), compute_uv=False)  # squared
    return bool(spread[2] <= FLAT**2 * spread[0])


def all_but(shapes: Sequence[Any], others: Sequence[Any]) -> list[Any]:
    """The shapes that are none of the others."""
    return [shape for shape in shapes if not any(shape is other for other in others)]


def distances(options: DatasetOptions, radius: float) -> Range:
    """Of the nearest and the farthest camera from the centre of an object of this radius, scene units."""
    filling = radius / (FILL * math.sin(math.radians(options.fov) / 2))
    return options.distance or (filling, filling)


def camera_poses(
    count: int, centre: np.ndarray, distance: Range, elevation: Range, azimuth: Range, rng: Generator
) -> np.ndarray:
    """World-from-camera matrices (count, 4, 4) in Mitsuba's frame that look at `centre`, z up: a jittered
    spherical Fibonacci lattice over the ranges of elevations and azimuths (degrees)."""
    low, high = (math.sin(math.radians(e)) for e in elevation)
    jitter = rng.uniform(-1 / 3, 1 / 3, (count, 2))
    z = low + (high - low) * (np.arange(count) + 0.5 + jitter[:, 0]) / count
    spacing = math.sqrt(2 * math.pi * (high - low) / count)
    ring = np.sqrt(1 - z**2)
    turn = rng.uniform(0, 2 * math.pi) + GOLDEN_ANGLE * np.arange(count) + jitter[:, 1] * spacing / ring
    angle = math.radians(azimuth[0]) + turn % (2 * math.pi) * (azimuth[1] - azimuth[0]) / 360
    outward = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    return poses_around(outward, centre, rng.uniform(*distance, (count, 1)))


def path_integrator(scene: Scene, **options: Any) -> Any:
    """Mitsuba's path tracer, that of volumes for a scene with media."""
    media = any(shape.is_medium_transition() for shape in scene.shapes())
    return mi.load_dict({"type": "volpath" if media else "path", **options})


def incident(scene: Scene, point: np.ndarray, options: DatasetOptions) -> np.ndarray:
    """Path-traced radiance that arrives at a point (3,), on the grid of `environment_image`."""
    integrator = path_integrator(scene, max_depth=options.max_depth)
    sampler = mi.load_dict({"type": "independent"})
    passes = max(1, options.spp // OVERSAMPLING**2)
    seeds = iter(np.random.SeedSequence(options.seed).generate_state(passes))

    def radiance(direction: Vector3f) -> Color3f:
        sampler.seed(int(next(seeds)), dr.width(direction))
        ray = mi.RayDifferential3f(mi.Point3f(*map(float, point)), direction)
        return integrator.sample(scene, sampler, ray)[0]

    return np.mean([lat_long(radiance, options.environment_height) for _ in range(passes)], axis=0)


@dataclass(frozen=True)
class Cameras:
    """The cameras of a data set around the bounding sphere of its object."""

    options: DatasetOptions
    centre: np.ndarray  # (3,)
    radius: float
    reach: float  # radius around the centre that contains all shapes
    objects: Sequence[Any] = ()  # the object's shapes in an open scene

    @property
    def distance(self) -> Range:
        return distances(self.options, self.radius)

    def of(self, split: str) -> list[tuple[np.ndarray, int]]:
        """Pose and seed of each view of a split, from independent random streams."""
        options, index = self.options, ("train", "test").index(split)
        rng, count = np.random.default_rng([options.seed, index]), options.count(split)
        poses = camera_poses(count, self.centre, self.distance, options.elevation, options.azimuth, rng)
        streams = (np.random.SeedSequence([options.seed, index, i]) for i in range(count))
        return [(p, int(stream.generate_state(1)[0])) for p, stream in zip(poses, streams, strict=True)]


class Tracer:
    """One sensor, with the lens of `like` if it is given, that moves from view to view, so that each kernel
    is compiled once. If `cameras` have the objects of an open scene, images show everything, also emitters,
    without alpha, and maps are of those shapes only."""

    def __init__(self, scene: Scene, cameras: Cameras, like: Camera | None = None) -> None:
        options, (low, high) = cameras.options, cameras.distance
        self.scene, self.cameras, self.objects = scene, cameras, cameras.objects
        self.width, self.height = options.resolution
        pixels, spp = self.width * self.height, options.spp
        paths = min(pixels * spp, SAMPLES_PER_LAUNCH)
        what = f"image: {self.width} × {self.height} pixels"
        require(BASE + PER_PATH * paths + 8 * PER_STACKED_VALUE * pixels, what, "make smaller ones")
        self.passes = -(-pixels * spp // SAMPLES_PER_LAUNCH)
        # The sampler's own grid of strata: it would round up by itself, but warn each time.
        strata = math.isqrt(-(-spp // self.passes))
        self.spp = strata * -(-spp // (self.passes * strata))
        opaque = bool(self.objects)
        self.integrator = path_integrator(scene, max_depth=options.max_depth, hide_emitters=not opaque)
        film: dict[str, Any] = {"type": "hdrfilm", "component_format": "float32", "rfilter": {"type": "box"}}
        film |= {"width": self.width, "height": self.height, "pixel_format": "rgb" if opaque else "rgba"}
        lens: dict[str, Any] = {"type": "perspective", "fov": options.fov, "fov_axis": "smaller"}
        least = NEAR * cameras.radius
        near, far = max(0.1 * (low - cameras.radius), least), 10 * (high + cameras.reach)
        lens |= {"near_clip": near, "far_clip": far}
        if like is not None:
            lens |= {"fov": math.degrees(2 * math.atan(0.5 * like.width / like.focal)), "fov_axis": "x"}
            lens |= {"near_clip": max(float(like.near[0]), least), "far_clip": MAX_NUMBER}
            for axis, centre, size in (("x", like.cx, like.width), ("y", like.cy, like.height)):
                lens[f"principal_point_offset_{axis}"] = 0.5 - float(centre[0]) / size
        self.sensor = mi.load_dict(lens | {"sampler": {"type": "multijitter"}, "film": film})
        self.params = mi.traverse(self.sensor)

    def image(self, pose: np.ndarray, seed: int) -> np.ndarray:
        """Premultiplied linear RGBA (H, W, 4) of one view; RGB (H, W, 3) of an open scene."""
        self._look(pose)
        seeds = [seed, *np.random.SeedSequence(seed).generate_state(self.passes)[1:]]
        image = np.zeros((self.height, self.width, 3 if self.objects else 4))
        options = {"sensor": self.sensor, "integrator": self.integrator, "spp": self.spp}
        with dr.suspend_grad():
            for s in seeds:
                image += np.array(mi.render(self.scene, seed=int(s), **options)) / self.passes
        return image

    def maps(self, pose: np.ndarray, image: np.ndarray) -> dict[str, np.ndarray]:
        """The maps of MAPS at pixel centres, where `image` shows something: not at hidden emitters."""
        self._look(pose)
        height, width = size = self.height, self.width
        with dr.suspend_grad():
            index = dr.arange(mi.UInt32, width * height)
            film = mi.Point2f((index % width + 0.5) / width, (index // width + 0.5) / height)
            ray, _ = self.sensor.sample_ray(0, 0.5, film, mi.Point2f(0.5))
            si = self.scene.ray_intersect(ray)
            normal = dr.select(dr.dot(si.sh_frame.n, ray.d) > 0, -si.sh_frame.n, si.sh_frame.n)
            wanted = si.is_valid() if not self.objects else mi.Bool(False)
            for shape in self.objects:
                wanted |= si.shape == mi.ShapePtr(shape)
            hit = (image_array(wanted, *size) > 0) & (image[..., 3] > 0 if image.shape[-1] == 4 else True)
            depth = ((np.array(si.p).T - pose[:3, 3]) @ pose[:3, 2]).reshape(height, width)
            found = {"normal": image_array(normal, *size), "depth": depth[..., None]}
            for name, (value, known) in materials_at(self.scene, si)._asdict().items():
                found[name] = image_array([*(value if dr.depth_v(value) > 1 else [value]), known], *size)
        return {name: np.where(hit[..., None], array, 0) for name, array in found.items()}

    def _look(self, pose: np.ndarray) -> None:
        self.params["to_world"] = mi.ScalarTransform4f(pose)
        self.params.update()
