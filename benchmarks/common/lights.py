"""Lights of rising frequency as lat-long maps, all with a mean radiance of 1.

A map *is* the light: Mitsuba's `envmap` and every other method look it up bilinearly, on the same grid.
"""

from __future__ import annotations

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
"""Samples a texel side when Mitsuba's sky is baked; the sun's disc is about a texel wide."""
CHECKS = 12
"""Checks from pole to pole: 15 degrees each."""
BUILT_IN = ("constant", "gradient", "studio", "checker", "sunsky")
"""In rising order of frequency."""


@dataclass(frozen=True)
class Light:
    """A named map (h, 2h, 3), float32 linear radiance in Mitsuba's orientation, up = +y."""

    name: str
    radiance: np.ndarray

    def emitter(self) -> dict[str, Any]:
        """Mitsuba's `envmap` with this map."""
        return {"type": "envmap", "bitmap": mi.Bitmap(self.radiance)}

    def environment(self, height: int) -> EnvironmentLight:
        """The light as the product holds it, averaged down to `height` rows."""
        rows = (
            self.radiance if height == len(self.radiance) else lobe_matrices.resample(self.radiance, height)
        )
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
    emitter = mi.load_dict(
        {"type": "sunsky", "sun_direction": [float(sun[0]), float(-sun[2]), float(sun[1])]}
    )
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

    Raises InputError for a name that is neither.
    """
    if name in BUILT_IN:
        radiance = _built_in(name, height)
    elif Path(name).exists():
        radiance = EnvironmentLight.from_file(name, height).radiance().numpy().astype(np.float64)
    else:
        raise InputError(
            f"{name}: light: neither one of {', '.join(BUILT_IN)} nor a file; give an EXR or HDR file"
        )
    mean = float(np.average(radiance.mean((1, 2)), weights=lobe_matrices.row_areas(height)))
    radiance = np.maximum(radiance / mean, RADIANCE_FLOOR)
    return Light(Path(name).stem, radiance.astype(np.float32))
