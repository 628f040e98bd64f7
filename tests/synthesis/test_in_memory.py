"""Data sets in memory: the views that `make_dataset` writes, and those of sensors; fits that take them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import mi_refgs
from mi_refgs import Camera, Dataset, Pixels
from tests.helpers import read_loaded, refused
from tests.scenes.sphere import CENTRE, SCENE
from tests.scenes.tiny import SETTINGS, write_data, write_method

OPTIONS: dict[str, Any] = {"size": 16, "spp": 16}


def scene() -> Any:
    return mi.load_string(SCENE)


@pytest.mark.parametrize("split", ["train", "test"])
def test_views_are_those_of_the_folder(split: str, tmp_path: Path) -> None:
    """The same cameras, linear images over white, alpha and maps, and near planes."""
    (tmp_path / "ball.xml").write_text(SCENE)
    counts: dict[str, Any] = {"views": 3, "test_views": 3, "environment_height": 0, "progress": False}
    mi_refgs.make_dataset(tmp_path / "ball.xml", tmp_path / "out", **OPTIONS, **counts)
    written = read_loaded(tmp_path / "out", split, images="exr")
    for given in (scene(), tmp_path / "ball.xml"):
        made = Dataset.from_mitsuba(given, 3, split=split, **OPTIONS)
        assert (made.split, made.has_alpha, made.is_linear_radiance, made.folder) == (split, True, True, None)
        for ours, theirs in zip(made.views, written.views, strict=True):
            assert ours.near == pytest.approx(theirs.near, rel=1e-6) and ours.alpha is not None
            np.testing.assert_allclose(ours.to_world, theirs.to_world, atol=1e-9)
            for name in ("image", "alpha", "normal", "depth"):
                np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-6)
            for name, values in theirs.materials.items():
                np.testing.assert_allclose(ours.materials[name], values, atol=1e-6)


def test_sensors_keep_their_lens_and_pose() -> None:
    """Of another size, off the centre, cropped; a `Camera` of either sign of its focal lengths."""
    pose = mi.ScalarTransform4f().look_at([3, 1, 2], CENTRE.tolist(), [0, 0, 1])
    film = {"type": "hdrfilm", "width": 24, "height": 16, "crop_offset_x": 4, "crop_width": 15}
    lens = {"type": "perspective", "fov": 40, "principal_point_offset_x": 0.1, "film": film}
    sensor = mi.load_dict({**lens, "to_world": pose})
    camera = Camera.from_sensor(sensor)
    turned = camera.pose()
    turned[:3, :2] *= -1
    centre = float(camera.cx[0]), float(camera.cy[0])
    flipped = Camera.from_pose(15, 16, camera.focal, camera.focal, *centre, turned)
    made = Dataset.from_mitsuba(scene(), [sensor, camera, flipped], spp=64)
    integrator = mi.load_dict({"type": "path", "max_depth": 6, "hide_emitters": True})
    truth = mi.render(scene(), sensor=sensor, integrator=integrator, spp=256).numpy()
    for view in made.views:
        assert (view.width, view.height) == (15, 16) and view.depth is not None and view.alpha is not None
        np.testing.assert_allclose(view.camera().pose(), camera.pose(), atol=1e-6)
        black = view.image - (1 - view.alpha[..., None])
        assert np.abs(black - truth[..., :3]).mean() < 0.02 < np.abs(black[:, ::-1] - truth[..., :3]).mean()
    uneven = Camera.from_pose(9, 9, -9, -12, 4.5, 4.5, camera.pose())
    refused(lambda: Dataset.from_mitsuba(scene(), [uneven]), "square pixels")
    refused(lambda: Dataset.from_mitsuba(scene(), 2, sise=3), "from_mitsuba: sise: unknown option")
    refused(lambda: Dataset.from_mitsuba(scene(), []), "sensors: 0 is out of range")
    dark = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})
    refused(lambda: Dataset.from_mitsuba(dark, 2), "emitters: the scene has none; add")


def test_a_fit_takes_a_data_set_in_memory(tmp_path: Path) -> None:
    """It resumes and is evaluated with the data set, and without one says that it needs one."""
    train, test = (Dataset.from_mitsuba(scene(), 3, split=split, **OPTIONS) for split in ("train", "test"))
    options: dict[str, Any] = {"preset": "quick", "settings": SETTINGS, "progress": mi_refgs.Progress()}
    run = mi_refgs.fit(train, write_method(tmp_path), output=tmp_path / "run", **options)
    again = mi_refgs.fit(train, output=tmp_path / "run", resume=True, progress=mi_refgs.Progress())
    assert again.trained.iteration == 6
    assert run.render(0, size=8).shape == (8, 8, 4)
    assert run.evaluate(test)["test_views"] == 3
    refused(run.evaluate, "the run records no data set; name one with --data")
    first, *rest = train.views
    for change, folder, said in (
        ({"pixels": Pixels(first.image / 2, first.alpha)}, "run", "1 of 3 images"),
        ({"pixels": Pixels(first.image)}, "new", "alpha, radiance"),
        ({"is_linear_radiance": False}, "new", "alpha, radiance"),
        ({"fx": 0.0}, "new", "fx … to_world"),
        ({"to_world": first.to_world * np.nan}, "new", "fx … to_world"),
    ):
        views, out = replace(train, views=(replace(first, **change), *rest)), tmp_path / folder
        refused(lambda: mi_refgs.fit(views, output=out, resume=out.exists()), said)  # noqa: B023
    data, out = mi_refgs.read_dataset(write_data(tmp_path / "data"), "train"), tmp_path / "own"
    mi_refgs.fit(replace(data, path=Path("none")), write_method(tmp_path), output=out, **options)
    again = mi_refgs.fit(data.path, output=out, resume=True, progress=mi_refgs.Progress())
    assert again.provenance.data == data.path  # now that a folder has the views
    refused(lambda: run.evaluate(train), f"it has {len(train.views)} train views; give test views")
    refused(run.views, "its data set is unknown")
