"""Metrics of images, normals and fitted environment maps, in NumPy. Images are (H, W, 3) display-encoded
floats, clamped to [0, 1] and never quantised; normals (H, W, 3) world vectors; environment maps (h, w, 3)
linear lat-long radiance in Mitsuba's orientation. A data set's value is the mean over its images."""

import functools
import time
from collections.abc import Callable, Sequence
from types import EllipsisType
from typing import Any

import drjit as dr
import numpy as np
from skimage.metrics import structural_similarity

from mi_refgs.data.dataset import Dataset
from mi_refgs.fitting.ssim import WINDOW_RADIUS, WINDOW_SIGMA
from mi_refgs.io.images import psnr_of, srgb_from_linear
from mi_refgs.render.display import displayed
from mi_refgs.render.pipeline import Frame
from mi_refgs.shade.light import lobe_matrices
from mi_refgs.splat import Camera

FOREGROUND_ALPHA = 0.5  # true alpha above which a pixel is foreground
FLAT = 1e-12  # variance of encoded values below which a map is constant and has no correlation
WARM_UP_FRAMES = 2  # before the timing: they compile kernels and fill the memory pools
TIMED_FRAMES = 20  # frames whose median is reported; the views repeat if there are fewer


def psnr(image: np.ndarray, truth: np.ndarray, where: np.ndarray | EllipsisType = ...) -> float:
    """Compute the PSNR in dB over all pixels, or those of `where` (H, W), and channels, at most 100."""
    image, truth = _pair(image, truth)
    return psnr_of(float(np.mean((image - truth)[where] ** 2)))


def ssim(image: np.ndarray, truth: np.ndarray, where: np.ndarray | EllipsisType = ...) -> float:
    """Compute the SSIM of the loss (`fitting.ssim`), zeros outside of the image; `where` as in `psnr`."""
    r = WINDOW_RADIUS
    x, y = (np.pad(array, ((r, r), (r, r), (0, 0))) for array in _pair(image, truth))
    options = {"gaussian_weights": True, "sigma": WINDOW_SIGMA, "use_sample_covariance": False, "full": True}
    _, similar = structural_similarity(x, y, data_range=1.0, channel_axis=-1, **options)
    return float(similar[r:-r, r:-r][where].mean())


def lpips(image: np.ndarray, truth: np.ndarray) -> tuple[float | None, str]:
    """Return (LPIPS, ""), or (None, reason) without the extra `lpips` or its weights."""
    try:
        import torch

        measure = _lpips_network()
        with torch.no_grad():
            planes = [array.transpose(2, 0, 1)[None] for array in _pair(image, truth)]
            tensors = [torch.from_numpy(np.ascontiguousarray(p, dtype=np.float32)) * 2 - 1 for p in planes]
            return float(measure(*tensors)), ""
    except ImportError:
        return None, "not installed: pip install 'mi_refgs[lpips]'"
    except (OSError, RuntimeError) as error:  # the weights are fetched at first use
        return None, f"cannot run: {error}"


@functools.cache
def _lpips_network() -> Any:
    import lpips as package

    return package.LPIPS(net="alex", verbose=False).eval()  # as the authors recommend for comparing images


def _pair(*images: np.ndarray) -> list[np.ndarray]:
    return [np.clip(np.asarray(image, np.float64), 0, 1) for image in images]


def normal_mae_deg(normal: np.ndarray, truth: np.ndarray, alpha: np.ndarray) -> dict[str, float]:
    """Compute the mean angle in degrees between normal maps on the foreground, and over the whole image,
    where the background counts as 0°. `normal` is rendered, of any length; `truth` (H, W, 3) is 0 where
    nothing is hit; `alpha` (H, W) is true. A missing rendered normal counts 90° on the foreground."""
    scored = foreground(truth, alpha)
    total = float(np.sum(angle_deg(normal, truth)[scored]))
    count = max(int(scored.sum()), 1)
    return {"normal_mae_deg": total / count, "normal_mae_deg_full": total / scored.size}


def foreground(truth: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Find pixels (H, W) with alpha > FOREGROUND_ALPHA and a true normal (H, W, 3)."""
    return np.asarray((alpha > FOREGROUND_ALPHA) & (np.linalg.norm(truth, axis=-1) > 0))


def angle_deg(normal: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Compute angles (H, W) in degrees between normals of any length; 90° where one is 0."""
    normal, truth = np.asarray(normal, np.float64), np.asarray(truth, np.float64)
    # atan2 keeps small angles exact, where acos of a float32 dot product cannot go below 0.03°.
    cosine = np.sum(normal * truth, axis=-1)
    sine = np.linalg.norm(np.cross(normal, truth), axis=-1)
    return np.where((cosine == 0) & (sine == 0), 90.0, np.degrees(np.arctan2(sine, cosine)))


def environment(light: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Compare a fitted environment map with the ground truth after a least-squares scale per channel,
    weighted by solid angle, on the fitted one's grid. Keys: `env_scale` (three numbers), `env_mae` (linear),
    `env_psnr` (dB, sRGB-encoded in [0, 1]) and `env_correlation` (Pearson, of the same)."""
    light, truth = np.asarray(light, np.float64), np.asarray(truth, np.float64)
    rows = lobe_matrices.resampling(len(truth), len(light)).toarray()
    columns = lobe_matrices.resampling(truth.shape[1], light.shape[1], periodic=True).toarray()
    truth = np.einsum("ih,jw,hwc->ijc", rows, columns, truth, optimize=True)
    weight = np.broadcast_to(lobe_matrices.row_areas(len(light))[:, None, None], light.shape)
    power = np.sum(weight * light**2, axis=(0, 1))
    scale = np.sum(weight * light * truth, axis=(0, 1)) / np.maximum(power, 1e-30)
    fitted = light * scale
    shown, goal = (np.clip(srgb_from_linear(array), 0, 1) for array in (fitted, truth))
    error = float(np.average((shown - goal) ** 2, weights=weight))
    shown, goal = (array - np.average(array, weights=weight) for array in (shown, goal))
    spread = float(np.sqrt(np.sum(weight * shown**2) * np.sum(weight * goal**2)))
    correlation = float(np.sum(weight * shown * goal)) / spread if spread > FLAT * weight.sum() else 0.0
    return {
        "env_scale": [float(value) for value in scale],
        "env_mae": float(np.average(np.abs(fitted - truth), weights=weight)),
        "env_psnr": psnr_of(error),
        "env_correlation": correlation,
    }


def frame_milliseconds(render: Callable[[Camera], Frame], cameras: Sequence[Camera], data: Dataset) -> float:
    """Return the median time per synchronised frame up to the displayed image."""
    seconds = []
    for i in range(WARM_UP_FRAMES + TIMED_FRAMES):
        dr.sync_thread()
        begin = time.perf_counter()
        dr.eval(displayed(render(cameras[i % len(cameras)]), data.background, data.is_linear_radiance))
        dr.sync_thread()
        seconds.append(time.perf_counter() - begin)
    return 1000 * float(np.median(seconds[WARM_UP_FRAMES:]))
