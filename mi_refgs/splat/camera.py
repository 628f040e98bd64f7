"""Pinhole camera: a rigid map from the world, and focal lengths in signed pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.constants import RIGID_TOLERANCE, tile_size
from mi_refgs.errors import InputError
from mi_refgs.kernels.motion import motion_of, part_of, rotation_part, turned_by
from mi_refgs.types import Float, Point2f, Point3f, Sensor, UInt32, Vector3f


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: the point p of its frame lands on the pixel (fx·p.x/p.z + cx, fy·p.y/p.z + cy), both
    focal lengths negative (+x left, +y up). Numbers but the image size are opaque: views share kernels. If
    `displaced` or `attached` under AD, it has a `motion`."""

    width: int  # pixels
    height: int  # pixels
    fx: mi.Float  # pixels, signed
    fy: mi.Float  # pixels, signed
    cx: mi.Float  # pixels; the image centre is width / 2
    cy: mi.Float  # pixels
    rotation: mi.Matrix3f  # camera from world
    origin: mi.Point3f  # world, rounded to float32
    origin_rest: mi.Vector3f  # exact origin - `origin`: larger than a surfel far from the world's origin
    near: mi.Float  # scene units along the camera's z axis
    focal: float  # |fx| on the host, decides the size of tiles
    offset: tuple[int, int] = (0, 0)  # pixels, of a crop window in its film; tiles are those of the film
    film: tuple[int, int] | None = None  # pixels, size of the film; None: the camera has all of it
    mirrored: bool = False  # whether the pose is a reflection
    fine: bool = False  # set by the splatter where normals vary over surfels: tiles are smaller
    motion: Float | None = None
    """(6,) of `kernels.motion`: rotation about the origin, translation (scene units)."""

    @property
    def tile(self) -> tuple[int, int]:
        """Width and height of a tile, pixels."""
        return tile_size(self.focal, self.fine)

    @property
    def centre(self) -> tuple[Float, Float]:
        """The principal point on the film, pixels."""
        if self.film is None:
            return self.cx, self.cy
        x, y = (dr.opaque(mi.Float, offset) for offset in self.offset)
        return self.cx + x, self.cy + y

    @property
    def tile_offset(self) -> tuple[int, int]:
        """Column and row of the first pixel in its tile."""
        return self.offset[0] % self.tile[0], self.offset[1] % self.tile[1]

    @property
    def tiles(self) -> tuple[int, int]:
        """Columns and rows of tiles."""
        size = self.width + self.tile_offset[0], self.height + self.tile_offset[1]
        return -(-size[0] // self.tile[0]), -(-size[1] // self.tile[1])

    @staticmethod
    def from_pose(
        width: int,
        height: int,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        to_world: np.ndarray,
        near: float = 0,
    ) -> Camera:
        """Camera from a rigid (4, 4) world-from-camera matrix (else InputError), signed focal lengths and
        centre in pixels, and near in scene units."""
        matrix = np.asarray(to_world, dtype=np.float64)
        rotation = matrix[:3, :3]
        if not np.isfinite(matrix).all() or np.abs(rotation.T @ rotation - np.eye(3)).max() > RIGID_TOLERANCE:
            what, remedy = "must be a rotation and a translation", "remove scale and shear"
            raise InputError(what, "camera", "to_world", remedy)

        def opaque(*numbers: float) -> list[Float]:
            return [dr.opaque(mi.Float, float(x)) for x in numbers]

        mirrored = bool(np.linalg.det(rotation) < 0)
        turn = mi.Matrix3f([opaque(*row) for row in rotation.T])
        origin = matrix[:3, 3].astype(np.float32)
        place, rest = mi.Point3f(*opaque(*origin)), mi.Vector3f(*opaque(*(matrix[:3, 3] - origin)))
        lens = dict(zip(("fx", "fy", "cx", "cy", "near"), opaque(fx, fy, cx, cy, near), strict=True))
        at = {"rotation": turn, "origin": place, "origin_rest": rest}
        return Camera(width, height, **at, focal=abs(float(fx)), mirrored=mirrored, **lens)

    @staticmethod
    def look_at(
        origin: Sequence[float] | np.ndarray,
        target: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
        up: Sequence[float] | np.ndarray = (0.0, 0.0, 1.0),
        *,
        fov: float = 40.0,
        size: int | tuple[int, int] = 256,
        near: float | None = None,
    ) -> Camera:
        """Camera at `origin` that looks at `target`, world, `up` upwards in the image; fov: degrees across
        the width; size: width and height, or both as one, pixels; near: scene units, by default 1/1000 of the
        distance. Raises InputError for values that define no view."""
        width, height = (int(size), int(size)) if isinstance(size, int | np.integer) else size
        eye, forward, top = (np.asarray(x, dtype=np.float64) for x in (origin, target, up))
        forward = forward - eye
        distance, left = float(np.linalg.norm(forward)), np.cross(top, forward)
        if not (0 < fov < 180 and width > 0 and height > 0):
            what = f"fov, size: {fov:g} degrees on {width} × {height} pixels"
            raise InputError(what, "camera", remedy="give an angle below 180, and pixels")
        if not (distance > 0 and np.linalg.norm(left) > 1e-9 * distance * np.linalg.norm(top)):
            what, remedy = "no direction besides that of the view", "move `origin`, or turn `up`"
            raise InputError(what, "camera", "up", remedy)
        left, forward = left / np.linalg.norm(left), forward / distance
        pose = np.eye(4)
        pose[:3] = np.stack([left, np.cross(forward, left), forward, eye], axis=1)
        focal = -0.5 * width / math.tan(math.radians(fov) / 2)
        near = 1e-3 * distance if near is None else near
        return Camera.from_pose(width, height, focal, focal, width / 2, height / 2, pose, near)

    @staticmethod
    def from_sensor(sensor: Sensor) -> Camera:
        """Camera of a Mitsuba `perspective` sensor; raises InputError for every other sensor."""
        params = mi.traverse(sensor)
        if "x_fov" not in params or "aperture_radius" in params:
            what = f"sensor '{sensor.id()}': type: refgs has pinhole cameras only"
            raise InputError(what, remedy="use a `perspective` sensor")
        width, height = (int(x) for x in sensor.film().crop_size())
        matrix = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
        # A uniform scale in to_world moves no ray of a pinhole; take it out before the rigidity check.
        matrix[:3, :3] /= np.cbrt(abs(np.linalg.det(matrix[:3, :3])))
        # Field of view, crop window and principal point follow from the sensor's own corner rays.
        corners = mi.Point2f(mi.Float([0, 1, 0]), mi.Float([0, 0, 1]))
        ray, _ = sensor.sample_ray(mi.Float(0), mi.Float(0.5), corners, mi.Point2f(0.5))
        local = np.array(ray.d, dtype=np.float64).reshape(3, 3).T @ matrix[:3, :3]
        slope = local[:, :2] / local[:, 2:]
        fx = width / (slope[1, 0] - slope[0, 0])
        fy = height / (slope[2, 1] - slope[0, 1])
        cx, cy, near = -fx * slope[0, 0], -fy * slope[0, 1], float(params["near_clip"])
        camera = Camera.from_pose(width, height, fx, fy, cx, cy, matrix, near)
        x, y = (int(offset) for offset in sensor.film().crop_offset())
        size = int(sensor.film().size()[0]), int(sensor.film().size()[1])
        return replace(camera, offset=(x, y), film=None if size == (width, height) else size)

    def attached(self, sensor: Sensor) -> Camera:
        """The camera with derivatives by its sensor's `x_fov`, principal point and (rigid) `to_world`."""
        camera, matrix, params = self, sensor.world_transform().matrix, mi.traverse(sensor)
        if dr.grad_enabled(matrix):
            moved = (matrix[i, 3] for i in range(3))
            camera = replace(camera, motion=motion_of(rotation_part(matrix), *moved))
        if dr.grad_enabled(angle := params["x_fov"]):
            slope = dr.tan(dr.deg2rad(0.5 * angle))
            factor = dr.detach(slope) / slope
            camera = replace(camera, fx=self.fx * factor, fy=self.fy * factor)
        for axis, pixels in zip("xy", self.film or (self.width, self.height), strict=True):
            if dr.grad_enabled(share := params[f"principal_point_offset_{axis}"]):
                centre = getattr(self, f"c{axis}") - pixels * (share - dr.detach(share))
                camera = replace(camera, **{f"c{axis}": centre})
        return camera

    def towards(self, point: Point3f) -> Vector3f:
        """Vector in the world from the camera to a point, with the precision of float32 of the vector."""
        vector = (mi.Vector3f(point) - mi.Vector3f(self.origin)) - self.origin_rest
        return vector if self.motion is None else vector - part_of(self.motion, 3, vector)

    def along(self, ray: Vector3f, distance: Float) -> Point3f:
        """Point in the world at a distance along each of the camera's rays, in lengths of the ray."""
        vector = distance * ray
        return self.origin + (vector if self.motion is None else vector + part_of(self.motion, 3, vector))

    def to_camera(self, point: Point3f) -> Vector3f:
        """World point to camera frame."""
        return self.rotate_to_camera(self.towards(point))

    def rotate_to_camera(self, vector: Vector3f) -> Vector3f:
        """World vector to camera frame."""
        return self.rotation @ turned_by(self.motion, vector, -1)

    def rotate_to_world(self, vector: Vector3f) -> Vector3f:
        """Vector of the camera frame to the world."""
        return turned_by(self.motion, self.rotation.T @ vector)

    def pixel_centres(self, raster: UInt32 | None = None) -> Point2f:
        """Centres (i + ½, j + ½) of pixels, by their index in the image; of all pixels by default."""
        index = dr.arange(mi.UInt32, self.width * self.height) if raster is None else raster
        return mi.Point2f(index % self.width + 0.5, index // self.width + 0.5)

    def rays(self, raster: UInt32 | None = None, offset: tuple[float, float] = (0.0, 0.0)) -> Vector3f:
        """World directions through `pixel_centres` + `offset`, pixels: 1 along the viewing axis, not unit."""
        pixel = self.pixel_centres(raster) + mi.Vector2f(*offset)
        local = mi.Vector3f((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy, 1)
        return self.rotate_to_world(local)

    def pose(self) -> np.ndarray:
        """The rigid world-from-camera matrix (4, 4) float64."""
        pose = np.eye(4)
        pose[:3, :3] = np.array(self.rotation, dtype=np.float64).reshape(3, 3).T
        pose[:3, 3] = sum(np.array(x, np.float64).ravel() for x in (self.origin, self.origin_rest))
        return pose

    def moved(self, to_world: np.ndarray) -> Camera:
        """The same lens at another pose (4, 4); raises InputError as `from_pose` does."""
        fx, fy, cx, cy, near = (float(x[0]) for x in (self.fx, self.fy, self.cx, self.cy, self.near))
        return Camera.from_pose(self.width, self.height, fx, fy, cx, cy, to_world, near)

    def displaced(self, rotation: mi.Matrix3f, centre: Point3f, translation: Vector3f) -> Camera:
        """The camera after a rotation of the world about `centre` and a translation, of width 1, under AD."""
        lever = -self.towards(centre)
        change = rotation @ lever - lever + translation  # of the origin; small, so it keeps its digits
        origin = dr.detach(mi.Point3f(self.origin + self.origin_rest + change))
        rest = (mi.Vector3f(self.origin) - mi.Vector3f(origin)) + self.origin_rest + dr.detach(change)
        enabled = dr.grad_enabled(rotation, translation)
        motion = motion_of(rotation, *change) if enabled else None
        matrix = self.rotation @ dr.detach(rotation).T
        dr.eval(matrix, origin, rest, motion)
        return replace(self, rotation=matrix, origin=origin, origin_rest=rest, motion=motion)

    def resized(self, size: int | tuple[int, int]) -> Camera:
        """The same view with another size, or longer side, pixels; raises InputError if there are none."""
        if isinstance(size, int | np.integer):
            ratio, least = size / max(self.width, self.height), min(size, 1)
            size = max(least, round(self.width * ratio)), max(least, round(self.height * ratio))
        if min(size) < 1:
            raise InputError(f"{size[0]} × {size[1]} pixels", "camera", "size", "give whole numbers from 1")
        x, y = size[0] / self.width, size[1] / self.height
        scaled = {
            name: dr.opaque(mi.Float, float(getattr(self, name)[0]) * ratio)
            for name, ratio in (("fx", x), ("cx", x), ("fy", y), ("cy", y))
        }
        whole = replace(self, offset=(0, 0), film=None)
        return replace(whole, width=size[0], height=size[1], focal=self.focal * x, **scaled)

    def window(self, x: int, y: int, width: int, height: int) -> Camera:
        """The part of the view from pixel (x, y), even outside; tiles and random numbers stay, kernels at
        multiples of PATCH_EDGE."""
        cx, cy = self.cx - dr.opaque(mi.Float, x), self.cy - dr.opaque(mi.Float, y)
        offset = self.offset[0] + x, self.offset[1] + y
        film = self.film or (self.width, self.height)
        return replace(self, width=width, height=height, cx=cx, cy=cy, offset=offset, film=film)

    def image_index(self, raster: UInt32 | None = None) -> UInt32:
        """Index on the film of pixels of a window (default: all); `raster` itself without a window."""
        if self.film is None:
            return raster
        index = dr.arange(mi.UInt32, self.width * self.height) if raster is None else raster
        first = dr.opaque(mi.UInt32, (self.offset[1] * self.film[0] + self.offset[0]) % 2**32)
        return index // self.width * self.film[0] + index % self.width + first

    def supersampled(self, factor: int) -> Camera:
        """The same view with factor² pixels for each pixel."""
        if factor == 1:
            return self
        names = ("width", "height", "fx", "fy", "cx", "cy", "focal")
        scaled: dict[str, Any] = {name: getattr(self, name) * factor for name in names}
        offset = self.offset[0] * factor, self.offset[1] * factor
        film = None if self.film is None else (self.film[0] * factor, self.film[1] * factor)
        return replace(self, offset=offset, film=film, **scaled)
