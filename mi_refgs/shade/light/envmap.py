"""The environment map: learnable lat-long radiance, its prefiltered levels, and lookups for shading.

Directions follow Mitsuba's `envmap`: up is +y, φ = atan2(x, -z) runs along a row, θ from +y down the rows;
column centres at half-integers, the first and the last row at the poles (`lobe_matrices`).

Radiance is softplus(raw): positive without an upper bound, and with a slope of at most 1, so that an
optimiser's step bounds the change of radiance."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.constants import RAW_LIMIT
from mi_refgs.errors import InputError
from mi_refgs.io.exr import write_exr
from mi_refgs.kernels.device import upload, upload_tensor
from mi_refgs.kernels.timing import phase
from mi_refgs.shade.light import lobe_matrices
from mi_refgs.shade.light.latlong import lat_long
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.light.light_file import read_radiance
from mi_refgs.shade.light.lobe_matrices import LEVEL_ROUGHNESS
from mi_refgs.shade.light.prefilter import Operator, prefilter
from mi_refgs.types import Color3f, Float, TensorXf, Vector3f


def softplus(x: Any) -> Any:
    """log(1 + exp x) to full relative precision for every finite x, with a finite derivative."""
    e = dr.exp(-dr.abs(x))
    # log(1 + e) = 2 atanh(e / (2 + e)): 1 + e alone would round away all of a dark texel.
    s = e / (2 + e)
    series = dr.zeros(type(x), dr.width(x))
    for n in reversed(range(7)):  # relative error below 1e-7
        series = dr.fma(series, s * s, 1 / (2 * n + 1))
    return 0.5 * x + 0.5 * dr.abs(x) + 2 * s * series  # not max(0, x), whose slope at 0 is not ½


def bounded(value: Any, raw: Any) -> Any:
    """The value, or 0 with gradient 0 where |raw| is not < RAW_LIMIT: a NaN would spread over all levels."""
    return dr.select(dr.abs(dr.detach(raw)) < RAW_LIMIT, value, 0)


def nearest_raw(radiance: np.ndarray) -> np.ndarray:
    """Raw float32 values whose softplus, as the device rounds it, is nearest to the radiance (float64)."""
    wanted, exact = radiance.astype(np.float32), radiance + np.log(-np.expm1(-radiance))
    step = np.maximum(np.spacing(np.abs(exact).astype(np.float32)), np.spacing(wanted) / -np.expm1(-radiance))
    tried = np.stack([exact + k * step for k in (0, -1, 1, -2, 2)]).astype(np.float32)
    shown = softplus(upload(tried)).numpy().reshape(tried.shape)
    nearest = np.argmin(np.abs(shown.astype(np.float64) - wanted), axis=0)
    return np.take_along_axis(tried, nearest[None], axis=0)[0]


DEFAULT_HEIGHT = 64  # rows: 2.8° a texel, about what an image of a few hundred pixels resolves in a mirror
MIN_HEIGHT = 8  # fewest rows of a light
FINEST = 1024  # default for most rows of a light that is read from a file: 0.2° per texel
RADIANCE_FLOOR = 1e-4  # least radiance after an import: softplus has no finite raw value for 0


def is_height(rows: int) -> bool:
    return rows % 4 == 0 and rows >= MIN_HEIGHT


@dataclass(frozen=True)
class PrefilteredLight:
    """Levels of an environment (`EnvironmentLight.prefilter`): a `light.Light`, traced and differentiable."""

    operator: Operator
    levels: Any  # flat RGBA texels, level after level

    def radiance(self, direction: Vector3f) -> Color3f:
        return self._bilinear(*azimuth_polar(direction), mi.UInt32(0))

    def irradiance(self, normal: Vector3f) -> Color3f:
        return self._bilinear(*azimuth_polar(normal), mi.UInt32(len(LEVEL_ROUGHNESS)))  # its D is constant

    def specular(self, direction: Vector3f, roughness: Float) -> Color3f:
        """Radiance averaged over the GGX lobe: linear between levels in 1/roughness, which keeps energy and
        peak, and in roughness⁴ below the first. [split sum, Karis 2013]"""
        first, r = LEVEL_ROUGHNESS[0], dr.clip(roughness, 0, 1)
        sharp, inverse = dr.minimum(r, first) * (1 / first), dr.rcp(dr.maximum(r, first))
        level = dr.square(dr.square(sharp))
        for a, b in pairwise(LEVEL_ROUGHNESS):
            level += dr.clip((inverse - 1 / a) * (1 / (1 / b - 1 / a)), 0, 1)
        lower = dr.minimum(mi.UInt32(dr.detach(level)), len(LEVEL_ROUGHNESS) - 1)
        at = azimuth_polar(direction)
        return dr.lerp(self._bilinear(*at, lower), self._bilinear(*at, lower + 1), level - mi.Float(lower))

    def _bilinear(self, u: Any, v: Any, level: Any) -> Any:
        """Colour at the fractions u of a turn and v of a meridian."""
        first, h, w = (dr.gather(mi.UInt32, self.operator.info, 4 * level + k) for k in range(3))
        colour = interpolated(lambda i: dr.gather(mi.Vector4f, self.levels, first + i), u, v, h, w)
        return mi.Color3f(colour.x, colour.y, colour.z)


@dataclass(frozen=True)
class UnfilteredLight:
    """The map without levels (`EnvironmentLight.unfiltered`), for models that look up `radiance` only."""

    height: int
    texels: Any  # flat RGB texels, under AD

    def radiance(self, direction: Vector3f) -> Color3f:
        h = dr.opaque(mi.UInt32, self.height)
        u, v = azimuth_polar(direction)
        return interpolated(lambda i: dr.gather(mi.Color3f, self.texels, i), u, v, h, 2 * h)

    def specular(self, direction: Vector3f, roughness: Float | None = None) -> Color3f:
        remedy = "call prefilter(), or look up `radiance`"
        raise InputError("the light is not filtered", "light", "lookup", remedy)

    irradiance = specular


def interpolated(texel: Callable[[Any], Any], u: Any, v: Any, h: Any, w: Any) -> Any:
    """Bilinear value of a map of h rows and w columns at the fractions u of a turn and v of a meridian."""
    x, y = dr.fma(u, mi.Float(w), -0.5), v * mi.Float(h - 1)
    left = mi.Int32(dr.floor(dr.detach(x)))
    # Bounded as integers: a NaN passes bounds of floats.
    row = dr.minimum(mi.UInt32(dr.detach(y)), h - 2)
    s, t = x - mi.Float(left), y - mi.Float(row)
    column = mi.UInt32(dr.select(left < 0, mi.Int32(w) - 1, dr.minimum(left, mi.Int32(w) - 1)))
    right = dr.select(column + 1 < w, column + 1, 0)
    above = row * w
    upper = dr.lerp(texel(above + column), texel(above + right), s)
    below = dr.lerp(texel(above + w + column), texel(above + w + right), s)
    return dr.lerp(upper, below, t)


def azimuth_polar(direction: Any) -> tuple[Any, Any]:
    """Fractions u of a turn and v of a meridian of unit directions, with finite derivatives."""
    x, y, z = direction.x, direction.y, direction.z
    sin2 = x * x + z * z
    off_pole = sin2 > 1e-4**2  # nearer than 0.006° the azimuth is fixed: its derivative stays below 1e4
    φ = dr.atan2(dr.select(off_pole, x, 0), -dr.select(off_pole, z, 1))
    u = φ * (0.5 / dr.pi)
    u = dr.select(u < 0, u + 1, u)
    # At the pole itself sqrt has no derivative, and only the sign of y distinguishes the two poles.
    sin = dr.select(off_pole, dr.sqrt(dr.select(off_pole, sin2, 1)), 0)
    return u, dr.atan2(sin, dr.select(off_pole, y, dr.select(y < 0, -1, 1))) * (1 / dr.pi)


@dataclass(frozen=True)
class FittedLight:
    """A light of raw values of any shape, which a fit learns."""

    raw: TensorXf

    def prefilter(self) -> Light:
        """The light as models look it up, under AD; without gradient where a value is not < RAW_LIMIT."""
        raise NotImplementedError

    def unfiltered(self) -> Light:
        """The light for models that look up `radiance` only, under AD."""
        return self.prefilter()

    def environment(self) -> "EnvironmentLight":
        """The map that a run saves, which every application shows, edits and exports."""
        return EnvironmentLight.from_radiance(lat_long(self.unfiltered().radiance, DEFAULT_HEIGHT, 1))

    def unusable(self) -> int:
        """Number of raw values that are not < RAW_LIMIT; waits for the device."""
        return int(dr.count(~(dr.abs(dr.detach(self.raw.array)) < RAW_LIMIT))[0])


@dataclass(frozen=True)
class EnvironmentLight(FittedLight):
    """A light of radiance softplus(`raw`), a tensor (h, 2h, 3), h a multiple of 4, else InputError."""

    def __post_init__(self) -> None:
        shape = tuple(self.raw.shape)
        h = shape[0] if shape else 0
        if shape != (h, 2 * h, 3) or not is_height(h):
            need = f"need (h, 2h, 3), h ≥ {MIN_HEIGHT} a multiple of 4: EnvironmentLight.from_file resamples"
            raise InputError(f"shape {shape}", "EnvironmentLight", "raw", need)

    @classmethod
    def constant(cls, radiance: float | np.ndarray = 0.5, height: int = DEFAULT_HEIGHT) -> "EnvironmentLight":
        """The same positive radiance from everywhere."""
        return cls.from_radiance(np.full((height, 2 * height, 3), radiance))

    @classmethod
    def from_radiance(cls, radiance: np.ndarray) -> "EnvironmentLight":
        """Take linear radiance (h, 2h, 3), 1e-4 at least; InputError for NaN, infinity or another shape."""
        radiance = np.asarray(radiance, np.float64)
        if not np.isfinite(radiance).all():
            raise InputError("NaN or infinite values", "EnvironmentLight", "radiance", "replace those texels")
        return cls(upload_tensor(nearest_raw(np.maximum(radiance, RADIANCE_FLOOR))))

    @classmethod
    def from_file(cls, path: str | os.PathLike[str], height: int | None = None) -> "EnvironmentLight":
        """Read a lat-long image (EXR, HDR) and resample it to `height` rows (default: its own, at most
        FINEST), keeping its energy. Raises InputError as `read_radiance` does."""
        image = read_radiance(path, height or FINEST)
        rows = height if height is not None else max(MIN_HEIGHT, image.shape[0] // 4 * 4)
        return cls.from_radiance(lobe_matrices.resample(image, rows))

    @property
    def height(self) -> int:
        return int(self.raw.shape[0])

    def radiance(self) -> Any:
        """Linear radiance (h, 2h, 3), a tensor under AD; 0 with gradient 0 where |raw| is not < RAW_LIMIT."""
        return mi.TensorXf(bounded(softplus(self.raw.array), self.raw.array), shape=tuple(self.raw.shape))

    @phase("prefilter forward", backward="prefilter backward")
    def prefilter(self) -> PrefilteredLight:
        return PrefilteredLight(*prefilter(self.radiance()))

    def unfiltered(self) -> UnfilteredLight:
        return UnfilteredLight(self.height, self.radiance().array)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the radiance as a float32 EXR, atomically; InputError when the path cannot be written."""
        write_exr(Path(path), self.radiance().numpy())

    def environment(self) -> "EnvironmentLight":
        return self
