"""`refgs eval`: the quality of a run on its test views."""

from __future__ import annotations

import argparse
from typing import Any

from mi_refgs.cli.command import Result, add_command, add_run, add_test_views

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
    ("env_psnr", "light, PSNR after scale", "{:.2f} dB"),
    ("env_correlation", "light, correlation", "{:.3f}"),
    ("surface_distance", "surface distance", "{:.2f} % of the size"),
    ("concave_share", "concave pixels", "{:.1%} of the foreground"),
    ("surfels", "surfels", "{}"),
    ("pruned", "pruned", "from {0[surfels]} surfels, training views within {0[psnr]:.1f} dB"),
    ("iterations", "iterations", "{}"),
    ("train_seconds", "training", "{:.0f} s"),
    ("samples", "samples of a pixel", "{}"),
    ("ms_per_frame", "frame", "{:.1f} ms"),
)
"""Key of metrics.json, name and format of what people read."""
CONCAVE_ROWS = ("psnr", "normal_mae_deg", "albedo_psnr", "roughness_mae", "metallic_mae", "surface_distance")
"""Rows whose number on concave pixels stands behind them."""
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
"""Which `…_reason` explains a missing number."""


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "measure a run on the test views: metrics.json, renders, sheets of ours beside the truth"
    parser = add_command(commands, "eval", summary, "refgs eval runs/glossy --json", run)
    add_run(parser)
    add_test_views(parser)
    parser.add_argument(
        "--antialias",
        action="store_true",
        help="widen roughness by how much normals turn within a pixel, also where the fit did not",
    )


def run(args: argparse.Namespace) -> Result:
    """Evaluate."""
    from mi_refgs.evaluation.evaluate import DECOMPOSITION, SHEET, evaluate
    from mi_refgs.runs.run import Run

    result = evaluate(
        Run(args.run_folder), args.data, progress=True, samples=args.samples, antialias=args.antialias
    )
    return Result(result, f"{table(result)}\nsheets: {args.run_folder / SHEET}, {DECOMPOSITION}")


def table(result: dict[str, Any]) -> str:
    """The numbers of metrics.json for people."""
    lines = []
    for key, name, form in ROWS:
        if result[key] is not None:
            concave = result.get(f"{key}_concave") if key in CONCAVE_ROWS else None
            apart = "" if concave is None else f"  (concave: {form.format(concave)})"
            lines.append(f"{name:<27}{form.format(result[key])}{apart}")
        elif key in REASONS:
            lines.append(f"{name:<27}none: {result[f'{REASONS[key]}_reason']}")
    return "\n".join(lines)
