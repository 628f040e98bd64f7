"""From a data set to a `Reconstruction`."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from dataclasses import replace
from pathlib import Path

from mi_refgs.capture.triangulate import with_points
from mi_refgs.errors import InputError
from mi_refgs.evaluation.progress import Bar, Previews
from mi_refgs.fitting import runner
from mi_refgs.fitting.progress import Progress
from mi_refgs.kernels.device import require_supported_variant
from mi_refgs.methods.method import Method
from mi_refgs.reconstruction.reconstruction import Reconstruction, load


def fit(
    data: str | Path,
    method: str | Path | Method | None = None,
    *,
    preset: str | None = None,
    minutes: float | None = None,
    settings: runner.Settings = (),
    output: str | Path | None = None,
    resume: bool = False,
    progress: bool | Progress = True,
) -> Reconstruction:
    """Fit surfels, materials and a light to the pictures in folder `data`: `refgs train`.

    method: a method that ships with the package (`variants/`), the path of a .toml, or a `Method`; None fits
    the full method, and to pictures without alpha the one that fits their surroundings too. preset: "quick",
    "standard" (the default) or "paper", how long. minutes: time that the fit may take, by smaller or larger
    pictures. settings: changes of the method, {"loss.ssim": 0.1} or ["loss.ssim=0.1"].

    output: the run folder, which is kept. Without one a temporary folder is used, which is removed when no
    `Reconstruction` of it is left; `save` keeps what was found. resume: go on with the run in `output`, if
    there is one; other arguments are those that it was started with, or absent. progress: True shows messages
    and a bar on standard error, False nothing but Python's warnings; a `Progress` listens to each step.

    Raises InputError for bad input, and KeyboardInterrupt with a message that says where the checkpoints are.
    """
    require_supported_variant("mi_refgs.fit")
    listener = progress if isinstance(progress, Progress) else Bar() if progress else Previews()
    if output is None and resume:
        raise InputError("resume: there is no run to go on with; give its folder as `output`")
    keeper = _Temporary() if output is None else None
    folder = Path(output) if output is not None else keeper.path if keeper is not None else Path()
    if keeper is not None:
        listener.say(f"{folder}: the run, removed with its last Reconstruction; `save` keeps one")
    named = str(method) if isinstance(method, Path) else method
    try:
        runner.fit(
            Path(data),
            folder,
            named,
            preset=preset,
            settings=settings,
            resume=resume,
            minutes=minutes,
            progress=listener,
            find_points=with_points,
        )
    except KeyboardInterrupt:
        if keeper is not None:
            keeper.remove.detach()  # the checkpoints stay: they are what the fit goes on from
        raise
    return replace(load(folder), _keeper=keeper)


class _Temporary:
    """A folder that goes with this object, at the latest with the process."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="refgs_"))
        self.remove = weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)
