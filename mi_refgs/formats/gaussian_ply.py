"""`3dgs-ply`: the PLY file of 3D Gaussian Splatting, which its viewers, editors and converters read.

    x y z  nx ny nz  f_dc_0..2  f_rest_0..  opacity  scale_0..2  rot_0..3      little-endian float32

Logits, logarithms and display-encoded colours, as `surfels.ply` and `formats.splats` say.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mi_refgs.formats.format import Format, Option, Shot

if TYPE_CHECKING:
    from mi_refgs.runs.trained_scene import TrainedScene

DEGREE = Option("degree", 3, "degree of the spherical-harmonic colours of splats, 0 to 3")
ALONE = Option("object", False, "the object without its surroundings; no file of splats has the background")


def write(
    trained: TrainedScene, target: Path, shots: Sequence[Shot], *, degree: int, object: bool
) -> list[Path]:
    """Write the file; see `Format.write`."""
    from mi_refgs.formats.splats import gaussians
    from mi_refgs.surfels.ply import write_ply

    write_ply(target, gaussians(trained, shots, degree, object))
    return [target]


GAUSSIAN_PLY = Format(
    "3dgs-ply", "3D Gaussians with baked colours, for splat viewers", ".ply", write, (DEGREE, ALONE)
)
