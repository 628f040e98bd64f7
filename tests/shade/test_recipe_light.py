"""CONTRIBUTING's recipe "a light", followed: a sun whose direction and colour are learnt."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.kernels.device import upload_tensor
from mi_refgs.shade.light import LIGHTS, FittedLight, LightKind
from mi_refgs.shade.points import safe_normalize
from tests.helpers import unit, vector

SHARPNESS = 40.0  # of the sun: radiance falls as exp(SHARPNESS (cosine - 1))


@dataclass(frozen=True)
class SunLight:
    """A lobe around one direction, wider where it is filtered, and a sky of one radiance."""

    direction: Any  # mi.Vector3f (1,), unit
    colour: Any  # mi.Color3f (1,)
    sky: float

    def radiance(self, direction: Any) -> Any:
        return self.sky + self.colour * dr.exp(SHARPNESS * (dr.dot(direction, self.direction) - 1))

    def specular(self, direction: Any, roughness: Any) -> Any:
        sharpness = dr.rcp(1 / SHARPNESS + 0.5 * dr.square(dr.square(roughness)))
        lobe = dr.exp(sharpness * (dr.dot(direction, self.direction) - 1))
        return self.sky + self.colour * (sharpness / SHARPNESS) * lobe

    def irradiance(self, normal: Any) -> Any:
        return self.sky + self.colour * (2 / SHARPNESS) * dr.maximum(dr.dot(normal, self.direction), 0)


class FittedSun(FittedLight):
    """`raw` (2, 3): direction, of any length, and logarithm of the colour."""

    def prefilter(self) -> SunLight:
        x, y, z, r, g, b = (dr.gather(mi.Float, self.raw.array, i) for i in range(6))
        return SunLight(safe_normalize(mi.Vector3f(x, y, z)), dr.exp(mi.Color3f(r, g, b)), 0.2)


@dataclass(frozen=True)
class Sun(LightKind):
    """A sun."""

    elevation: float = 45.0  # initial, degrees

    name: ClassVar[str] = "sun"

    def start(self) -> Any:
        angle = np.radians(self.elevation)
        return upload_tensor(np.array([[np.cos(angle), 0, np.sin(angle)], [0.5, 0.5, 0.5]]))

    def of(self, raw: Any) -> FittedSun:
        return FittedSun(raw)


@pytest.fixture(autouse=True)
def sun() -> Iterator[None]:
    LIGHTS.register(Sun)
    yield
    LIGHTS.unregister("sun")


def test_the_map_that_a_run_saves_is_the_light(rng: np.random.Generator) -> None:
    light = Sun().of(Sun().start())
    d = vector(unit(rng.normal(size=(200, 3))))
    found, expected = (x.radiance(d).numpy() for x in (light.environment().prefilter(), light.prefilter()))
    np.testing.assert_allclose(found, expected, atol=0.02 * expected.max())
    assert not light.unusable() and Sun().of(mi.TensorXf(np.full((2, 3), np.nan, np.float32))).unusable() == 6
