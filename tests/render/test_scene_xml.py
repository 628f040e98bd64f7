"""The scene.xml of a run shows what the run shows: camera, options and all."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.occlusion.mesh import read_mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.render.scene_xml import write_scene_xml
from mi_refgs.runs.export import export
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.options import QUALITY, ShadingOptions
from mi_refgs.shade.reflectance import MODELS
from mi_refgs.shade.shading import Shading
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused
from tests.scenes import integrator as scenes
from tests.scenes.integrator import HEIGHT, WIDTH


def fitted(folder: Path, shading: Shading) -> TrainedScene:
    made = scenes.hollow_mesh if shading.ambient_rays else scenes.plane_mesh
    mesh = read_mesh(made(folder)) if shading.occlusion else None
    surfels = Surfels.from_numpy(scenes.raw_channels())
    return TrainedScene(surfels, EnvironmentLight.from_radiance(scenes.sky()), mesh, shading, 7, 1.5)


def view(ratio: float = 1.0, sign: float = -1.0, cx: float = WIDTH / 2, cy: float = HEIGHT / 2) -> Camera:
    """Focal lengths of 18 · ratio and 18 pixels."""
    pose = np.array(scenes.sensor()["to_world"].matrix)
    return Camera.from_pose(WIDTH, HEIGHT, sign * 18 * ratio, sign * 18, cx, cy, pose)


def shown(folder: Path, made: TrainedScene, camera: Camera) -> tuple[mi.Scene, np.ndarray, np.ndarray]:
    """The exported scene, its image, and that of the fit."""
    export(made, folder, camera)
    scene = mi.load_file(str(folder / "scene.xml"))
    frame = made.renderer()(camera)
    expected = np.concatenate([frame.radiance.numpy(), frame.alpha.numpy()[None]]).T
    return scene, scenes.image(scene), expected.reshape(camera.height, camera.width, 4)


@pytest.mark.parametrize("option", QUALITY)
def test_quality_options_round_trip(option: str, tmp_path: Path) -> None:
    """Through scene.xml and through model.json; and the images are the same."""
    model, chosen = next(x for x in MODELS.values() if option in x.honoured), scenes.OTHER_OPTIONS[option]
    shading = Shading(model.shaded_at[0], model.name, "irradiance", True, **{option: chosen})
    made = fitted(tmp_path, shading)
    scene, seen, expected = shown(tmp_path / "run", made, view())
    assert scene.integrator().shading == shading and TrainedScene.read(tmp_path / "run").shading == shading
    np.testing.assert_allclose(seen, expected, atol=1e-5)
    default = replace(shading, **{option: getattr(ShadingOptions, option)})
    plain = replace(made, shading=default).renderer()(view())
    assert np.abs(plain.radiance.numpy().T.reshape(HEIGHT, WIDTH, 3) - seen[..., :3]).max() > 1e-3


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize(("cx", "cy"), [(WIDTH / 2, HEIGHT / 2), (3.3, 10.1), (-1.0, 13.5)])
def test_square_pixels_are_the_view_itself(cx: float, cy: float, sign: float, tmp_path: Path) -> None:
    """On its head too, and with a principal point outside the image."""
    _, seen, expected = shown(tmp_path, fitted(tmp_path, Shading("surfel")), view(1, sign, cx, cy))
    np.testing.assert_allclose(seen, expected, atol=1e-5)
    assert expected[..., 3].max() > 0.2


@pytest.mark.parametrize("ratio", [1.001, 1.1, 1 / 1.1, 2.0])
def test_other_pixels_keep_directions_and_extent(ratio: float, tmp_path: Path, rng: Any) -> None:
    camera = view(ratio, cx=7.0, cy=6.5)
    scene, seen, _ = shown(tmp_path, fitted(tmp_path, Shading("surfel")), camera)
    exported = Camera.from_sensor(scene.sensors()[0])
    height, width = seen.shape[:2]
    stretch = max(1, 1 / ratio), max(1, ratio)
    assert abs(width - WIDTH * stretch[0]) <= 0.5 and abs(height - HEIGHT * stretch[1]) <= 0.5
    point = mi.Point3f(rng.uniform(-1, 1, (3, 50)).astype(np.float32))
    there, here = (pixels(which, point) for which in (exported, camera))
    np.testing.assert_allclose(there, here * np.array(stretch)[:, None], atol=2e-4)
    assert ("square pixels" in (tmp_path / "scene.xml").read_text()) == (abs(ratio - 1) > 1e-5)


def pixels(camera: Camera, point: Any) -> np.ndarray:
    local = camera.to_camera(point)
    return np.array([camera.fx * local.x / local.z + camera.cx, camera.fy * local.y / local.z + camera.cy])


def test_what_no_scene_can_say_is_refused(tmp_path: Path) -> None:
    camera = Camera.from_pose(8, 8, 10, -10, 4, 4, np.eye(4))
    path, shading = tmp_path / "file", Shading(occlusion=True)
    refused(lambda: write_scene_xml(path, Shading(), [camera], "a.ply"), "fx, fy: 10 and -10 pixels mirror")
    path.touch()
    refused(lambda: write_scene_xml(path / "a.xml", Shading(), [view()], "a.ply"), "cannot be created")
    refused(lambda: write_scene_xml(tmp_path / "s.xml", shading, [view()], "a.ply"), "mesh: there is none")


@pytest.mark.parametrize("options", [{}, {"visibility_rays": 2}, {"traced_bounces": 1}])
def test_rays_start_at_covered_pixels_only(
    options: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """First hits for what is seen, mirror rays for what they hit: counted at the scene that traces them."""
    made = fitted(tmp_path, Shading(diffuse="irradiance", occlusion=True, **options))
    hits: list[int] = []
    trace = Occluder.first_hit

    def counted(self: Occluder, origin: Any, direction: Any, active: Any = True) -> Any:
        hits.append(int(dr.count(mi.Bool(active) & dr.full(mi.Bool, True, dr.width(direction)))[0]))
        return trace(self, origin, direction, active)

    monkeypatch.setattr(Occluder, "first_hit", counted)
    covered = int((made.renderer()(view(0.4)).alpha.numpy() > 1e-3).sum())
    assert 0 < covered < 0.7 * WIDTH * HEIGHT and hits == [covered]
