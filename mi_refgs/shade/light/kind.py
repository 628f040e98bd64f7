"""Kinds of light: what a fit learns of a light, and what a run saves of it.

To add a kind, write its `FittedLight` and its `LightKind` in a file, and register the latter in LIGHTS.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.constants import RAW_LIMIT
from mi_refgs.registry import Registry
from mi_refgs.shade.light.envmap import DEFAULT_HEIGHT, EnvironmentLight
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.light.lobe_matrices import map_directions
from mi_refgs.types import TensorXf


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

    def environment(self) -> EnvironmentLight:
        """The map that a run saves, which every application shows, edits and exports."""
        directions = map_directions(DEFAULT_HEIGHT)
        light = self.prefilter().radiance(mi.Vector3f(directions.reshape(-1, 3).T.astype(np.float32)))
        radiance = np.broadcast_to(light.numpy(), (3, directions.size // 3))  # a constant has width 1
        return EnvironmentLight.from_radiance(radiance.T.reshape(directions.shape))

    def unusable(self) -> int:
        """Number of raw values that are not < RAW_LIMIT; waits for the device."""
        return int(dr.count(~(dr.abs(dr.detach(self.raw.array)) < RAW_LIMIT))[0])


LightOfFit = FittedLight | EnvironmentLight


@dataclass(frozen=True)
class LightKind:
    """Settings of one kind of light, the table `[light]` of a method."""

    # Iterations that share one prefiltered light, which then receives all their gradients.
    every: int = field(default=1, metadata={"allowed": (lambda n: n >= 1, "1 or more")})

    name: ClassVar[str] = ""
    learnt: ClassVar[bool] = True  # whether a fit changes the raw values

    def start(self) -> TensorXf:
        """Raw values that a fit begins with; raises InputError if a setting cannot be used."""
        raise NotImplementedError

    def of(self, raw: TensorXf) -> LightOfFit:
        """The light of raw values, under AD."""
        raise NotImplementedError


LIGHTS: Registry[type[LightKind]] = Registry("light")
"""Every kind of light by name."""
