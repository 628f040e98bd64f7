"""Parts that are true do not depend on what was fitted there."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import oracle
from mi_refgs.data.dataset import read_dataset
from mi_refgs.render.display import image_array
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.surfels.table import Surfels


def changed(name: str, by: float) -> Callable[[TrainedScene], TrainedScene]:
    """Add waves to an attribute of the surfels."""

    def change(scene: TrainedScene) -> TrainedScene:
        raw = scene.surfels.to_numpy()
        wave = np.sin(np.arange(raw[name].size)).reshape(raw[name].shape)
        return replace(scene, surfels=Surfels.from_numpy(raw | {name: raw[name] + by * wave}))

    return change


def turned(scene: TrainedScene) -> TrainedScene:
    assert scene.mesh is not None
    return replace(scene, mesh=replace(scene.mesh, vertices=scene.mesh.vertices[:, ::-1]))


SPOILT: dict[tuple[str, ...], Callable[[TrainedScene], TrainedScene]] = {
    ("normals",): changed("rotation", 0.2),
    ("materials",): changed("albedo", 2),
    ("materials", "hit materials"): changed("albedo", 2),
    ("light",): lambda scene: replace(scene, light=EnvironmentLight.constant(1, 32)),
    ("mesh",): turned,
}


@pytest.mark.parametrize("parts", SPOILT)
def test_true_parts_replace_what_was_spoilt(
    parts: tuple[str, ...], known: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(oracle, "SCENES", known)
    data, fitted = read_dataset(known / "data", "test"), TrainedScene.read(known / "run")
    truth, view = oracle.Truth(data, 0.1), data.views[0]

    def image(scene: TrainedScene, *true: str) -> Any:
        draw = oracle.renderer(scene, truth, oracle.Case(true, bounces=2), 1, np.ones(3))
        return image_array(draw(view.camera()).radiance, view.height, view.width)

    spoilt = SPOILT[parts](fitted)
    wrong, mended = (np.abs(image(spoilt, *true) - image(fitted, *true)).mean() for true in ((), parts))
    assert wrong > 0.005 and mended < 0.35 * wrong, (wrong, mended)


def test_waves_shorter_than_the_blur_leave_the_spectrum(rng: np.random.Generator) -> None:
    where = np.hypot(*np.mgrid[-20:20, -20:20]) < 15
    noise, tilt = rng.normal(0, 0.01, (40, 40, 3)), np.full((40, 40, 3), 0.01)
    fine, coarse = (oracle.spectrum([error], [where]) for error in (noise, tilt))
    assert fine["0"] == pytest.approx(np.degrees(0.01 * 3**0.5), rel=0.1) and fine["3"] < 0.2 * fine["0"]
    assert coarse["12"] == pytest.approx(coarse["0"])


def test_scale_of_a_light_is_recovered() -> None:
    image = np.linspace(0.1, 1, 30).reshape(10, 3)
    scale = np.array([0.5, 1.2, 2.0])
    found = oracle.light_scale(lambda x: (0.1 + image * x) ** 0.4, (0.1 + image * scale) ** 0.4)
    assert found == pytest.approx(scale)
