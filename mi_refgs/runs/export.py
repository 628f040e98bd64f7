"""The artefacts of a run, which need nothing of ours to be read.

    surfels.ply   raw channels, with 2DGS's property names: the object
    envmap.exr    lat-long radiance, Mitsuba's orientation
    mesh.ply      the occluder
    surroundings.ply  what is around the object, likewise, with radiance_sh alone
    background.exr    what is behind everything, lat-long radiance
    scene.xml     what `mi.load_file` renders
    model.json    the iteration and the seconds that they stand for, and how they are shaded

What a method does not have (a light, a mesh), and surroundings of pictures with alpha, have no file.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mi_refgs.data.region import Region
from mi_refgs.errors import InputError
from mi_refgs.io.files import BusyError, make_folder, read_json, write_json
from mi_refgs.io.ownership import OutputFolder
from mi_refgs.methods.method import Method
from mi_refgs.occlusion.mesh import read_mesh, write_mesh
from mi_refgs.render.scene_xml import write_scene_xml
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import (
    AROUND_FILE,
    ARTEFACTS,
    BACKGROUND_MAP,
    LIGHT_MAP,
    MESH,
    MODEL,
    SCENE,
    SURFELS,
    TrainedScene,
)
from mi_refgs.splat import Camera
from mi_refgs.surfels.ply import write_ply


def export(
    fitted: TrainedScene,
    folder: Path,
    camera: Camera,
    more: Sequence[Camera] = (),
    output: OutputFolder | None = None,
) -> list[Path]:
    """Write the artefacts into `folder`, each whole or not at all; returns their paths.

    `camera` becomes the sensor of scene.xml, and `more` the next ones. `output` says whose artefacts they
    are, by default those of a run in `folder`. Raises BusyError for a run that another process trains;
    InputError, with nothing changed, where a file of another owner has the name of an artefact; and if a
    file cannot be written or a value is not finite.
    """
    with Run(folder).alone():
        return _export(fitted, folder, camera, more, output or Run(folder).output)


def _export(
    fitted: TrainedScene, folder: Path, camera: Camera, more: Sequence[Camera], output: OutputFolder
) -> list[Path]:
    light = LIGHT_MAP if fitted.light is not None else None
    mesh = MESH if fitted.mesh is not None else None
    around = AROUND_FILE if fitted.surroundings is not None else None
    behind = BACKGROUND_MAP if fitted.surroundings and fitted.surroundings.background else None
    written = [name for name in (SURFELS, light, mesh, around, behind, SCENE, MODEL) if name is not None]
    output.require_free(ARTEFACTS)
    output.remove({*ARTEFACTS} - {*written})
    output.claim(*written)
    write_ply(folder / SURFELS, fitted.surfels)
    if fitted.light is not None:
        fitted.light.write(folder / LIGHT_MAP)
    if fitted.mesh is not None:
        write_mesh(folder / MESH, fitted.mesh)
    if fitted.surroundings is not None:
        write_ply(folder / AROUND_FILE, fitted.surroundings.surfels)
        if fitted.surroundings.background is not None:
            fitted.surroundings.background.write(folder / BACKGROUND_MAP)
    # Transparent without surroundings: pictures with alpha are composited after the sRGB encoding, which no
    # scene can say. Behind surroundings without a map it is black, as `render` has it.
    black = (0.0, 0.0, 0.0) if around is not None and behind is None else None
    write_scene_xml(
        folder / SCENE,
        ply=SURFELS,
        envmap=light,
        mesh=mesh,
        shading=fitted.shading,
        camera=camera,
        more=more,
        surroundings=around,
        background=behind or black,
        remark="" if fitted.pruned is None else f"pruned: had {fitted.pruned.surfels} surfels",
    )
    # Written last: where it is, the other files are complete.
    note: dict[str, Any] = {
        "iteration": fitted.iteration,
        "seconds": fitted.seconds,
        "surfels": fitted.surfels.count,
    }
    if fitted.pruned is not None:
        note["pruned"] = dataclasses.asdict(fitted.pruned)
    write_json(folder / MODEL, note | {"shading": dataclasses.asdict(fitted.shading)}, indent=2)
    return [folder / name for name in written]


def load_if_newer(run: Run, method: Method) -> TrainedScene | None:
    """What the newest checkpoint holds, if there is one that the artefacts do not already show."""
    shown = -1
    if (run.path / SURFELS).is_file():
        with contextlib.suppress(ValueError, KeyError, TypeError, OverflowError):
            shown = int(read_json(run.path / MODEL)["iteration"])
    if not any(int(path.stem) > shown for path in run.checkpoints()):
        return None
    state = run.load_checkpoint()
    if state is None or int(state["iteration"]) <= shown:
        return None
    return TrainedScene.from_state(method, state)


def newest(run: Run, method: Method) -> TrainedScene:
    """What a run holds, of its newest checkpoint where the artefacts are older; writes nothing.

    A mesh that only other programs use is there, too. Raises InputError as `TrainedScene.read` does.
    """
    fresh = load_if_newer(run, method)
    if fresh is not None:
        return fresh
    if not (run.path / MODEL).is_file():
        raise _no_artefacts(run)
    scene, mesh = TrainedScene.read(run.path), run.path / MESH
    return replace(scene, mesh=read_mesh(mesh)) if scene.mesh is None and mesh.is_file() else scene


def _no_artefacts(run: Run) -> InputError:
    return InputError(
        f"{run.path}: checkpoints: none yet; train it with `refgs train DATA -o {run.path} --resume`"
    )


def up_to_date(run: Run, method: Method, camera: Camera | Callable[[TrainedScene], Camera]) -> TrainedScene:
    """The artefacts of a run, written first if there are none or the newest checkpoint is newer.

    Of a run that another process trains, the newest checkpoint, and nothing is written. `camera` is that of
    scene.xml, or chooses one for what is written. Raises InputError if there is nothing to write them from.
    """
    fresh = load_if_newer(run, method)
    if fresh is not None:
        try:
            export(fresh, run.path, camera(fresh) if callable(camera) else camera)
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
