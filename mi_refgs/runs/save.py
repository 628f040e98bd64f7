"""A run folder of a scene that was not fitted there: edited, imported, relit or copied.

It holds what a fitted run holds (`runs.run`, `runs.export`) but its checkpoints, logs and previews.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mi_refgs.data.region import Region
from mi_refgs.errors import InputError
from mi_refgs.io.files import make_folder
from mi_refgs.methods.method import Method
from mi_refgs.runs.export import export
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.splat import Camera


def save(
    trained: TrainedScene,
    folder: Path,
    method: Method,
    camera: Camera,
    *,
    more: Sequence[Camera] = (),
    data: Path | None = None,
    region: Region | None = None,
    records: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Write a scene as a run folder, which every command that takes a run reads; returns its artefacts.

    `camera` and `more` become the sensors of scene.xml; `data` is the data set of its test views, and
    `region` that of interest; `records` are JSON files by name. config.toml is written last: where it is, the
    folder is complete. Raises InputError for a folder that holds a run, has a foreign file in the way or
    cannot be written, and for a value that is not finite.
    """
    run = Run(folder)
    if run.exists():
        raise InputError(
            f"{folder}: holds a run already, which nothing is written into; choose another folder"
        )
    make_folder(folder)
    with run.alone():
        run.output.require_free()
        written = export(trained, folder, camera, more)
        if data is not None:
            run.write_dataset(str(data.resolve()), region)
        for name, content in (records or {}).items():
            run.write_json(name, content)
        run.write_method(method)
    return written
