"""Metrics: closed forms, the training definition of SSIM, normals on both masks, light up to a scale."""

import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.evaluation import metrics
from mi_refgs.fitting.ssim import ssim as training_ssim
from mi_refgs.io.exr import write_exr
from mi_refgs.reference import losses as reference
from mi_refgs.shade.light.envmap import EnvironmentLight


def test_scores_of_selected_pixels() -> None:
    """Those pixels alone count; where they are all, nothing changes; SSIM's windows reach beyond them."""
    rng = np.random.default_rng(5)
    truth = rng.random((24, 20, 3))
    image = np.clip(truth + 0.05 * rng.normal(size=truth.shape), 0, 1)
    where = np.zeros((24, 20), bool)
    where[4:9, 3:15] = True
    image[~where] = 1 - image[~where]
    error = np.mean((image[4:9, 3:15] - truth[4:9, 3:15]) ** 2)
    assert metrics.psnr(image, truth, where) == pytest.approx(-10 * np.log10(error))
    everywhere = np.ones_like(where)
    assert metrics.psnr(image, truth, everywhere) == pytest.approx(metrics.psnr(image, truth))
    assert metrics.ssim(image, truth, everywhere) == pytest.approx(metrics.ssim(image, truth), abs=1e-9)
    assert metrics.ssim(image, truth) < metrics.ssim(image, truth, where) < 1


def test_psnr(rng: np.random.Generator) -> None:
    truth = rng.uniform(0.2, 0.8, (8, 9, 3))
    assert metrics.psnr(truth + 0.1, truth) == pytest.approx(20)
    assert metrics.psnr(truth, truth) == 100
    assert metrics.psnr(np.full((2, 2, 3), 7.0), np.ones((2, 2, 3))) == 100  # clamped to [0, 1]
    assert np.isnan(metrics.psnr(np.full_like(truth, np.nan), truth))


@pytest.mark.parametrize("size", [(16, 21), (7, 30), (1, 1)])
def test_ssim_equals_reference_and_loss(size: tuple[int, int], rng: np.random.Generator) -> None:
    """By scikit-image, by definition and by the Dr.Jit loss; of images smaller than the window, too."""
    height, width = size
    truth = rng.random((height, width, 3)).astype(np.float32)
    image = np.clip(truth + 0.2 * rng.normal(size=truth.shape), 0, 1).astype(np.float32)
    found = metrics.ssim(image, truth)
    assert found == pytest.approx(reference.ssim(image.astype(float), truth.astype(float)), abs=1e-12)
    planes = [[mi.Float(np.ascontiguousarray(a[..., c].ravel())) for c in range(3)] for a in (image, truth)]
    assert float(training_ssim(planes[0], planes[1], width, height)[0]) == pytest.approx(found, abs=2e-6)
    assert metrics.ssim(truth, truth) == pytest.approx(1)


def test_normal_error_over_foreground_and_image() -> None:
    truth = np.zeros((2, 4, 3))
    truth[:, :3] = (0, 0, 1)
    alpha = np.ones((2, 4)) * [1, 1, 0.4, 1]  # third column below the threshold, fourth without a normal
    normal = np.zeros((2, 4, 3))
    angle = np.radians([[10, 30], [20, 0]])
    normal[:, :2] = 5 * np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=-1)
    normal[:, 2:] = (1, 0, 0)
    found = metrics.normal_mae_deg(normal, truth, alpha)
    assert found["normal_mae_deg"] == pytest.approx(15)
    assert found["normal_mae_deg_full"] == pytest.approx(60 / 8)
    assert metrics.normal_mae_deg(0 * normal, truth, alpha)["normal_mae_deg"] == 90
    assert metrics.normal_mae_deg(-truth, truth, alpha)["normal_mae_deg"] == pytest.approx(180)
    assert metrics.normal_mae_deg(normal, truth, 0 * alpha) == {"normal_mae_deg": 0, "normal_mae_deg_full": 0}


def test_environment_up_to_a_scale_per_channel(rng: np.random.Generator) -> None:
    truth = rng.random((8, 16, 3)) ** 2
    scale = np.array([0.5, 2.0, 3.0])
    perfect = metrics.environment(truth / scale, truth)
    assert perfect["env_scale"] == pytest.approx(list(scale))
    assert perfect["env_mae"] == pytest.approx(0, abs=1e-12)
    assert perfect["env_psnr"] == 100 and perfect["env_correlation"] == pytest.approx(1)
    coarse = metrics.environment(np.ones((5, 7, 3)), np.full((8, 16, 3), 0.25))
    assert coarse["env_scale"] == pytest.approx([0.25] * 3) and coarse["env_correlation"] == 0
    noise = metrics.environment(rng.random((8, 16, 3)), truth)
    assert noise["env_psnr"] < 20 and abs(noise["env_correlation"]) < 0.3
    assert all(np.isfinite(list(metrics.environment(0 * truth, truth).values())[1:]))


def test_perfect_environment_has_correlation_1(tmp_path: Path, rng: np.random.Generator) -> None:
    """The true map itself, and read as a light of fewer rows, as a fit would have it."""
    truth = (rng.random((64, 128, 3)) ** 4 + 0.01).astype(np.float32)
    write_exr(tmp_path / "truth.exr", truth)
    for height in (64, 24):
        light = EnvironmentLight.from_file(tmp_path / "truth.exr", height).radiance().numpy()
        scores = metrics.environment(light, truth)
        assert scores["env_correlation"] == pytest.approx(1, abs=1e-6)
        assert scores["env_psnr"] > 90 and scores["env_scale"] == pytest.approx([1] * 3, abs=1e-5)
    # A row on a pole is as much of the sphere as Mitsuba's `envmap` shows of it.
    assert metrics.environment(np.roll(light, 1, axis=0), truth)["env_correlation"] < 0.9


def test_environment_weighs_by_solid_angle() -> None:
    """An error at the pole counts sin θ."""
    truth = np.full((16, 32, 3), 0.5)
    pole, equator = truth.copy(), truth.copy()
    pole[0], equator[8] = 0, 0
    assert metrics.environment(pole, truth)["env_mae"] < 0.15 * metrics.environment(equator, truth)["env_mae"]


def test_missing_extras_are_named(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    for module in ("torch", "lpips"):
        monkeypatch.setitem(sys.modules, module, None)
    image = rng.random((16, 16, 3))
    assert metrics.lpips(image, image) == (None, "not installed: pip install 'mi_refgs[lpips]'")
