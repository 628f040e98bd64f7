"""The plugin, scene.xml and a run's files with what is around and behind the object, and the object alone."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs.export import export
from mi_refgs.runs.trained_scene import AROUND_FILE, BACKGROUND_MAP, TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.ply import write_ply
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused
from tests.scenes import integrator as scenes


def camera() -> Camera:
    return Camera.from_sensor(mi.load_dict(scenes.sensor()))


def test_values_that_cannot_be_used_are_told_of_and_left_out() -> None:
    raw = scenes.far_channels()
    raw["position"][3] = np.nan
    bad = {scenes.PREFIX + name: mi.TensorXf(values) for name, values in raw.items()}
    with pytest.warns(RuntimeWarning, match=r"1 surroundings in position \(first: 3\)"):
        of = scenes.open_scene(**bad)
    left = {scenes.PREFIX + name: mi.TensorXf(np.delete(values, 3, axis=0)) for name, values in raw.items()}
    np.testing.assert_array_equal(scenes.image(of), scenes.image(scenes.open_scene(**left)))


def test_visibility_is_that_of_the_object() -> None:
    seen = scenes.image(scenes.open_scene(aovs="a:albedo,v:visibility"))
    assert 0 < np.count_nonzero(seen[..., -1]) < seen[..., -1].size
    np.testing.assert_array_equal(seen[..., -1] > 0, seen[..., -2] > 0)


def test_refusals(tmp_path: Path) -> None:
    raw = scenes.far_channels()
    write_ply(tmp_path / "bare.ply", Surfels.from_numpy({n: x for n, x in raw.items() if n != "radiance_sh"}))
    for words, changes in (
        ("surroundings: radiance_sh", {"surroundings": str(tmp_path / "bare.ply")}),
        ("none.ply", {"surroundings": str(tmp_path / "none.ply")}),
        ("none.exr", {"background": str(tmp_path / "none.exr")}),
        ("shape (5, 8, 3)", {"background": mi.TensorXf(np.ones((5, 8, 3), np.float32))}),
    ):
        refused(partial(scenes.scene, **changes), words)


def test_run_folder_contains_surroundings_and_background_until_removed(tmp_path: Path) -> None:
    """Written, read back, rendered alike; what is stale goes."""
    around = Surroundings(Surfels.from_numpy(scenes.far_channels()), scenes.background_light())
    light, surfels = EnvironmentLight.from_radiance(scenes.sky()), Surfels.from_numpy(scenes.raw_channels())
    made = TrainedScene(surfels, light, None, Shading(), 7, 1.5, surroundings=around)
    files = {path.name for path in export(made, tmp_path, camera())}
    assert {AROUND_FILE, BACKGROUND_MAP} <= files
    frame, again = made.renderer()(camera()), TrainedScene.read(tmp_path).renderer()(camera())
    for name in ("radiance", "alpha", "background", "object_alpha"):
        np.testing.assert_allclose(getattr(again, name), getattr(frame, name), atol=1e-5)
    for name in (AROUND_FILE, BACKGROUND_MAP):
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).unlink()
        refused(partial(TrainedScene.read, tmp_path), f"{name}: file: missing; restore it")
        (tmp_path / name).write_bytes(content)
    files = {path.name for path in export(replace(made, surroundings=None), tmp_path, camera())}
    assert not {AROUND_FILE, BACKGROUND_MAP} & files
    assert not (tmp_path / AROUND_FILE).exists() and not (tmp_path / BACKGROUND_MAP).exists()
    assert TrainedScene.read(tmp_path).surroundings is None
