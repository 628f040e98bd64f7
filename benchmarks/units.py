"""Fits do not depend on the unit of length: the same pictures, with positions in several units.

    python -m benchmarks.units [--size 64] [--views 32] [--json FILE]

`scenes/glossy_demo.xml` is path-traced once; then only the cameras' positions change. Each unit is fitted
with the same seed on one thread, and measured on the test views. Fails (exit code 1) where PSNR differs from
that of the first by more than 0.1 dB, or normals by more than 0.1°.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)
from benchmarks.common.report import write_json

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

UNITS = {"metre": 1.0, "millimetre": 1e3, "1e4 metres": 1e-4, "1e-4 metres": 1e4}
"""How many of the unit a metre is; the first is what the others are compared with."""
SETTINGS = ["surfels.count=3000", "surfels.max_count=4000"]
"""As many as pictures of 64² need."""
PSNR_BOUND = 0.1
"""Decibels."""
NORMAL_BOUND = 0.1
"""Degrees."""


def move(folder: Path, factor: float) -> None:
    """Multiply the cameras' positions in the transforms files; depth maps, which no fit reads, stay."""
    for path in folder.glob("transforms_*.json"):
        content = json.loads(path.read_text(encoding="utf-8"))
        for frame in content["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] *= factor
        write_json(path, content)


def fit(folder: Path) -> dict[str, float]:
    """PSNR and normal error on the test views after a fit."""
    from mi_refgs.fit import config, data, metrics, pictures
    from mi_refgs.fit.train import Trainer

    method = config.load("ref_gaussian", "quick", SETTINGS)
    trainer = Trainer(method, data.load(folder, "train", truth=False))
    trainer.train()
    test: Any = data.load(folder, "test")
    scores: list[dict[str, Any]] = []
    for view in test.views:
        shot = pictures.Shot.of(trainer.view(view.camera()), test)
        psnr = metrics.psnr(shot.image, pictures.target(view))
        scores.append({"psnr": psnr} | metrics.normal_mae_deg(shot.normal, view.normal, view.alpha))
    means = {key: float(np.mean([s[key] for s in scores])) for key in ("psnr", "normal_mae_deg")}
    return means | {"surfels": trainer.surfels.count}


def measure(size: int, views: int) -> list[dict[str, Any]]:
    """One row for each unit."""
    from mi_refgs.fit.dataset import generate
    from mi_refgs.resources import resource_dir

    with tempfile.TemporaryDirectory() as folder:
        data = generate(
            resource_dir("scenes") / "glossy_demo.xml", folder, views=views, test_views=8, size=size, spp=64
        )
        dr.set_thread_count(1)  # sums by scatter are then the same in every run
        rows = []
        for unit, factor in UNITS.items():
            move(data, factor)
            rows.append({"unit": unit} | fit(data))
            move(data, 1 / factor)
            print(json.dumps(rows[-1]), flush=True)
    return rows


def differences(rows: list[dict[str, Any]]) -> tuple[float, float]:
    """The largest differences to the first row: PSNR, dB, and normals, degrees."""
    return tuple(max(abs(row[key] - rows[0][key]) for row in rows) for key in ("psnr", "normal_mae_deg"))


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.units",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--size", type=int, default=64, help="pixels a side (default %(default)s)")
    parser.add_argument("--views", type=int, default=32, help="training views (default %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows there")
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    rows = measure(options.size, options.views)
    if options.json:
        write_json(options.json, rows)
    psnr, normals = differences(rows)
    print(
        f"largest difference: {psnr:.3f} dB (at most {PSNR_BOUND}), {normals:.3f}° (at most {NORMAL_BOUND})"
    )
    return int(psnr > PSNR_BOUND or normals > NORMAL_BOUND)


if __name__ == "__main__":
    sys.exit(main())
