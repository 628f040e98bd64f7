"""Path tracing around a Mitsuba scene: its size, camera poses, one view, the environment."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mi_refgs.constants import GOLDEN_ANGLE
from mi_refgs.data.materials import materials_at
from mi_refgs.shade import lobe_matrices

SAMPLES_PER_LAUNCH = 1 << 24
"""Largest number of paths traced at once; the path tracer keeps about 100 bytes for each."""
SURFACE_SAMPLES = 4096
"""Points on each shape that measure the scene's size; the farthest is found to about 1 %."""
ENVIRONMENT_OVERSAMPLING = 4
"""Directions per texel and axis of an environment that is turned, so that a small sun keeps its energy."""
MAPS = {"normal": "XYZ", "depth": "Y", "albedo": "RGBA", "roughness": "YA", "metallic": "YA"}
"""Channels of the maps of a view; A is 1 where the BSDF defines the material, 0 where it does not."""


def bounding_sphere(scene: Any) -> tuple[np.ndarray, float]:
    """Centre (3,) of the shapes' bounding box, and the radius around it that holds every surface."""
    import drjit as dr
    import mitsuba as mi

    box = scene.bbox()
    centre = (np.array(box.min, dtype=np.float64) + np.array(box.max, dtype=np.float64)) / 2
    side = math.isqrt(SURFACE_SAMPLES)
    x, y = dr.meshgrid(dr.linspace(mi.Float, 0, 1 - 1e-6, side), dr.linspace(mi.Float, 0, 1 - 1e-6, side))
    radius = 0.0
    for shape in scene.shapes():
        if shape.is_mesh():
            points = np.array(shape.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
        else:
            points = np.array(shape.sample_position(0.0, mi.Point2f(x, y)).p, dtype=np.float64).T
        radius = max(radius, float(np.linalg.norm(points - centre, axis=1).max()))
    return centre, radius


def camera_poses(
    count: int, centre: np.ndarray, distance: float, elevation: tuple[float, float], rng: np.random.Generator
) -> np.ndarray:
    """World-from-camera matrices (count, 4, 4) in Mitsuba's frame that look at `centre`, z up.

    A spherical Fibonacci lattice over the band of elevations (degrees): equal areas, turned by a random
    azimuth and jittered by a third of its spacing.
    """
    low, high = (math.sin(math.radians(e)) for e in elevation)
    jitter = rng.uniform(-1 / 3, 1 / 3, (count, 2))
    z = low + (high - low) * (np.arange(count) + 0.5 + jitter[:, 0]) / count
    spacing = math.sqrt(2 * math.pi * (high - low) / count)
    ring = np.sqrt(1 - z**2)
    azimuth = rng.uniform(0, 2 * math.pi) + GOLDEN_ANGLE * np.arange(count) + jitter[:, 1] * spacing / ring
    outward = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)
    return poses_around(outward, centre, distance)


def poses_around(outward: np.ndarray, centre: np.ndarray, distance: float) -> np.ndarray:
    """World-from-camera matrices (N, 4, 4) in Mitsuba's frame, z up, that look at `centre` from unit `outward`
    (N, 3) directions, none of them ±z."""
    left = np.cross([0.0, 0.0, 1.0], -outward)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    up = np.cross(-outward, left)
    poses = np.tile(np.eye(4), (len(outward), 1, 1))
    poses[:, :3, :] = np.stack([left, up, -outward, centre + distance * outward], axis=2)
    return poses


def environment_image(scene: Any, height: int) -> np.ndarray:
    """Radiance (height, 2·height, 3) of the scene's environment, on the grid of Mitsuba's `envmap`.

    Shown by an `envmap` with an identity `to_world` it is the same light: first row at +y, last at -y;
    column 0 beside −z, turning to +x. An `envmap` of this size that is not turned comes back unchanged; what
    is finer is averaged (`shade.lobe_matrices.resample`).
    """
    import drjit as dr
    import mitsuba as mi

    emitter = scene.environment()
    params = mi.traverse(emitter)
    if "data" in params and np.array_equal(np.array(params["to_world"].matrix).reshape(4, 4), np.eye(4)):
        # Without the columns that Mitsuba adds on either side for its interpolation.
        texels = np.array(params["data"], dtype=np.float64)[:, 1:-1, :3]
        return (lobe_matrices.resample(texels, height) * np.array(params["scale"])).astype(np.float32)
    rows = (height - 1) * ENVIRONMENT_OVERSAMPLING + 1
    columns = 2 * height * ENVIRONMENT_OVERSAMPLING
    index = dr.arange(mi.UInt32, rows * columns)
    phi = (index % columns + 0.5) * (2 * dr.pi / columns)
    theta = (index // columns) * (dr.pi / (rows - 1))
    si = dr.zeros(mi.SurfaceInteraction3f, rows * columns)
    si.wi = -mi.Vector3f(dr.sin(theta) * dr.sin(phi), dr.cos(theta), -dr.sin(theta) * dr.cos(phi))
    # A constant emitter answers with one value for all directions.
    radiance = np.array(emitter.eval(si) + dr.zeros(mi.Float, rows * columns))
    image = lobe_matrices.resample(radiance.T.reshape(rows, columns, 3), height)
    image[[0, -1]] = image[[0, -1]].mean(axis=1, keepdims=True)  # a pole is one point
    return image.astype(np.float32)


class Tracer:
    """One sensor that moves from view to view, so that each kernel is compiled once."""

    def __init__(
        self, scene: Any, *, size: int, fov: float, spp: int, max_depth: int, near: float, far: float
    ) -> None:
        import mitsuba as mi

        self.scene, self.size = scene, size
        self.passes = -(-size * size * spp // SAMPLES_PER_LAUNCH)
        # The sampler's own grid of strata: it would round up by itself, but warn each time.
        strata = math.isqrt(-(-spp // self.passes))
        self.spp = strata * -(-spp // (self.passes * strata))
        self.integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "hide_emitters": True})
        self.sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov": fov,
                "near_clip": near,
                "far_clip": far,
                "sampler": {"type": "multijitter"},
                "film": {
                    "type": "hdrfilm",
                    "width": size,
                    "height": size,
                    "pixel_format": "rgba",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                },
            }
        )
        self.params = mi.traverse(self.sensor)

    def picture(self, pose: np.ndarray, seed: int) -> np.ndarray:
        """Premultiplied linear RGBA (H, W, 4) of one view."""
        import drjit as dr
        import mitsuba as mi

        self._look(pose)
        seeds = [seed, *np.random.SeedSequence(seed).generate_state(self.passes)[1:]]
        image = np.zeros((self.size, self.size, 4))
        with dr.suspend_grad():
            for s in seeds:
                part = mi.render(
                    self.scene, sensor=self.sensor, integrator=self.integrator, spp=self.spp, seed=int(s)
                )
                image += np.array(part) / self.passes
        return image

    def maps(self, pose: np.ndarray, covered: np.ndarray) -> dict[str, np.ndarray]:
        """The maps of MAPS at the pixels' centres, where `covered` (H, W): a lamp that the picture hides has none.

        A mean over a pixel at an edge would belong to no surface.
        """
        import drjit as dr
        import mitsuba as mi

        self._look(pose)
        size = self.size

        def plane(array: Any) -> np.ndarray:
            return np.broadcast_to(np.array(array, dtype=np.float64), size * size).reshape(size, size)

        with dr.suspend_grad():
            index = dr.arange(mi.UInt32, size * size)
            film = mi.Point2f((index % size + 0.5) / size, (index // size + 0.5) / size)
            ray, _ = self.sensor.sample_ray(0, 0.5, film, mi.Point2f(0.5))
            si = self.scene.ray_intersect(ray)
            normal = dr.select(dr.dot(si.sh_frame.n, ray.d) > 0, -si.sh_frame.n, si.sh_frame.n)
            hit = plane(si.is_valid()).astype(bool) & covered
            depth = ((np.array(si.p).T - pose[:3, 3]) @ pose[:3, 2]).reshape(size, size)
            found = {
                "normal": np.array(normal).T.reshape(size, size, 3),
                "depth": depth[..., None],
            }
            for name, (value, known) in vars(materials_at(self.scene, si)).items():
                planes = [plane(x) for x in (value if dr.depth_v(value) > 1 else [value])]
                found[name] = np.stack([*planes, plane(known)], axis=-1)
        return {name: np.where(hit[..., None], array, 0) for name, array in found.items()}

    def _look(self, pose: np.ndarray) -> None:
        import mitsuba as mi

        self.params["to_world"] = mi.ScalarTransform4f(pose)
        self.params.update()
