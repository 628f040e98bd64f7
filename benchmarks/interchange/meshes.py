"""Baked meshes in other programs: `python -m benchmarks.interchange.meshes RUN… --node FOLDER`.

The `mitsuba` command of a plain Mitsuba renders the exported scene; Khronos' validator (FOLDER is where
`npm install gltf-validator` was run) reads the glTF file, and USD's validators the .usdz. PSNR in dB of test
views, as they are displayed, against ground truth: of our image, of ours with the materials
alone that are exported, and of Mitsuba's; and of Mitsuba's against ours.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

# isort: split
import mitsuba as mi
import numpy as np

from benchmarks.common.report import plain_parser
from benchmarks.interchange.programs import validated
from mi_refgs.evaluation.images import displayed_over, image_array
from mi_refgs.evaluation.metrics import psnr
from mi_refgs.formats import write
from mi_refgs.io.exr import read_exr_image
from mi_refgs.reconstruction.provenance import Provenance
from mi_refgs.runs.relightable import relightable
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.runs.views import views_of_run

OURS_SAMPLES = 4


def main() -> None:
    """Print one JSON object a run."""
    parser = plain_parser("interchange.meshes", __doc__)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--node", type=Path, help="folder of node_modules (default: no validator of glTF)")
    parser.add_argument("--views", type=int, nargs="+", default=[0, 7, 13])
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("--faces", type=int, default=50_000)
    parser.add_argument("--mitsuba", default="llvm_ad_rgb", help="variant of the mitsuba command")
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    for run in args.runs:
        with tempfile.TemporaryDirectory() as folder:
            print(json.dumps(measured(run, Path(folder), args)), flush=True)


def measured(folder: Path, out: Path, args: Any) -> dict[str, Any]:
    """The numbers of one run."""
    run = Run(folder)
    views = views_of_run(run, run.method(), "test", None)
    trained = TrainedScene.read(folder)
    shots = Provenance.of(run).shots(trained, "test", "train")
    files = write(trained, ["mitsuba", "gltf-mesh", "usd"], out, shots, {"faces": args.faces})
    found: dict[str, Any] = {"run": folder.name, "usd": usd_errors(files["usd"][0])}
    if args.node is not None:
        issues = validated(files["gltf-mesh"][0], args.node)
        found["gltf"] = {"errors": issues["numErrors"], "warnings": issues["numWarnings"]}
    command = Path(sys.executable).with_name("mitsuba")
    whole, alone = (
        scene.renderer(aovs=False, samples=OURS_SAMPLES) for scene in (trained, relightable(trained))
    )
    rows = []
    for index in args.views:
        view, image = views.views[index].load(), out / f"{index}.exr"
        options = ["-m", args.mitsuba, "-s", str(index), "-D", f"spp={args.spp}", "-o", str(image)]
        subprocess.run([command, *options, files["mitsuba"][0]], check=True, capture_output=True)

        def displayed(rgba: np.ndarray) -> np.ndarray:
            return displayed_over(rgba, views.background)

        def ours(frame: Any, height: int = view.height, width: int = view.width) -> np.ndarray:
            return displayed(image_array([*frame.radiance, frame.alpha], height, width))

        stock, first = displayed(read_exr_image(image)), ours(whole(view.camera()))
        second, truth = ours(alone(view.camera())), view.displayed
        rows.append([psnr(first, truth), psnr(second, truth), psnr(stock, truth), psnr(stock, first)])
    names = "ours", "ours, materials alone", "mitsuba", "mitsuba against ours"
    means = np.mean(rows, axis=0)
    return found | {name: round(float(mean), 2) for name, mean in zip(names, means, strict=True)}


def usd_errors(path: Path) -> int:
    """Errors that USD's own validators find."""
    from pxr import Usd, UsdValidation

    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    return len(UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path))))


if __name__ == "__main__":
    main()
