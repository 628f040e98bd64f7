"""The unit of length is free: a scene that is scaled as a whole, or moved far away, stays the same."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs import methods
from mi_refgs.data.dataset import Dataset, read_dataset
from mi_refgs.data.region import Region, write_region
from mi_refgs.data.survey import survey
from mi_refgs.fitting.initial import initial_surfels
from mi_refgs.fitting.optim import Adam, LearningRate
from mi_refgs.fitting.schedule import FitSetup
from mi_refgs.reconstruction.provenance import Provenance
from mi_refgs.runs.run import Run
from mi_refgs.runs.views import views_of_run
from tests.scenes import dots, layouts
from tests.scenes.tiny import write_data

SCALES = (1e-6, 3e-3, 1e3, 1e6)


@pytest.mark.parametrize("scale", [SCALES[0], SCALES[-1]])
def test_initial_surfels_scale_with_the_data_set(scale: float, tmp_path: Path) -> None:
    scale = 2.0 ** round(np.log2(scale))  # exact, so that no point changes its place in the table
    write_data(tmp_path, views=4)
    small = read_dataset(tmp_path, "train")
    move_cameras(tmp_path, lambda position: scale * position)
    large = read_dataset(tmp_path, "train")
    assert large.scene_extent == pytest.approx(scale * small.scene_extent)
    assert large.views[0].camera().near[0] == pytest.approx(scale * small.views[0].camera().near[0])

    def start(data: Dataset) -> dict[str, np.ndarray]:
        method = methods.load("ref_gaussian", "quick", ["surfels.count=100"])
        return initial_surfels(method, data, np.random.default_rng(3)).to_numpy()

    expected, got = start(small), start(large)
    got |= {"position": got["position"] / scale, "scale": got["scale"] - np.log(scale)}
    for name, values in expected.items():
        np.testing.assert_allclose(got[name], values, atol=2e-5, err_msg=name)


@pytest.mark.parametrize("scale", SCALES)
def test_optimiser_step_scales_with_the_scene(scale: float, tmp_path: Path) -> None:
    """Gradients of a length have the inverse unit, Adam's ε too."""

    def step(scale: float) -> np.ndarray:
        folder = write_data(tmp_path / f"{scale}", truth=False)
        move_cameras(folder, lambda position: scale * position)
        groups = FitSetup(methods.load("ref_gaussian", "quick"), read_dataset(folder, "train")).groups({})
        params = {"position": mi.TensorXf(np.zeros((4, 3), np.float32))}
        adam = Adam(params, {"position": groups["position"]})
        slope = np.array([1e-7, 1e-12, 1e-15, 3e-17])[:, None] * np.ones(3)
        dr.set_grad(params["position"], mi.TensorXf((slope / scale).astype(np.float32)))
        adam.step(0)
        return params["position"].numpy() / scale

    np.testing.assert_allclose(step(scale), step(1), rtol=1e-4)
    assert LearningRate(1.0).unit == 1


UTM = np.array([5e5, 4e6 + 4, 120.0])
PLACES = {"small": (1e-5, 0 * UTM), "large": (1e5, 0 * UTM), "far": (1.0, UTM), "small and far": (1e-3, UTM)}
"""Another unit of length, and what is added to positions."""


def move_cameras(data: Path, move: Callable[[np.ndarray], np.ndarray]) -> None:
    """Change the positions of the cameras of a data set."""

    def change(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            matrix = np.array(frame["transform_matrix"])
            matrix[:3, 3] = move(matrix[:3, 3])
            frame["transform_matrix"] = matrix.tolist()

    layouts.change_transforms(data, change)


@pytest.mark.parametrize("place", PLACES)
def test_data_set_is_independent_of_unit_and_origin(place: str, tmp_path: Path) -> None:
    """Read, surveyed, and begun to be fitted; both splits are relative to one point."""
    scale, offset = PLACES[place]
    plain = write_data(tmp_path / "plain", truth=False)
    data = write_data(tmp_path / "data", truth=False)
    move_cameras(data, lambda position: scale * position + offset)
    write_region(data, Region(tuple(offset.tolist()), 0.5 * scale))
    for folder in (plain, data):  # a lone test view, whose own mean has another round number
        layouts.change_transforms(folder, lambda made: made.update(frames=made["frames"][:1]), "test")
    before, after = (read_dataset(folder, "train") for folder in (plain, data))
    test = read_dataset(data, "test")
    assert after.offset == test.offset and after.region == test.region
    assert test.views[0].near == pytest.approx(after.views[0].near, rel=1e-4)
    assert any(after.offset) == any(offset) == any("relative to (500000, 4" in note for note in after.notes)
    assert after.scene_extent == pytest.approx(scale * before.scene_extent, rel=1e-4)
    rest = (offset - after.offset) / scale  # of the scene's middle
    for dataset, folder in ((after, plain), (test, plain)):
        for view, other in zip(dataset.views, read_dataset(folder, dataset.split).views, strict=True):
            expected = other.to_world[:3, 3] + rest
            np.testing.assert_allclose(view.to_world[:3, 3] / scale, expected, rtol=1e-4, atol=1e-5)
            assert np.abs(view.to_world[:3, 3]).max() < 100 * after.scene_extent
    assert after.region is not None
    np.testing.assert_allclose(np.array(after.region.centre) / scale, rest, atol=1e-5)
    assert not any("one place" in note for note in survey(data)["notes"])


def test_a_run_keeps_its_own_origin(tmp_path: Path) -> None:
    """Another part of the data has another mean, but is seen from the same places."""
    data, run = write_data(tmp_path / "data", truth=False), Run(tmp_path / "run")
    move_cameras(data, lambda position: position + UTM)
    views = read_dataset(data, "train")
    own = np.add(views.offset, [100, 0, 0])
    run.create(methods.load("ref_gaussian", "quick"), str(data), None, {}, own.tolist())
    run.write_dataset(str(data), None)
    for found in (views_of_run(run, run.method(), "train"), Provenance.of(run).views("train")):
        moved = found.views[0].to_world[:3, 3] + found.offset
        np.testing.assert_array_equal(found.offset, own)
        np.testing.assert_allclose(moved, views.views[0].to_world[:3, 3] + views.offset, rtol=1e-12)


class FarShot(dots.Shot):
    """A camera that was moved with the points, far away."""

    @property
    def translation(self) -> np.ndarray:
        return super().translation - self.rotation @ UTM


def test_points_of_far_reconstruction_are_shifted_with_cameras(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They move with the cameras, before anything is float32."""
    data = layouts.write_colmap(tmp_path, "txt")
    near = read_dataset(data, "train")
    monkeypatch.setattr(layouts, "POINTS", layouts.POINTS + UTM)
    layouts.write_text(data / "sparse/0", [FarShot(**vars(shot)) for shot in layouts.SHOTS])
    moved = read_dataset(data, "train")
    assert moved.points is not None and near.points is not None
    rest = UTM - moved.offset
    np.testing.assert_allclose(moved.points.position, near.points.position + rest, atol=1e-6)
    for view, other in zip(moved.views, near.views, strict=True):
        np.testing.assert_allclose(view.to_world[:3, 3], other.to_world[:3, 3] + rest, atol=1e-6)
    assert moved.region is not None and near.region is not None
    np.testing.assert_allclose(moved.region.centre, near.region.centre + rest, atol=1e-4)
