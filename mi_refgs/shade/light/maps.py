"""Kinds of light that are environment maps: learnt, or read from a file."""

import math
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Self

import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.shade.light.envmap import MIN_HEIGHT, EnvironmentLight, is_height
from mi_refgs.shade.light.kind import RADIANCE, LightKind
from mi_refgs.shade.light.latlong import OVERSAMPLING, Z_UP, environment_image
from mi_refgs.shade.light.light_file import read_radiance
from mi_refgs.types import TensorXf

LARGEST_HEIGHT = 128  # most rows of a learnt map by default: the finest filtered level has no more
FIXED_HEIGHT = 256  # most rows of a known map: a texel is 0.7°, an eighth of the lobe of roughness 0.1
READ_ROWS = OVERSAMPLING * FIXED_HEIGHT  # to which a larger map is averaged first
EXPOSURE_MAX = 10.0  # stops; a light stores no radiance below 1e-4
HEIGHT = {"allowed": (is_height, f"a multiple of 4 from {MIN_HEIGHT}")}


@dataclass(frozen=True)
class Map(LightKind):
    """An environment map."""

    # Rows; width is twice that; absent: by the images, or of a fixed map by its file.
    height: int | None = field(default=None, metadata=HEIGHT)

    @property
    def rows(self) -> int:
        return self.height or LARGEST_HEIGHT

    def shape(self) -> tuple[int, ...]:
        return self.rows, 2 * self.rows, 3

    def sized(self, pixels: int) -> Self:
        """Choose `height`, if it is absent, by the reflections that a mirror ball as large as images of so
        many pixels shows: 128 rows from 161² pixels on, 76 for 96²."""
        if self.height is not None:
            return self
        wanted = 4 * math.ceil(math.pi / 4 * math.sqrt(pixels) / 4)  # a texel per pixel at the ball's centre
        return replace(self, height=min(max(wanted, MIN_HEIGHT), LARGEST_HEIGHT))


@dataclass(frozen=True)
class Learnt(Map):
    """An environment map, each of whose texels is learnt."""

    radiance: float = field(default=0.5, metadata=RADIANCE)  # initial, everywhere

    name: ClassVar[str] = "learnt"

    def start(self) -> TensorXf:
        return EnvironmentLight.constant(self.radiance, self.rows).raw


@dataclass(frozen=True)
class Known(Map):
    """The lat-long map of a file (EXR, HDR, PNG, JPEG): the light, or where a learnt light starts."""

    file: str = ""  # its path
    fixed: bool = False  # whether its texels stay as they are
    learn: tuple[Literal["rotation", "scale"], ...] = ()  # of a fixed map; the scale is one per channel
    world: bool = False  # whether the map is in world directions, as envmap.exr; else its first row is +z
    rotate: float = 0.0  # degrees about +z, counter-clockwise seen from above; initial, if it is learnt
    exposure: float = 0.0  # stops; initial, if a scale is learnt

    name: ClassVar[str] = "file"

    def __post_init__(self) -> None:
        if not self.file:
            raise InputError("none is named", field="file", remedy="give an EXR or HDR file")
        if self.learn and not self.fixed:
            what = "texels that learn determine rotation and scale"
            raise InputError(what, field="learn", remedy="add fixed = true, or drop it")

    @property
    def learns(self) -> bool:
        return not self.fixed

    def sized(self, pixels: int) -> Self:
        if self.height is not None or not self.fixed:
            return super().sized(pixels)
        return replace(self, height=max(len(read_radiance(self.file, FIXED_HEIGHT)) // 4 * 4, MIN_HEIGHT))

    def start(self) -> TensorXf:
        image = read_radiance(self.file, OVERSAMPLING * self.rows)
        return world_light(image, self.world, self.rotate, self.exposure, self.rows).raw

    @property
    def placement(self) -> tuple[str, ...]:
        return self.learn


def require_range(rotate: float, exposure: float) -> None:
    """Raise InputError for a rotation or exposure that `world_light` cannot use."""
    if not np.isfinite(rotate):
        raise InputError(f"{rotate} is no angle", "light", "rotation", "give degrees")
    if not abs(exposure) <= EXPOSURE_MAX:
        allowed = f"give stops from {-EXPOSURE_MAX:g} to {EXPOSURE_MAX:g}"
        raise InputError(f"{exposure} is out of range", "light", "exposure", allowed)


def world_light(
    radiance: np.ndarray, world: bool, rotate: float, exposure: float, height: int | None = None
) -> EnvironmentLight:
    """Lat-long radiance (h, w, 3) as a light of `height` rows, or min(h, FIXED_HEIGHT); options: `Known`."""
    require_range(rotate, exposure)
    radiance = np.ascontiguousarray(radiance, dtype=np.float32)
    if radiance.ndim != 3 or radiance.shape[2] != 3 or min(radiance.shape) < 2:
        remedy = "give linear radiance (h, w, 3)"
        raise InputError(f"{radiance.shape} is no lat-long map", "light", remedy=remedy)
    turned: Any = mi.ScalarTransform4f()
    if rotate % 360:
        turned = turned.rotate([0, 0, 1], rotate)
    if not world:
        turned = turned.rotate(*Z_UP)
    emitter = {"type": "envmap", "bitmap": mi.Bitmap(radiance), "to_world": turned}
    height = height or min(FIXED_HEIGHT, max(len(radiance) // 4 * 4, MIN_HEIGHT))
    image = environment_image(mi.load_dict({"type": "scene", "light": emitter}), height)
    return EnvironmentLight.from_radiance(image * np.float32(2.0**exposure))
