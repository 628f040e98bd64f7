"""The numbers of metrics.json that `refgs eval` prints and `refgs compare` tabulates."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Score:
    """A number of metrics.json."""

    key: str
    title: str
    form: str  # for `str.format`, without the unit
    unit: str = ""
    reason: str = ""  # `REASON_reason` says why the number is missing
    compared: bool = False  # whether it is a column of comparisons
    concave: bool = False  # whether there is a number of concave pixels, too: `KEY_concave`


SCORES = (
    Score("image_size", "image size", "{0[0]} × {0[1]}", " pixels"),
    Score("psnr_aligned", "PSNR, aligned", "{:.2f}", " dB", compared=True),
    Score("psnr_aligned_region", "PSNR, aligned, region", "{:.2f}", " dB", compared=True),
    Score("psnr_aligned_object", "PSNR, aligned, object", "{:.2f}", " dB", compared=True),
    Score("psnr", "PSNR", "{:.2f}", " dB", compared=True, concave=True),
    Score("psnr_region", "PSNR, region of interest", "{:.2f}", " dB"),
    Score("psnr_object", "PSNR, object", "{:.2f}", " dB", "object"),
    Score("ssim", "SSIM", "{:.4f}", compared=True),
    Score("ssim_region", "SSIM, region of interest", "{:.4f}"),
    Score("lpips", "LPIPS", "{:.4f}", "", "lpips", compared=True),
    Score("normal_mae_deg", "normal error, foreground", "{:.2f}", "°", "normal", True, concave=True),
    Score("normal_mae_deg_full", "normal error, whole image", "{:.2f}", "°", "normal", True),
    Score("albedo_psnr", "albedo, PSNR after scale", "{:.2f}", " dB", "albedo", concave=True),
    Score("roughness_mae", "roughness, mean error", "{:.3f}", "", "roughness", concave=True),
    Score("metallic_mae", "metallic, mean error", "{:.3f}", "", "metallic", concave=True),
    Score("env_psnr", "environment map, PSNR", "{:.2f}", " dB", "env"),
    Score("env_correlation", "environment correlation", "{:.3f}", "", "env", compared=True),
    Score("surface_distance", "surface distance", "{:.2f}", " % of the size", "surface", concave=True),
    Score("concave_share", "concave pixels", "{:.1%}", " of the foreground", "concave"),
    Score("train_seconds", "training", "{:.0f}", " s", compared=True),
    Score("surfels", "surfels", "{:.0f}", compared=True),
    Score("iterations", "iterations", "{}"),
    Score("downscale", "downscaled for the fit by", "{:g}"),
    Score("samples", "samples per pixel", "{}"),
    Score("ms_per_frame", "frame", "{:.1f}", " ms", compared=True),
)

PIXEL_CLASSES = {
    "silhouette": "silhouette, within 2 px",
    "crease": "crease or depth edge",
    "mirror_blocked": "smooth, mirror ray blocked",
    "mirror_free": "smooth, mirror ray free",
    "smooth": "smooth",  # where the data set has no true surface to trace mirror rays against
    "background": "background",
}
"""Classes of pixels in `error_budget`: key in metrics.json → name in the table of `refgs eval`."""


def caption(size: Sequence[int], relit: bool = False) -> dict[str, str]:
    """Return `scale`, `mask` and `frame` of a table of images with this width and height."""
    scale = "images unscaled; albedo and environment map by least squares per channel, one for all views"
    mask = "whole images; normals and materials where ground-truth alpha > ½; aligned: pose and gains are"
    mask += " fitted to half of a checkerboard (16 fields along the longer side), the other half is scored"
    if relit:
        scale = "unscaled, and by least squares of displayed colours per channel, one for all images"
        mask = "whole images"
    frame = f"whole image of {size[0]} × {size[1]} pixels, over the background of the data"
    return {"scale": scale, "mask": mask, "frame": frame}


def caption_lines(found: Mapping[str, str]) -> list[str]:
    """Return a caption as lines of text."""
    return [f"{key + ':':<7}{text}" for key, text in found.items()]
