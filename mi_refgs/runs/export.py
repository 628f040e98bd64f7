"""The artefacts of a run, which other programs can read (docs/formats.md). model.json has the iteration and
training seconds of these files, their names, and the shading options."""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from mi_refgs.data.region import Region
from mi_refgs.errors import InputError
from mi_refgs.io.files import read_json, write_json
from mi_refgs.io.ownership import RUN, own_folder
from mi_refgs.methods.method import Method
from mi_refgs.occlusion.mesh import write_mesh
from mi_refgs.render.scene_xml import write_scene_xml
from mi_refgs.runs import trained_scene as names
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.splat import Camera
from mi_refgs.surfels.ply import write_ply


def export(fitted: TrainedScene, folder: Path, camera: Camera, more: Sequence[Camera] = ()) -> list[Path]:
    """Write the artefacts into `folder`, each atomically; returns their paths. `camera` and `more` become the
    sensors of scene.xml; others' artefacts go. Raises BusyError for a run in training; InputError if a file
    cannot be written or a value is not finite."""
    write: dict[str, Callable[[Path], object]] = {names.SURFELS: partial(write_ply, surfels=fitted.surfels)}
    if fitted.light is not None:
        write[names.LIGHT_MAP] = fitted.light.write
    if fitted.near is not None:
        write[names.NEAR_FIELD] = fitted.near.write
    if fitted.mesh is not None:
        write[names.MESH] = partial(write_mesh, mesh=fitted.mesh)
    if fitted.surroundings is not None:
        write[names.AROUND_FILE] = partial(write_ply, surfels=fitted.surroundings.surfels)
        if fitted.surroundings.background is not None:
            write[names.BACKGROUND_MAP] = fitted.surroundings.background.write
    written = [*write, names.SCENE, names.MODEL]
    light, near, around, behind = (name if name in write else None for name in names.OPTIONAL)
    mesh = names.MESH if names.MESH in write else None
    with Run(folder).alone():
        for name in {*names.ARTEFACTS} - {*written}:
            (folder / name).unlink(missing_ok=True)
        for name, write_file in write.items():
            write_file(folder / name)
        # Transparent without a background: images with alpha are composited after the sRGB encoding, which a
        # scene file cannot express. Without a background map it is black, as in `render`.
        black = (0.0, 0.0, 0.0) if around is not None and behind is None else None
        files = names.SURFELS, light, mesh, around, behind or black, near
        write_scene_xml(folder / names.SCENE, fitted.shading, [camera, *more], *files)
        # Written last: if it is there, the other files are complete.
        note = {"iteration": fitted.iteration, "seconds": fitted.seconds, "surfels": fitted.surfels.count}
        about: dict[str, Any] = {"files": written, "shading": asdict(fitted.shading)}
        if fitted.turntable is not None:
            about["turntable"] = fitted.turntable.numpy().tolist()
        write_json(folder / names.MODEL, note | about, indent=2)
    return [folder / name for name in written]


def fresh(run: Run, method: Method) -> TrainedScene | None:
    """The scene of a checkpoint that is newer than the artefacts; raises InputError if there is neither."""
    shown, model = -1, run.path / names.MODEL
    if (run.path / names.SURFELS).is_file():
        with contextlib.suppress(ValueError, KeyError, TypeError, OverflowError):
            shown = int(read_json(model)["iteration"])
    if any(int(path.stem) > shown for path in run.checkpoints()):
        if (state := run.load_checkpoint()) is not None and int(state["iteration"]) > shown:
            return TrainedScene.from_state(method, state)
    if not model.is_file():
        first = f"wait for the first of a fit that runs, after {method.checkpoint_every} iterations"
        remedy = f"train it with `refgs train DATA -o {run.path} --resume`, or {first}"
        raise InputError("none yet", run.path, "checkpoints", remedy)
    return None


def newest(run: Run, method: Method) -> TrainedScene:
    """The scene of the newest checkpoint or newer artefacts; raises as `TrainedScene.read`."""
    return fresh(run, method) or TrainedScene.read(run.path, method.plugins)


def write_if_stale(run: Run, method: Method, camera: Callable[[TrainedScene], Camera]) -> TrainedScene:
    """Write the artefacts of a run if the newest checkpoint is newer, and read them; or return that
    checkpoint if they cannot be written, as while another process trains. Raises InputError without both."""
    if (newer := fresh(run, method)) is not None:
        try:
            export(newer, run.path, camera(newer))
        except InputError:
            return newer
    return TrainedScene.read(run.path, method.plugins)


def save(
    trained: TrainedScene,
    folder: Path,
    method: Method,
    camera: Camera,
    *,
    more: Sequence[Camera] = (),
    data: Path | None = None,
    region: Region | None = None,
    images: dict[str, str] | None = None,
    offset: Sequence[float] | None = None,
    records: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Write a scene that was not fitted here as a run folder, config.toml last; returns its artefacts.
    `camera` and `more` become the sensors of scene.xml, `data` the data set of test views, `images` digests
    of its training images, `offset` that of positions, `records` JSON files by name. Raises InputError for a
    folder with a run or other files, and as `export` does."""
    run = Run(folder)
    run.require_none()
    own_folder(folder, RUN)
    with run.alone():
        written = export(trained, folder, camera, more)
        if data is not None:
            run.write_dataset(str(data.resolve()), region, images, offset)
        for name, content in (records or {}).items():
            run.write_json(name, content)
        run.write_method(method)
    return written
