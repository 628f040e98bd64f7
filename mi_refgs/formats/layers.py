"""`exr`: one view with all its layers in one EXR file, as Blender, Nuke and Natron name them.

R, G, B, A is the picture: linear radiance, premultiplied. Every other layer is NAME.R, NAME.G, NAME.B, for
vectors NAME.X …, and for one number NAME.V; depth is depth.Z, scene units along the viewing axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mi_refgs.errors import InputError
from mi_refgs.formats.format import Format, Option, Shot
from mi_refgs.formats.gaussian_ply import ALONE

if TYPE_CHECKING:
    from mi_refgs.runs.trained_scene import TrainedScene

VIEW = Option("view", 0, "the view of an EXR file: by number, test views first")
SAMPLES = Option("samples", 4, "samples of a pixel of an EXR file, box filtered: 4 are 2 × 2")
LETTERS = {"normal": "XYZ", "depth": "Z"}
"""Of layers that are no colours."""


def write(
    trained: TrainedScene, target: Path, shots: Sequence[Shot], *, view: int, samples: int, object: bool
) -> list[Path]:
    """Write the file; see `Format.write`."""
    from dataclasses import replace

    import numpy as np

    from mi_refgs.evaluation.images import image_array
    from mi_refgs.io.exr import write_exr_layers
    from mi_refgs.plugins.aovs import aov_values, suffixes
    from mi_refgs.surfels.attributes import CHANNELS

    if not 0 <= view < len(shots):
        raise InputError(
            f"--view: {view} is out of range; there are {len(shots)}, give 0 to {len(shots) - 1}"
        )
    if object:
        trained = replace(trained, surroundings=None)
    camera = shots[view].camera
    frame = trained.renderer(samples=samples)(camera)
    size = camera.height, camera.width
    radiance, alpha = image_array(frame.radiance, *size), image_array(frame.alpha, *size)
    found = dict(zip("RGB", np.moveaxis(radiance, -1, 0), strict=True)) | {"A": alpha}
    for name, letters in suffixes().items():
        if name == "alpha" or (name in CHANNELS and name not in frame.maps):
            continue
        values = [frame.depth] if name == "depth" else aov_values(name, frame, camera)
        letters = LETTERS.get(name, "V" if len(letters) == 1 else letters)
        found |= {
            f"{name}.{letter}": image_array(plane, *size)
            for letter, plane in zip(letters, values, strict=True)
        }
    if frame.background is not None:
        behind = image_array(frame.background, *size)
        found |= {f"background.{letter}": behind[..., i] for i, letter in enumerate("RGB")}
    write_exr_layers(target, found)
    return [target]


EXR = Format("exr", "one view with all its layers", ".exr", write, (VIEW, SAMPLES, ALONE))
