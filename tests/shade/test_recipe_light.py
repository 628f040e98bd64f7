"""CONTRIBUTING's recipe "a light", followed: a sun whose direction and colour are learnt."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_refgs
from mi_refgs.cli import main
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.kind import LIGHTS, FittedLight, LightKind
from mi_refgs.shade.points import safe_normalize
from tests.helpers import unit, vector
from tests.scenes.tiny import train_command, write_data, write_method

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


METHOD = """
iterations = 2000
[surfels]
attributes = ["albedo", "metallic", "roughness"]
[light]
kind = "sun"
elevation = 60
[stage.only]
until = 2000
diffuse = "irradiance"
"""


@pytest.fixture(autouse=True)
def sun() -> Iterator[None]:
    mi_refgs.register_light(Sun)
    yield
    LIGHTS.unregister("sun")


def test_the_map_that_a_run_saves_is_the_light(rng: np.random.Generator) -> None:
    light = Sun().of(Sun().start())
    d = vector(unit(rng.normal(size=(200, 3))))
    found, expected = (x.radiance(d).numpy() for x in (light.environment().prefilter(), light.prefilter()))
    np.testing.assert_allclose(found, expected, atol=0.02 * expected.max())
    assert not light.unusable() and Sun().of(mi.TensorXf(np.full((2, 3), np.nan, np.float32))).unusable() == 6


def test_a_method_fits_it_and_a_run_keeps_it(tmp_path: Path) -> None:
    """Learnt, saved as a map that scene.xml reads, made again from a checkpoint; and relit."""
    data, own = write_data(tmp_path / "data"), write_method(tmp_path, METHOD)
    assert main(train_command(data, tmp_path / "run", own)) == 0
    run: Any = mi_refgs.load(tmp_path / "run")
    saved = run.trained.light.radiance().numpy()
    before = Sun(elevation=60).of(Sun(elevation=60).start()).environment().radiance().numpy()
    assert saved.shape == before.shape and 1e-4 < np.abs(saved - before).max()
    rendered = mi.render(mi.load_file(str(tmp_path / "run" / "scene.xml")), spp=1).numpy()
    assert np.isfinite(rendered).all() and rendered.max() > 0.1
    state = Run(tmp_path / "run").load_checkpoint()
    assert state is not None
    again: Any = TrainedScene.from_state(run.method, state).light
    np.testing.assert_allclose(again.radiance().numpy(), saved, rtol=1e-5)
    assert np.isfinite(np.asarray(run.relight(EnvironmentLight.constant(0.5, 8)).render(0))).all()
