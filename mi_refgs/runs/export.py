"""The artefacts of a run, which other programs can read.

    surfels.ply       the object: raw attributes, with 2DGS's property names
    envmap.exr        the environment map: lat-long radiance, Mitsuba's orientation
    near_field.npz    distances of what the environment map shows, and its centre
    mesh.ply          the occluder
    surroundings.ply  the background Gaussians, like surfels.ply, with radiance_sh only
    background.exr    the background map, lat-long radiance
    scene.xml         the scene for `mi.load_file`
    model.json        iteration and training seconds of these files, their names, and the shading options

Files of what a method does not model are absent.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from mi_refgs.data.region import Region
from mi_refgs.errors import InputError
from mi_refgs.io.files import BusyError, make_folder, read_json, write_json
from mi_refgs.io.ownership import RUN, own_folder
from mi_refgs.methods.method import Method
from mi_refgs.occlusion.mesh import read_mesh, write_mesh
from mi_refgs.render.scene_xml import SceneFiles, write_scene_xml
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import (
    AROUND_FILE,
    ARTEFACTS,
    BACKGROUND_MAP,
    LIGHT_MAP,
    MESH,
    MODEL,
    NEAR_FIELD,
    SCENE,
    SURFELS,
    TrainedScene,
)
from mi_refgs.splat import Camera
from mi_refgs.surfels.ply import write_ply


def export(fitted: TrainedScene, folder: Path, camera: Camera, more: Sequence[Camera] = ()) -> list[Path]:
    """Write the artefacts into `folder`, each atomically; returns their paths.

    `camera` and `more` become the sensors of scene.xml. Artefacts that the scene does not have are removed.
    Raises BusyError for a run that another process trains; InputError if a file cannot be written or a value
    is not finite.
    """
    light = LIGHT_MAP if fitted.light is not None else None
    near = NEAR_FIELD if fitted.near is not None else None
    mesh = MESH if fitted.mesh is not None else None
    around = AROUND_FILE if fitted.surroundings is not None else None
    behind = BACKGROUND_MAP if fitted.surroundings and fitted.surroundings.background else None
    written = [
        name for name in (SURFELS, light, near, mesh, around, behind, SCENE, MODEL) if name is not None
    ]
    with Run(folder).alone():
        make_folder(folder)
        for name in {*ARTEFACTS} - {*written}:
            (folder / name).unlink(missing_ok=True)
        write_ply(folder / SURFELS, fitted.surfels)
        if fitted.light is not None:
            fitted.light.write(folder / LIGHT_MAP)
        if fitted.near is not None:
            fitted.near.write(folder / NEAR_FIELD)
        if fitted.mesh is not None:
            write_mesh(folder / MESH, fitted.mesh)
        if fitted.surroundings is not None:
            write_ply(folder / AROUND_FILE, fitted.surroundings.surfels)
            if fitted.surroundings.background is not None:
                fitted.surroundings.background.write(folder / BACKGROUND_MAP)
        # Transparent without a background: images with alpha are composited after the sRGB encoding, which a
        # scene file cannot express. Without a background map it is black, as in `render`.
        black = (0.0, 0.0, 0.0) if around is not None and behind is None else None
        files = SceneFiles(SURFELS, light, mesh, around, behind or black, near)
        write_scene_xml(folder / SCENE, files, fitted.shading, [camera, *more])
        # Written last: if it is there, the other files are complete.
        note = {"iteration": fitted.iteration, "seconds": fitted.seconds, "surfels": fitted.surfels.count}
        about = {"files": written, "shading": asdict(fitted.shading)}
        write_json(folder / MODEL, note | about, indent=2)
    return [folder / name for name in written]


def load_if_newer(run: Run, method: Method) -> TrainedScene | None:
    """The scene of the newest checkpoint, if it is newer than the artefacts."""
    shown = -1
    if (run.path / SURFELS).is_file():
        with contextlib.suppress(ValueError, KeyError, TypeError, OverflowError):
            shown = int(read_json(run.path / MODEL)["iteration"])
    if not any(int(path.stem) > shown for path in run.checkpoints()):
        return None
    if (state := run.load_checkpoint()) is None or int(state["iteration"]) <= shown:
        return None
    return TrainedScene.from_state(method, state)


def newest(run: Run, method: Method) -> TrainedScene:
    """The scene of the newest checkpoint or of newer artefacts; writes nothing.

    It has the mesh even if shading does not use it. Raises InputError as `TrainedScene.read` does.
    """
    if (fresh := load_if_newer(run, method)) is not None:
        return fresh
    if not (run.path / MODEL).is_file():
        raise _no_artefacts(run)
    scene, mesh = TrainedScene.read(run.path), run.path / MESH
    return replace(scene, mesh=read_mesh(mesh)) if scene.mesh is None and mesh.is_file() else scene


def _no_artefacts(run: Run) -> InputError:
    return InputError(
        "none yet", run.path, "checkpoints", f"train it with `refgs train DATA -o {run.path} --resume`"
    )


def write_if_stale(run: Run, method: Method, camera: Callable[[TrainedScene], Camera]) -> TrainedScene:
    """Write the artefacts of a run if there are none or the newest checkpoint is newer, and read them.

    If another process trains the run, writes nothing and returns the newest checkpoint. `camera` chooses that
    of scene.xml. Raises InputError if there is neither artefact nor checkpoint.
    """
    if (fresh := load_if_newer(run, method)) is not None:
        try:
            export(fresh, run.path, camera(fresh))
        except BusyError:
            return fresh
    elif not (run.path / MODEL).is_file():
        raise _no_artefacts(run)
    return TrainedScene.read(run.path)


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
    """Write a scene that was not fitted here (edited, imported, relit, copied) as a run folder.

    It has no checkpoints, logs and previews. Returns its artefacts. `camera` and `more` become the sensors of
    scene.xml; `data` is the data set of its test views, `region` the region of interest; `records` are JSON
    files by name. config.toml is written last: if it is there, the folder is complete. Raises InputError for
    a folder that contains a run or other files or cannot be written, and for a value that is not finite.
    """
    run = Run(folder)
    run.require_none()
    own_folder(folder, RUN)
    with run.alone():
        written = export(trained, folder, camera, more)
        if data is not None:
            run.write_dataset(str(data.resolve()), region)
        for name, content in (records or {}).items():
            run.write_json(name, content)
        run.write_method(method)
    return written
