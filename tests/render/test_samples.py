"""Several samples per pixel in metrics; those of images are cases of `tests/laws/test_option_pairs.py`."""

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs import methods
from mi_refgs.data import dataset
from mi_refgs.evaluation import metrics
from mi_refgs.evaluation.evaluate import evaluate
from mi_refgs.io.images import srgb_from_linear
from mi_refgs.render.pipeline import Frame
from mi_refgs.render.samples import supersampled
from mi_refgs.runs.export import export
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused
from tests.scenes.integrator import raw_channels
from tests.scenes.tiny import SETTINGS, SIZE, write_data, write_method


def test_one_sample_is_the_pixel_centre_and_none_is_refused() -> None:
    frame, view = Frame(mi.Float(1), mi.Float(1), None, mi.Color3f(1)), Camera.look_at((0, -3, 1), size=4)
    assert supersampled(lambda _: frame, view, 1) is frame
    refused(lambda: supersampled(lambda _: frame, view, 0), "samples: 0")


def test_eval_encodes_the_mean_of_linear_radiance(tmp_path: Path) -> None:
    """PSNR with 2 × 2 samples is that of srgb(mean L / mean A), not of the mean of encoded samples."""
    data, run = write_data(tmp_path / "ball"), Run(tmp_path / "run")
    run.create(methods.load(str(write_method(tmp_path)), "quick", SETTINGS), str(data))
    views = dataset.read_dataset(data, "test")
    raw = raw_channels(200)  # neighbours that differ
    raw["radiance_sh"] = np.random.default_rng(1).normal(scale=10, size=raw["radiance_sh"].shape)
    raw["position"], raw["scale"] = raw["position"] / 2, raw["scale"] - 2
    made = TrainedScene(Surfels.from_numpy(raw), None, None, Shading("surfel", "radiance"), 1, 0.0)
    export(made, run.path, views.views[0].camera())
    once, result = evaluate(run), evaluate(run, samples=4)
    assert once["samples"] == 1 and result["samples"] == 4
    assert abs(once["psnr"] - result["psnr"]) > 1e-3
    scores, encoded_first = [], []
    for view in (view.load() for view in views.views):
        frame = made.renderer()(view.camera().supersampled(2))
        parts = np.array([*frame.radiance, frame.alpha], np.float64).reshape(4, SIZE, 2, SIZE, 2)

        def shown(radiance: np.ndarray, alpha: np.ndarray) -> np.ndarray:
            colour = srgb_from_linear(radiance / np.maximum(alpha, 1e-6))
            return alpha * colour + (1 - alpha) * views.background[:, None, None]

        mean = parts.mean((2, 4))
        scores.append(metrics.psnr(shown(mean[:3], mean[3]).transpose(1, 2, 0), view.image))
        each = [shown(parts[:3, :, i, :, j], parts[3, :, i, :, j]) for i in (0, 1) for j in (0, 1)]
        encoded_first.append(metrics.psnr(np.mean(each, axis=0).transpose(1, 2, 0), view.image))
    assert result["psnr"] == pytest.approx(np.mean(scores), abs=1e-4)
    assert abs(np.mean(encoded_first) - np.mean(scores)) > 1e-3
