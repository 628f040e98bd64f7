"""A run that is written shows the same image as a Mitsuba scene, and when its files are read again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs.export import export
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.ply import read_ply, write_ply
from mi_refgs.surfels.table import Surfels
from tests.scenes.integrator import camera_at, image, raw_channels, scattered_discs, sky, two_balls

TOLERANCE = 1e-5


def scenes() -> dict[str, TrainedScene]:
    """Deferred with occlusion and indirect light, shaded at surfels, of 3D Gaussians, and surrounded."""
    raw = raw_channels(200)
    raw["scale"] = raw["scale"] - 1
    light = EnvironmentLight.from_radiance(sky())
    traced = Shading("pixel", "split_sum", "sh", occlusion=True)
    deferred = TrainedScene(Surfels.from_numpy(raw), light, two_balls(), traced, 7, 1.5)
    at_surfels = replace(deferred, mesh=None, shading=Shading("surfel", "split_sum", "irradiance"))
    thick = raw | {"scale": np.concatenate([raw["scale"], raw["scale"][:, :1] - 0.5], axis=1)}
    near = scattered_discs()
    near["position"] = near["position"] * 3
    return {
        "deferred": deferred,
        "at surfels": at_surfels,
        "3D Gaussians": replace(at_surfels, surfels=Surfels.from_numpy(thick)),
        "surrounded": replace(deferred, surroundings=Surroundings(Surfels.from_numpy(near), light)),
    }


def picture(made: TrainedScene, camera: Camera) -> np.ndarray:
    """(H, W, 4), or opaque in front of what is behind everything."""
    frame = made.renderer(aovs=False)(camera)
    colour, alpha = np.array(frame.radiance), np.array(frame.alpha)[None]
    if frame.background is not None:
        colour, alpha = colour + (1 - alpha) * np.array(frame.background), np.ones_like(alpha)
    return np.concatenate([colour, alpha]).T.reshape(camera.height, camera.width, 4)


@pytest.mark.parametrize("name", ["deferred", "at surfels", "3D Gaussians", "surrounded"])
def test_image_goes_round(name: str, tmp_path: Path) -> None:
    """The camera is that of the scene's sensor, whose numbers are rounded to float32."""
    made = scenes()[name]
    export(made, tmp_path, camera_at(30.0))
    scene = mi.load_file(str(tmp_path / "scene.xml"))
    camera = Camera.from_sensor(scene.sensors()[0])
    before = picture(made, camera)
    assert before[..., :3].max() > 0.3 and np.ptp(before[..., :3]) > 0.2
    np.testing.assert_allclose(image(scene), before, atol=TOLERANCE)
    np.testing.assert_allclose(picture(TrainedScene.read(tmp_path), camera), before, atol=TOLERANCE)
    write_ply(tmp_path / "again.ply", made.surfels)
    again = replace(made, surfels=read_ply(tmp_path / "again.ply"))
    np.testing.assert_array_equal(picture(again, camera), before)


def test_blocked_light_is_part_of_what_goes_round() -> None:
    """The deferred scene tells occlusion, and the light in its place, from none."""
    made = scenes()["deferred"]
    camera = camera_at(30.0)
    open_ = replace(made, mesh=None, shading=replace(made.shading, occlusion=False))
    frame = made.renderer(aovs=("visibility", "indirect"))(camera)
    assert frame.terms is not None and np.array(frame.terms.indirect).max() > 0.01
    assert np.abs(picture(made, camera) - picture(open_, camera)).max() > 0.05
