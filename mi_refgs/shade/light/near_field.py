"""Environment maps of surfaces at finite distances, such as a room: lookups from points beside the centre."""

import io
import os
import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.io.files import write_bytes
from mi_refgs.kernels.device import upload
from mi_refgs.shade.light.envmap import azimuth_polar, interpolated
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.points import safe_normalize
from mi_refgs.types import Color3f, Float, Point3f, Vector3f

LOOKUPS = 4  # of the distance per ray; mean error of the direction in a room: 10.5° with 0, 2.9°, …, 0.4°
DAMPING = 0.3  # of the last nearness in the next: distances jump at outlines
SHORTEST = 0.05  # least length of a ray, in distances: a point may lie beyond a surface that was fitted


@dataclass(frozen=True, eq=False)
class NearField:
    """Distances of what a map shows from a `centre` (3,) in the world: `nearness` (h, 2h) is 1 / distance,
    scene units, 0 infinitely far. Raises InputError for other shapes and negative or not finite values."""

    centre: np.ndarray
    nearness: np.ndarray

    def __post_init__(self) -> None:
        centre, nearness = np.shape(self.centre), np.shape(self.nearness)
        if centre != (3,) or len(nearness) != 2 or nearness[1] != 2 * nearness[0] or nearness[0] < 2:
            what, remedy = f"shapes {centre} and {nearness}", "need (3,) and (h, 2h), h ≥ 2"
            raise InputError(what, "near field", remedy=remedy)
        if not (np.isfinite(self.centre).all() and np.all((0 <= self.nearness) & (self.nearness < np.inf))):
            raise InputError("a value is negative or not finite", "near field", remedy="replace it")

    @staticmethod
    def read(path: str | os.PathLike[str]) -> "NearField":
        """Read what `write` has written; raises InputError for any other file."""
        try:
            # Opened here: NumPy leaves a file open that is no archive.
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
                return NearField(archive["centre"], archive["nearness"])
        except InputError as error:
            raise error.at(path) from error
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(f"cannot be read ({error})", path, "near field", "restore the file") from error

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write `centre` and `nearness` as an .npz file, atomically; raises InputError if that fails."""
        buffer = io.BytesIO()
        np.savez(buffer, centre=self.centre, nearness=np.asarray(self.nearness, np.float32))
        write_bytes(Path(path), buffer.getvalue())

    @cached_property
    def on_device(self) -> tuple[Float, Point3f]:
        """Nearness of the texels (2 h²,), and the centre (1,)."""
        centre = mi.Point3f([float(x) for x in self.centre])
        dr.make_opaque(centre)
        return upload(np.asarray(self.nearness, np.float32)), centre

    def seen_from(self, position: Point3f, direction: Vector3f) -> Vector3f:
        """Unit directions from the centre to what rays x + t r from `position` in unit directions meet, under
        AD. The distance 1 / n is looked up in the direction of the last point that was found; on the sphere
        of that radius t = τ / n, τ = √((x·r n)² + 1 - |x|² n²) - x·r n, and the direction is r + x n / τ,
        also where n is 0. Where x is outside, t is SHORTEST radii or more."""
        offset = mi.Vector3f(position) - mi.Vector3f(self.on_device[1])
        texels, h = self.on_device[0], dr.opaque(mi.UInt32, len(self.nearness))
        towards, nearness = mi.Vector3f(direction), mi.Float(0)
        for index in range(LOOKUPS):
            at = azimuth_polar(towards)
            found = interpolated(lambda i: dr.gather(mi.Float, texels, i), *at, h, 2 * h)
            nearness = dr.lerp(found, nearness, DAMPING) if index else found
            along = dr.dot(offset, direction) * nearness
            inside = dr.square(along) + 1 - dr.squared_norm(offset) * dr.square(nearness)
            τ = dr.sqrt(dr.maximum(inside, SHORTEST**2)) - along
            towards = safe_normalize(dr.fma(offset, nearness * dr.rcp(dr.maximum(τ, SHORTEST)), direction))
        return towards


@dataclass(frozen=True)
class LocalLight:
    """A light with a near field, seen from N points. Irradiance is that at the centre."""

    light: Light
    near: NearField
    position: Any  # mi.Point3f (N,), world

    def __post_init__(self) -> None:
        dr.eval(self.near.on_device)  # lookups may be in a loop, which cannot upload

    def specular(self, direction: Vector3f, roughness: Float) -> Color3f:
        return self.light.specular(self.near.seen_from(self.position, direction), roughness)

    def irradiance(self, normal: Vector3f) -> Color3f:
        return self.light.irradiance(normal)

    def radiance(self, direction: Vector3f) -> Color3f:
        return self.light.radiance(self.near.seen_from(self.position, direction))
