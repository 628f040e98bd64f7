"""Files of a run in other programs: `python -m benchmarks.interchange RUN --node FOLDER`.

FOLDER is where `npm install @playcanvas/splat-transform gltf-validator @sparkjsdev/spark three` was run. For
each view, PSNR in dB of what each program shows against our image, both display-encoded on black.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import mi_refgs

# isort: split
import mitsuba as mi
import numpy as np

from benchmarks.common.report import plain_parser
from benchmarks.interchange import programs
from mi_refgs.evaluation.images import image_array
from mi_refgs.evaluation.metrics import psnr
from mi_refgs.formats import write
from mi_refgs.formats.gaussians import gaussians
from mi_refgs.reconstruction.provenance import Provenance
from mi_refgs.render.display import display_image
from mi_refgs.render.pipeline import SurfelScene, render
from mi_refgs.shade.shading import Shading


def main() -> None:
    parser = plain_parser("interchange", __doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--node", type=Path, required=True)
    parser.add_argument("--views", type=int, nargs="+", default=[0])
    parser.add_argument("--programs", nargs="+", default=["validator", "transform", "browser", "mitsuba"])
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    print(json.dumps(measured(args.run, args.node, args.views, args.programs), indent=1))


def measured(run: Path, node: Path, views: list[int], names: list[str]) -> dict[str, Any]:
    """What each program makes of the files of a run."""
    made = mi_refgs.load(run)
    trained = made.trained
    shots = Provenance.of(mi_refgs.Run(run)).shots(trained, "test", "train")
    found: dict[str, Any] = {"run": str(run), "surfels": trained.surfels.count}
    with tempfile.TemporaryDirectory() as name:
        files = write(trained, ["3dgs-ply", "gltf-splats"], Path(name), shots)
        ply, glb = files["3dgs-ply"][0], files["gltf-splats"][0]
        print("exported", file=sys.stderr)
        if "validator" in names:
            found["validator"] = programs.validated(glb, node)
        if "transform" in names:
            found["splat-transform"] = programs.transformed(ply, node)
        table = gaussians(trained, shots, 3, False)  # for our own splatter, by the formula of 3DGS
        view = trained.renderer(aovs=False)
        for index in views:
            camera = shots[index].camera
            frame = view(camera)
            ours = _image(display_image(list(frame.radiance), frame.alpha, [0.0] * 3), camera)
            ours_again = render(SurfelScene(table, Shading("surfel", "radiance")), camera).radiance
            images = {"ours, same file": _image(ours_again, camera)}
            if "browser" in names:
                images["Spark in Chromium"] = programs.in_browser(ply, camera, node)
            if "mitsuba" in names:
                images["volprim_rf_basic"] = programs.in_mitsuba(ply, camera)
            found[shots[index].name] = {
                title: round(psnr(np.clip(x, 0, 1), ours), 2) for title, x in images.items()
            }
    return found


def _image(planes: Any, camera: Any) -> np.ndarray:
    return np.clip(image_array(planes, camera.height, camera.width), 0, 1)


if __name__ == "__main__":
    main()
