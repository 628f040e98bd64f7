"""A PLY file of splats as a relightable object: views of it are rendered, and fitted like photographs."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mi_refgs import methods
from mi_refgs.constants import DEFAULT_PRESET
from mi_refgs.data.checks import border_of
from mi_refgs.data.dataset import held_out
from mi_refgs.errors import InputError
from mi_refgs.fitting import runner
from mi_refgs.formats import Shot
from mi_refgs.formats.cameras import TRANSFORMS, transforms
from mi_refgs.formats.orbits import shots_around
from mi_refgs.io.files import write_json
from mi_refgs.io.images import straight_srgb, write_png
from mi_refgs.io.ownership import RUN, own_folder
from mi_refgs.io.progress import with_bar
from mi_refgs.methods.read import PRESETS
from mi_refgs.reconstruction.fit import fit
from mi_refgs.reconstruction.reconstruction import Reconstruction, import_splats
from mi_refgs.runs.run import DATA, Run
from mi_refgs.splat import Camera

PURPOSE = "relighting"  # of the default method: `auto` would keep colours alone, which are those of the file
VIEWS = {"train": 100, "test": 12}
ELEVATION = (-90.0, 90.0)  # degrees: files of other programs have any side up
OPAQUE_BORDER = 0.3  # mean alpha at the border of the views above which a file is a scene: a room has 0.48


def import_relightable(
    path: str | Path,
    output: str | Path,
    *,
    linear: bool = False,
    box: Sequence[float] | None = None,
    cameras: Sequence[Camera] | None = None,
    method: str | Path | None = None,
    preset: str | None = None,
    progress: bool | runner.Progress = True,
) -> Reconstruction:
    """Fit materials, normals and an environment map to views of a PLY file of 3DGS or 2DGS.

    Views from all around become a data set, `data` in the run folder `output`. linear, box: as in
    `import_splats`. cameras: of the views; every eighth is a test view. method, preset, progress: as in
    `fit`, by default that for relighting; the preset also chooses the size of the views. Raises InputError as
    both do, for a file that shows no free object, and for a folder with another run or foreign files."""
    path, run = Path(path), Run(output)
    run.require_none()
    method = str(methods.for_purpose(PURPOSE) if method is None else method)
    wanted = runner.load_method(method, preset)
    made = import_splats(path, linear=linear, box=box)
    if made.trained.light is not None:
        remedy = "import it without --relightable, and relight that"
        raise InputError("it has materials already", path, "vertex", remedy)
    chosen = [(split, enumerate(held_out(cameras or (), split))) for split in VIEWS]
    given = [Shot(f"{split}/r_{i:03d}", split, camera) for split, some in chosen for i, camera in some]
    views, owner = run.path / DATA, f"import of {path.resolve()}"
    pixels = PRESETS.get(wanted.preset, PRESETS[DEFAULT_PRESET]).pixels
    shots = given or shots_around(made.trained.surfels, VIEWS, math.isqrt(pixels), ELEVATION)
    _require_object(made, shots, path)
    with run.alone():
        own_folder(run.path, RUN)
        own_folder(views, owner)
        try:
            for shot in with_bar(shots, "views", unit="view", disable=progress is False):
                write_png(views / f"{shot.name}.png", straight_srgb(made.render(shot.camera)))
        except KeyboardInterrupt as error:
            raise type(error)("interrupted while views were rendered; repeat the command") from None
        write_json(views / TRANSFORMS, transforms(shots))
    return fit(views, method, preset=preset, output=output, progress=progress)


def _require_object(made: Reconstruction, shots: Sequence[Shot], path: Path) -> None:
    """Raise InputError if the test views show nothing, or are opaque up to the border, as within a scene."""
    cameras = [shot.camera for shot in shots if shot.split == "test"]
    seen = [made.render(camera, size=64)[..., 3] for camera in cameras]
    if max(alpha.max() for alpha in seen) < OPAQUE_BORDER:
        raise InputError("views of the surfels show nothing", path, "opacity", "export the file again")
    if np.mean([border_of(alpha).mean() for alpha in seen]) > OPAQUE_BORDER:
        what = "views are opaque up to the border, so this is a scene, not a free object"
        raise InputError(what, path, "surfels", "crop the object with --box")
