"""`refgs eval`: metrics of a run on its test views."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mi_refgs.cli.command import Flag, OtherData, Rendering, Result, RunFolder, Samples

ROWS = (
    ("image_size", "image size", "{0[0]} × {0[1]} pixels"),
    ("downscale", "downscaled by", "{}"),
    ("psnr", "PSNR", "{:.2f} dB"),
    ("psnr_gain", "PSNR, exposure fitted", "{:.2f} dB"),
    ("ssim", "SSIM", "{:.4f}"),
    ("psnr_region", "PSNR, region of interest", "{:.2f} dB"),
    ("ssim_region", "SSIM, region of interest", "{:.4f}"),
    ("flip", "FLIP", "{:.4f}"),
    ("lpips", "LPIPS", "{:.4f}"),
    ("normal_mae_deg", "normal error, foreground", "{:.2f}°"),
    ("normal_mae_deg_full", "normal error, whole image", "{:.2f}°"),
    ("albedo_psnr", "albedo, PSNR after scale", "{:.2f} dB"),
    ("roughness_mae", "roughness, mean error", "{:.3f}"),
    ("metallic_mae", "metallic, mean error", "{:.3f}"),
    ("env_psnr", "environment map, PSNR", "{:.2f} dB"),
    ("env_correlation", "environment map, corr.", "{:.3f}"),
    ("surface_distance", "surface distance", "{:.2f} % of the size"),
    ("concave_share", "concave pixels", "{:.1%} of the foreground"),
    ("surfels", "surfels", "{}"),
    ("pruned", "pruned", "from {0[surfels]} surfels, training views within {0[psnr]:.1f} dB"),
    ("iterations", "iterations", "{}"),
    ("train_seconds", "training", "{:.0f} s"),
    ("samples", "samples per pixel", "{}"),
    ("ms_per_frame", "frame", "{:.1f} ms"),
)
"""Key of metrics.json, its title and format."""
CONCAVE_ROWS = ("psnr", "normal_mae_deg", "albedo_psnr", "roughness_mae", "metallic_mae", "surface_distance")
"""Rows that also state the number on concave pixels."""
REASONS = {
    "flip": "flip",
    "lpips": "lpips",
    "normal_mae_deg": "normal",
    "env_psnr": "env",
    "albedo_psnr": "albedo",
    "roughness_mae": "roughness",
    "metallic_mae": "metallic",
    "surface_distance": "surface",
    "concave_share": "concave",
}
"""Key → name of the `…_reason` that explains a missing number."""


@dataclass(frozen=True, kw_only=True)
class Eval:
    """Writes metrics.json, renders, and contact sheets compared with ground truth to the run folder.

    example:
      refgs eval runs/glossy --json
    """

    run_folder: RunFolder
    data: OtherData = None
    samples: Samples = 1
    antialias: Flag = False
    """widen roughness by the variation of normals within a pixel, also where the fit did not"""
    common: Rendering = Rendering()

    def run(self) -> Result:
        """Evaluate the run."""
        from mi_refgs.evaluation.evaluate import DECOMPOSITION, SHEET, evaluate
        from mi_refgs.runs.run import Run

        folder = Run(self.run_folder)
        result = evaluate(folder, self.data, progress=True, samples=self.samples, antialias=self.antialias)
        return Result(result, f"{table(result)}\nsheets: {self.run_folder / SHEET}, {DECOMPOSITION}")


def table(result: dict[str, Any]) -> str:
    """Return the numbers of metrics.json as text."""
    lines = []
    for key, name, form in ROWS:
        if result[key] is not None:
            concave = result.get(f"{key}_concave") if key in CONCAVE_ROWS else None
            suffix = "" if concave is None else f"  (concave: {form.format(concave)})"
            lines.append(f"{name:<27}{form.format(result[key])}{suffix}")
        elif key in REASONS:
            lines.append(f"{name:<27}none: {result[f'{REASONS[key]}_reason']}")
    return "\n".join(lines)
