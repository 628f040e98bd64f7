"""Fits do not depend on the unit of length: the same images, with positions in several units.

    python -m benchmarks.units [--size 64] [--views 32] [--seeds 4] [--json FILE]

`scenes/glossy_demo.xml` is path-traced once; then only the cameras' positions change. Each unit is fitted on
one thread and measured on the test views. Another unit rounds otherwise, log scales too, and a fit magnifies
rounding as it magnifies another seed: the means over the seeds are compared. Fails (exit code 1) where PSNR
differs from that of the first unit by more than 0.1 dB, or normals by more than 0.1°.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)
from benchmarks.common.report import plain_parser
from mi_refgs.io.files import read_json, write_json

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

UNITS = {"metre": 1.0, "millimetre": 1e3, "1e4 metres": 1e-4}
"""How many of the unit a metre is; the first is what the others are compared with."""
SETTINGS = ["surfels.count=3000", "surfels.max_count=4000"]
"""As many as images of 64² need."""
TEST_VIEWS = 16
PSNR_BOUND = 0.1
"""Decibels."""
NORMAL_BOUND = 0.1
"""Degrees."""


def move(folder: Path, factor: float) -> None:
    """Multiply the cameras' positions in the transforms files; depth maps, which no fit reads, stay."""
    for path in folder.glob("transforms_*.json"):
        content = read_json(path)
        for frame in content["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] *= factor
        write_json(path, content)


def fit(folder: Path, seed: int) -> dict[str, float]:
    """PSNR and normal error on the test views after a fit."""
    from mi_refgs import methods
    from mi_refgs.data import dataset
    from mi_refgs.evaluation import images, metrics
    from mi_refgs.fitting.train import Trainer

    method = methods.load("ref_gaussian", "quick", [*SETTINGS, f"seed={seed}"])
    trainer = Trainer(method, dataset.read_dataset(folder, "train", truth=False))
    trainer.train()
    test: Any = dataset.read_dataset(folder, "test")
    scores: list[dict[str, Any]] = []
    for view in (view.load() for view in test.views):
        shot = images.RenderedView.of(trainer.view(view.camera()), test, view)
        psnr = metrics.psnr(shot.image, view.displayed)
        scores.append({"psnr": psnr} | metrics.normal_mae_deg(shot.normal, view.normal, view.alpha))
    means = {key: float(np.mean([s[key] for s in scores])) for key in ("psnr", "normal_mae_deg")}
    return means | {"surfels": trainer.surfels.count}


def measure(size: int, views: int, seeds: int) -> list[dict[str, Any]]:
    """One row for each fit."""
    from mi_refgs.io.resources import resource_dir
    from mi_refgs.synthesis.make_dataset import make_dataset

    jobs = [(unit, factor, seed) for seed in range(seeds) for unit, factor in UNITS.items()]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        scene = resource_dir("scenes") / "glossy_demo.xml"
        data = make_dataset(scene, folder, views=views, test_views=TEST_VIEWS, size=size, spp=64)
        originals = {path: path.read_bytes() for path in data.glob("transforms_*.json")}
        dr.set_thread_count(1)  # sums by scatter are then the same in every run
        for unit, factor, seed in jobs:
            move(data, factor)
            rows.append({"unit": unit, "seed": seed} | fit(data, seed))
            for path, content in originals.items():
                path.write_bytes(content)
            print(json.dumps(rows[-1]), flush=True)
    return rows


def main() -> int:
    parser = plain_parser("units", __doc__)
    parser.add_argument("--size", type=int, default=64, help="pixels a side (default %(default)s)")
    parser.add_argument("--views", type=int, default=32, help="training views (default %(default)s)")
    parser.add_argument("--seeds", type=int, default=4, help="fits of each unit (default %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows there")
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    rows = measure(options.size, options.views, options.seeds)
    if options.json:
        write_json(options.json, rows)
    keys = ("psnr", "normal_mae_deg")
    mean = {
        unit: np.mean([[row[key] for key in keys] for row in rows if row["unit"] == unit], axis=0)
        for unit in UNITS
    }
    first = next(iter(UNITS))
    spread = np.std([row["psnr"] for row in rows if row["unit"] == first], ddof=min(options.seeds - 1, 1))
    print(f"{first}: {mean[first][0]:.3f} dB (standard deviation {spread:.3f}), {mean[first][1]:.3f}°")
    failed = False
    for unit in UNITS:
        psnr, normals = mean[unit] - mean[first]
        failed |= bool(abs(psnr) > PSNR_BOUND or abs(normals) > NORMAL_BOUND)
        print(f"{unit:14} {psnr:+.3f} dB  {normals:+.3f}°")
    print(f"bounds: {PSNR_BOUND} dB, {NORMAL_BOUND}°: {'missed' if failed else 'kept'}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
