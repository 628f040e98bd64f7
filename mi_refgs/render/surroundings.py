"""Surroundings of the object in images without alpha, splatted together with it in one sort."""

from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi

from mi_refgs.errors import InputError
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.ply import read_ply
from mi_refgs.surfels.primitives.primitive import evaluating_both
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Color3f


@dataclass(frozen=True)
class Surroundings:
    """Surfels or Gaussians with geometry and radiance_sh only, and a distant background, or a black one."""

    surfels: Surfels
    background: EnvironmentLight | None = None

    @staticmethod
    def read(ply: str | Path, background: str | Path | None) -> "Surroundings":
        """Read the files of a run; raises InputError for one that cannot be used."""
        light = None if background is None else EnvironmentLight.from_file(Path(background))
        return Surroundings(read_ply(ply), light)

    def check(self, surfels: Surfels) -> None:
        """Raise InputError unless these fit an object's surfels."""
        if not self.surfels.has("radiance_sh"):
            raise InputError("the surfels have no such attribute", "surroundings", "radiance_sh", "add it")
        evaluating_both(surfels.primitive, self.surfels.primitive)

    def behind(self, camera: Camera) -> Color3f:
        """Radiance of the background per pixel of a camera, in raster order, under AD."""
        if self.background is None:
            return dr.zeros(mi.Color3f, camera.width * camera.height)
        return self.background.unfiltered().radiance(dr.normalize(camera.rays()))


def nothing_around(surfels: Surfels) -> Surfels:
    """No surfels of the same primitive, for an object with a background only."""
    widths = {**surfels.primitive.widths, "radiance_sh": 3}
    return Surfels({name: dr.zeros(mi.TensorXf, (0, width)) for name, width in widths.items()})
