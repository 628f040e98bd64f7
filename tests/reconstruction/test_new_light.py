"""New lights: orientation, rotation, exposure; ground truth under them."""

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mi_refgs.io.exr import write_exr
from mi_refgs.reconstruction.new_light import NewLight, truth_under
from mi_refgs.shade.light.envmap import EnvironmentLight
from tests.helpers import refused
from tests.scenes.known import other_sky


def radiance_along(light: EnvironmentLight, direction: Any) -> np.ndarray:
    """Radiance (3, ...) from directions (3, ...)."""
    return np.squeeze(np.array(light.unfiltered().radiance(mi.Vector3f(direction))))


def test_panorama_zenith_is_z_and_rotates_about_it(tmp_path: Path) -> None:
    """The first row emits from +z; a rotation by 90° moves radiance from +x to +y."""
    image, file = np.full((32, 64, 3), 0.1, np.float32), tmp_path / "a.exr"
    image[:4] = (3, 0, 0)
    image[12:20, 30:34] = (0, 5, 0)
    write_exr(file, image)
    upright = NewLight(str(file)).read()  # type: ignore[arg-type]
    np.testing.assert_allclose(radiance_along(upright, [0, 0, 1]), (3, 0, 0), atol=0.05)
    np.testing.assert_allclose(radiance_along(upright, [0, 0, -1]), 0.1, atol=0.01)
    as_it_lies = NewLight(file, world=True).read()
    np.testing.assert_allclose(radiance_along(as_it_lies, [0, 1, 0]), (3, 0, 0), atol=0.05)
    angles = np.radians(np.arange(0, 360, 5))
    horizon = np.stack([np.cos(angles), np.sin(angles), 0 * angles])
    around = radiance_along(upright, horizon)[1]
    assert around.max() > 4
    turned = NewLight(file, rotate=90).read()
    np.testing.assert_allclose(radiance_along(turned, horizon)[1], np.roll(around, 18), atol=0.7)
    brighter, plain = (x.radiance().numpy() for x in (NewLight(file, exposure=1.5).read(), upright))
    np.testing.assert_allclose(brighter, 2**1.5 * plain, rtol=1e-3, atol=3e-4)


def test_ground_truth_is_found_by_the_content_of_the_light(known: Path, tmp_path: Path) -> None:
    data = known / "data"
    shutil.copy(known / "dusk.exr", tmp_path / "other name.exr")
    found = truth_under(NewLight(tmp_path / "other name.exr", exposure=1), data)
    assert found is not None and found[0] == data / "relight" / "dusk"
    assert found[1] == NewLight(data / "relight/dusk/environment.exr", True, 0, 1)
    own = truth_under(NewLight(data / "environment.exr", world=True), data)
    assert own is not None and own[0] == data
    write_exr(tmp_path / "dusk.exr", 2 * other_sky())
    dusk = NewLight(known / "dusk.exr")
    for light in (replace(dusk, rotate=10), NewLight(tmp_path / "dusk.exr"), replace(dusk, world=True)):
        assert truth_under(light, data) is None
    assert truth_under(dusk, tmp_path) is None
    refused(lambda: truth_under(NewLight(data / "environment.exr"), data), "add --world")


def test_images_of_a_room_are_no_ground_truth_under_its_light(known: Path, tmp_path: Path) -> None:
    """environment.exr of an open scene: its test views show the room, too."""
    shutil.copytree(known / "data", tmp_path / "data")
    (tmp_path / "data" / "region.json").write_text("{}")
    assert truth_under(NewLight(tmp_path / "data" / "environment.exr", world=True), tmp_path / "data") is None


def test_data_set_may_have_the_name_of_a_light(tmp_path: Path) -> None:
    """The data set's own images are not those under that light."""
    data, light = tmp_path / "dusk", tmp_path / "dusk.exr"
    write_exr(light, other_sky())
    for folder in (data, data / "relight" / "dusk"):
        folder.mkdir(parents=True)
        (folder / "environment.exr").write_bytes(b"")
        (folder / "transforms_test.json").write_text("{}")
    digest = hashlib.sha256(light.read_bytes()).hexdigest()
    (data / "dataset.json").write_text(json.dumps({"relight": {"dusk": digest}}))
    found = truth_under(NewLight(light), data)
    assert found is not None and found[0] == data / "relight" / "dusk"
