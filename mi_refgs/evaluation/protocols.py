"""Protocols of benchmarks: the scale, the mask, the frame and the measures of their tables.

Facts of Stanford-ORB [Kuang et al. 2023] are those of its public evaluation program, `orb/utils/metrics.py`,
`test.py`, `eval_mesh.py`, `scripts/test.py` and `scripts/paper/leaderboard_to_table.py`; facts of TensoIR
[Jin et al. 2023] those of its `renderer.py` and `scripts/relight_importance.py`. Both programs were read, not
run: no number here was compared with one of theirs. Docstrings name the deviations.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.evaluation import metrics
from mi_refgs.evaluation.images import displayed_over, image_array
from mi_refgs.fitting.ssim import WINDOW_RADIUS
from mi_refgs.io.images import psnr_of, srgb_from_linear
from mi_refgs.render.pipeline import Frame

Pixels = Sequence[np.ndarray]
"""Values inside of the mask of each image, (P, C) or (P,)."""
Pair = tuple[np.ndarray, np.ndarray]
"""An image of ours and the ground truth, (H, W, 3)."""

ERODED = 5  # pixels: width of the square by which Stanford-ORB erodes its masks
HDR_PEAK = 4.0  # value at which Stanford-ORB clips linear images, after raising their brightness
RATIO_FLOOR = 1e-6  # smallest prediction by which TensoIR divides


class Maps(NamedTuple):
    """Maps of a view, rendered or ground truth; None where unknown."""

    radiance: np.ndarray  # (H, W, 4) RGBA, linear, premultiplied
    normal: np.ndarray | None = None  # (H, W, 3) world, 0 where there is no surface
    depth: np.ndarray | None = None  # (H, W) along the viewing axis, scene units, 0 where there is no surface
    albedo: np.ndarray | None = None  # (H, W, 3) linear; ground truth (H, W, 4): the last is its coverage
    clipped: bool = False  # radiance of 1 means 1 or more, as in images of 8 bits

    @staticmethod
    def rendered(frame: Frame, normal: np.ndarray, albedo: np.ndarray | None) -> Maps:
        """Copy a frame, whose unit normals (H, W, 3) and albedo (H, W, 3) are copied already."""
        size = normal.shape[:2]
        return Maps(
            image_array([*frame.radiance, frame.alpha], *size),
            normal,
            image_array(frame.depth, *size),
            albedo,
        )

    @staticmethod
    def true(view: View, background: np.ndarray) -> Maps:
        """Return the ground truth of a loaded view that has alpha."""
        assert view.alpha is not None
        radiance = view.colour(background) * view.alpha[..., None]
        albedo, clipped = view.materials.get("albedo"), not view.is_linear_radiance
        return Maps(np.dstack([radiance, view.alpha]), view.normal, view.depth, albedo, clipped)


# ---------------- masks and scales ----------------


def eroded(alpha: np.ndarray) -> np.ndarray:
    """Find pixels (H, W) with alpha > ½, eroded by 5 × 5 pixels; the image's border erodes nothing."""
    return np.asarray(minimum_filter(alpha > 0.5, ERODED, mode="constant", cval=True))


def touched(alpha: np.ndarray) -> np.ndarray:
    """Find pixels (H, W) that the object covers at least in part."""
    return np.asarray(alpha > 0)


def least_squares(ours: Pixels, truth: Pixels) -> np.ndarray:
    """Compute the scale Σ gt·pred / Σ pred² per image and channel, (N, C); 0 for a black prediction."""
    pairs = zip(ours, truth, strict=True)
    return np.array([np.sum(a * b, axis=0) / np.maximum(np.sum(a * a, axis=0), 1e-30) for a, b in pairs])


def median_ratio(ours: Pixels, truth: Pixels) -> np.ndarray:
    """Compute the median of gt / pred per channel over the pixels of all images, once per image (N, C).

    TensoIR's program takes the median of the albedo only, over 20 views, and renders with that albedo; relit
    images are not scaled. Here the median is that of what is compared, albedo or relit images. Between two
    middle ratios it is the lower one, as in PyTorch.
    """
    ratio = np.concatenate(truth) / np.maximum(np.concatenate(ours), RATIO_FLOOR)
    if not len(ratio):
        return np.ones((len(ours), 3))
    return np.tile(np.quantile(ratio, 0.5, axis=0, method="lower"), (len(ours), 1))


# ---------------- measures of Stanford-ORB ----------------


def stanford_orb_psnr(
    ours: np.ndarray,  # (P, 3) inside of the mask
    truth: np.ndarray,  # (P, 3)
    size: int,  # pixels of the frame
) -> float:
    """Compute the PSNR in dB, peak 1, over the whole frame, which is zero outside of the mask.

    It is at least that of a prediction of ½ inside of the mask.
    """
    errors = (float(np.sum((guess - truth) ** 2)) for guess in (ours, 0.5))
    return psnr_of(min(errors) / (3 * size))


def stanford_orb_images(
    ours: np.ndarray,  # (H, W, 4) RGBA, linear, premultiplied
    truth: np.ndarray,  # (H, W, 4)
    inside: np.ndarray,  # (H, W) bool
) -> tuple[dict[str, float], Pair]:
    """Compute `psnr_h`, `psnr_l` and `ssim`; and the images that LPIPS compares.

    PSNR-H, in dB, is of linear values clipped to 0 … 4, both images first multiplied by the ratio of the
    sRGB-encoded ground truth's mean to its linear mean (clipped to 0 … 1). PSNR-L and SSIM are of values
    clipped to 0 … 1, then encoded. The window of SSIM is 3 × 3 pixels, Gaussian, σ = 1.5; the image is
    mirrored at its border. LPIPS compares images that are encoded twice.
    """
    a, b = (np.maximum(rgba[inside][:, :3], 0).astype(np.float64) for rgba in (ours, truth))
    dim = np.clip(b, 0, 1)
    lift = srgb_from_linear(dim).sum() / dim.sum() if dim.any() else 1.0
    high = [np.clip(lift * x, 0, HDR_PEAK) for x in (a, b)]
    low = [srgb_from_linear(np.clip(x, 0, 1)) for x in (a, b)]
    image, goal = np.zeros((2, *inside.shape, 3))
    image[inside], goal[inside] = low
    scores = {
        "psnr_h": stanford_orb_psnr(high[0], high[1], inside.size),
        "psnr_l": stanford_orb_psnr(low[0], low[1], inside.size),
        "ssim": metrics.ssim(image, goal, radius=1, border="mirror"),
    }
    return scores, (srgb_from_linear(image), srgb_from_linear(goal))


def stanford_orb_albedo(ours: Pixels, truth: Pixels, sizes: Sequence[int]) -> float:
    """Compute the mean over images of the PSNR in dB of linear albedo after `least_squares`, clipped to 1."""
    scaled = zip(ours, least_squares(ours, truth), truth, sizes, strict=True)
    return float(np.mean([stanford_orb_psnr(np.clip(a * f, 0, 1), b, size) for a, f, b, size in scaled]))


# ---------------- measures of TensoIR ----------------


def tensoir_images(
    ours: np.ndarray,  # (H, W, 4) RGBA, linear, premultiplied
    truth: np.ndarray,  # (H, W, 4)
    inside: np.ndarray,  # (H, W) bool
) -> tuple[dict[str, float], Pair]:
    """Compute `psnr` in dB and `ssim` of images over white; and these images, which LPIPS compares.

    SSIM's windows of 11 × 11 pixels are inside of the image. TensoIR's relit images have hard outlines; ours
    are blended over white by their alpha.
    """
    image, goal = (displayed_over(rgba, np.ones(3)) for rgba in (ours, truth))
    interior = (slice(WINDOW_RADIUS, -WINDOW_RADIUS),) * 2
    return {"psnr": metrics.psnr(image, goal), "ssim": metrics.ssim(image, goal, interior)}, (image, goal)


def tensoir_albedo(ours: Pixels, truth: Pixels, sizes: Sequence[int]) -> float:
    """Compute the PSNR in dB of albedo after `median_ratio`, clipped to 0 … 1 and encoded by the power 1/2.2.

    The squared error is pooled over the frames of all images, whose background counts as equal. TensoIR
    blends partly covered pixels over white; here they have the albedo itself.
    """
    factors = median_ratio(ours, truth)
    error = sum(
        float(np.sum((np.clip(a * f, 0, 1) ** (1 / 2.2) - np.clip(b, 0, 1) ** (1 / 2.2)) ** 2))
        for a, f, b in zip(ours, factors, truth, strict=True)
    )
    return psnr_of(error / (3 * sum(sizes)))


# ---------------- protocols ----------------


@dataclass(frozen=True)
class Measures:
    """The rules of a benchmark."""

    inside: Callable[[np.ndarray], np.ndarray]  # ground-truth alpha (H, W) → mask (H, W) bool
    factors: Callable[[Pixels, Pixels], np.ndarray]  # relit images, ground truth → scales (N, 3)
    images: Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[dict[str, float], Pair]]
    network: str  # of LPIPS
    albedo: Callable[[Pixels, Pixels, Sequence[int]], float]  # ours, ground truth, pixels of the frames → dB
    normals_in_frame: bool  # whether normals are averaged over the frame, background 0; else over the mask


@dataclass(frozen=True)
class Protocol:
    """How images and maps are compared, in words for captions, and the measures in addition to ours."""

    scale: str  # in `refgs eval`
    relit_scale: str  # in `refgs relight`
    mask: str
    frame: str
    measures: Measures | None = None

    def caption(self, size: Sequence[int], relit: bool) -> dict[str, Any]:
        """Return `scale`, `mask` and `frame` of a table of images with this width and height."""
        frame = f"whole image of {size[0]} × {size[1]} pixels, {self.frame}"
        return {"scale": self.relit_scale if relit else self.scale, "mask": self.mask, "frame": frame}


DEPTH_SCALE = "depth Σ gt·pred / Σ pred², one for all views"
PROTOCOLS = {
    "ours": Protocol(
        scale="images unscaled; albedo and environment map by least squares per channel, one for all views",
        relit_scale="unscaled; where a row says so, least squares of displayed colours per channel, "
        "one for all images",
        mask="whole images; normals and materials where ground-truth alpha > ½",
        frame="over the background of the data",
    ),
    "stanford-orb": Protocol(
        scale=f"images none; albedo Σ gt·pred / Σ pred² per image and channel; {DEPTH_SCALE}",
        relit_scale="Σ gt·pred / Σ pred² of linear values per image and channel",
        mask="ground-truth alpha > ½, eroded by 5 × 5 pixels",
        frame="zero outside of the mask (the benchmark has 512 × 512)",
        measures=Measures(
            eroded, least_squares, stanford_orb_images, "vgg", stanford_orb_albedo, normals_in_frame=False
        ),
    ),
    "tensoir": Protocol(
        scale=f"images none; albedo median of gt / pred per channel, one for all views; {DEPTH_SCALE}",
        relit_scale="median of gt / pred of linear values per channel, one for all images",
        mask="images none; scales, albedo, depth and normals ground-truth alpha > 0",
        frame="over white; the background counts as no error of albedo, depth and normals "
        "(the benchmark has 800 × 800)",
        measures=Measures(
            touched, median_ratio, tensoir_images, "alex", tensoir_albedo, normals_in_frame=True
        ),
    ),
}
"""Name in `--protocol` → protocol."""


def measures_of(name: str, data: Dataset | None) -> Measures | None:
    """Return the measures of a protocol; None for ours.

    Raises InputError for an unknown name, and for a data set without alpha if a mask is required.
    """
    if name not in PROTOCOLS:
        raise InputError(f"--protocol: {name}: unknown; give one of {', '.join(PROTOCOLS)}")
    measures = PROTOCOLS[name].measures
    if measures is not None and data is not None and not data.views[0].has_alpha:
        raise InputError(
            f"{data.path}: alpha: images have none, but {name} compares masked objects; give RGBA images or "
            "masks, or leave --protocol out"
        )
    return measures


def captions(name: str, size: Sequence[int], relit: bool = False) -> dict[str, dict[str, Any]]:
    """Return the captions of our tables and those of a protocol by name, for images of this size."""
    return {key: PROTOCOLS[key].caption(size, relit) for key in ("ours", name)}


@dataclass
class ProtocolScores:
    """Accumulates the measures of a benchmark over test views."""

    measures: Measures
    values: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))  # by key, per view
    lpips_reason: str = ""
    psnr_h_reason: str = ""
    depths: list[tuple[np.ndarray, np.ndarray, int]] = field(default_factory=list)
    """Pixels of ours and of the ground truth inside of the mask, and pixels of the frame, per view."""
    albedos: list[tuple[np.ndarray, np.ndarray, int]] = field(default_factory=list)

    def add(self, ours: Maps, truth: Maps) -> None:
        """Add a view, whose images are scaled already; one whose mask is empty is left out."""
        rules = self.measures
        inside = rules.inside(truth.radiance[..., 3])
        if not inside.any():
            return
        found, shown = rules.images(ours.radiance, truth.radiance, inside)
        if truth.clipped and found.pop("psnr_h", None) is not None:
            self.psnr_h_reason = "ground truth is clipped at 1; EXR images have more (data.images=exr)"
        if not self.lpips_reason:  # a metric that is not installed stays so
            lpips, self.lpips_reason = metrics.lpips(*shown, rules.network)
            found |= {} if lpips is None else {"lpips": lpips}
        if ours.normal is not None and truth.normal is not None:
            known = inside & np.any(truth.normal != 0, axis=-1)
            angle = metrics.angle_deg(ours.normal, truth.normal)[known]
            count = max(1, inside.size if rules.normals_in_frame else len(angle))
            found["normal_cosine"] = float(np.sum(1 - np.cos(np.radians(angle)))) / count
            found["normal_deg"] = float(np.sum(angle)) / count
        for key, value in found.items():
            self.values[key].append(value)
        if ours.depth is not None and truth.depth is not None:
            known = inside & (truth.depth > 0)
            self.depths.append((ours.depth[known], truth.depth[known], inside.size))
        if ours.albedo is not None and truth.albedo is not None:
            known = inside & (truth.albedo[..., 3] > 0)
            self.albedos.append((ours.albedo[known], truth.albedo[known][:, :3], inside.size))

    def result(self) -> dict[str, Any]:
        """Return the measures by key, without those of maps that are unknown; means over views.

        `lpips` and `psnr_h` are None with a reason, such as `lpips_reason`, if they could not be computed.
        """
        found: dict[str, Any] = {"lpips": None, "lpips_reason": self.lpips_reason or None}
        if self.psnr_h_reason:
            found |= {"psnr_h": None, "psnr_h_reason": self.psnr_h_reason}
        found |= {key: float(np.mean(values)) for key, values in self.values.items()}
        if self.depths:
            found["depth_si_mse"] = metrics.depth_si_mse(*zip(*self.depths, strict=True))
        if self.albedos:
            found["albedo_psnr"] = self.measures.albedo(*zip(*self.albedos, strict=True))
        return found


def relit_scores(measures: Measures, ours: Pixels, truth: Pixels) -> dict[str, Any]:
    """Score relit images (H, W, 4), RGBA, linear, premultiplied, after the scale of a benchmark.

    `factors` are the scales, three per image.
    """
    inside = [measures.inside(image[..., 3]) for image in truth]
    a, b = (
        [
            np.maximum(image[mask][:, :3], 0).astype(np.float64)
            for image, mask in zip(part, inside, strict=True)
        ]
        for part in (ours, truth)
    )
    factors, scores = measures.factors(a, b), ProtocolScores(measures)
    for own, true, factor in zip(ours, truth, factors, strict=True):
        scores.add(Maps(own * [*factor, 1]), Maps(true))
    return scores.result() | {"factors": factors.tolist()}
