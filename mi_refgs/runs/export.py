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
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.io.files import BusyError, read_json, write_json
from mi_refgs.io.ownership import OutputFolder
from mi_refgs.kernels.device import require_supported_variant
from mi_refgs.methods.method import Method
from mi_refgs.occlusion.mesh import Mesh, read_mesh, write_mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.render.passes import in_passes
from mi_refgs.render.pipeline import Frame, render
from mi_refgs.render.samples import samples_per_axis, supersampled
from mi_refgs.render.scene_xml import write_scene_xml
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs.checkpoint import PARAMS, tensors
from mi_refgs.runs.parameters import channels_of, light_of, surroundings_of
from mi_refgs.runs.run import Run
from mi_refgs.shade.ambient import prepare
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.ply import read_ply, write_ply
from mi_refgs.surfels.table import Surfels

SURFELS, LIGHT_MAP, MESH, SCENE, MODEL = "surfels.ply", "envmap.exr", "mesh.ply", "scene.xml", "model.json"
AROUND_FILE, BACKGROUND_MAP = "surroundings.ply", "background.exr"
ARTEFACTS = (SURFELS, LIGHT_MAP, MESH, AROUND_FILE, BACKGROUND_MAP, SCENE, MODEL)


@dataclass(frozen=True)
class Pruned:
    """That a scene is not the whole fit, and how near its pictures are to the whole one's."""

    surfels: int  # of the whole
    limit: float  # dB that the pictures of all training views had to keep
    psnr: float  # dB, of the worst of them

    def __post_init__(self) -> None:
        if not (math.isfinite(self.limit) and math.isfinite(self.psnr)):
            raise ValueError("pruned: a number is not finite")


@dataclass(frozen=True, eq=False)
class TrainedScene:
    """What a fit has found: enough to render, and nothing that only training needs."""

    surfels: Surfels
    light: EnvironmentLight | None
    mesh: Mesh | None
    shading: Shading
    iteration: int
    seconds: float  # spent training
    pruned: Pruned | None = None  # absent: all that the fit has found
    surroundings: Surroundings | None = None  # of pictures without alpha

    @staticmethod
    def from_state(method: Method, state: Mapping[str, np.ndarray]) -> TrainedScene:
        """Take the state of a `Trainer`, as a checkpoint holds it."""
        params = tensors(state, PARAMS)
        mesh = None
        if len(state.get("mesh/faces", ())):
            mesh = Mesh(state["mesh/vertices"], state["mesh/faces"], float(state["mesh/voxel"]))
        iteration = int(state["iteration"])
        _, stage = method.stage_at(max(iteration, 1))
        return TrainedScene(
            Surfels(channels_of(params)),
            light_of(params),
            mesh,
            Shading.of(stage, mesh is not None),
            iteration,
            float(state["seconds"]),
            surroundings=surroundings_of(params),
        )

    @property
    def count(self) -> int:
        """Surfels of the object and of what is around it."""
        return self.surfels.count + (0 if self.surroundings is None else self.surroundings.surfels.count)

    @staticmethod
    def read(folder: Path) -> TrainedScene:
        """Read the artefacts in a run folder; raises InputError for a file that cannot be used."""
        note = folder / MODEL
        try:
            content = read_json(note)
            shading = Shading(**content["shading"])
            iteration, seconds = int(content["iteration"]), float(content["seconds"])
            pruned = content.get("pruned")
            if pruned is not None:
                pruned = Pruned(int(pruned["surfels"]), float(pruned["limit"]), float(pruned["psnr"]))
            if iteration < 0 or not 0 <= seconds < math.inf:
                raise ValueError("iteration or seconds out of range")
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            raise InputError(
                f"{note}: cannot be read ({error}); write it again with `refgs export {folder}`"
            ) from error
        light, mesh = folder / LIGHT_MAP, folder / MESH
        around, behind = folder / AROUND_FILE, folder / BACKGROUND_MAP
        if shading.model.light != "none" and not light.is_file():
            raise InputError(
                f"{light}: light: missing; restore the file, or write it again with `refgs export {folder}`"
            )
        fitted = TrainedScene(
            read_ply(folder / SURFELS),
            EnvironmentLight.from_file(light) if light.is_file() else None,
            read_mesh(mesh) if shading.occlusion else None,
            shading,
            iteration,
            seconds,
            pruned,
            Surroundings.read(around, behind if behind.is_file() else None) if around.is_file() else None,
        )
        try:
            shading.check(fitted.surfels.raw, fitted.light is not None)
            if fitted.surroundings is not None:
                fitted.surroundings.check(fitted.surfels)
        except InputError as error:
            raise InputError(f"{folder}: {error}; or write it again with `refgs export {folder}`") from error
        return fitted

    def renderer(self, aovs: bool | Collection[str] = True, samples: int = 1) -> Callable[[Camera], Frame]:
        """A function that renders views without derivatives, with the `aovs` of `render`, all or by name.

        `samples` a pixel as in `render.samples`. Light and mesh are prepared once.
        """
        draw = self.drawn()
        return lambda camera: draw(camera, aovs, samples)

    def drawn(self) -> Callable[..., Frame]:
        """`renderer`, but what it is called with is a camera, the `aovs` and, if not 1, the `samples`."""
        require_supported_variant("TrainedScene.renderer")
        with dr.suspend_grad():
            light = self.shading.light_of(self.light)
        occluder = Occluder(self.mesh)
        prepare(occluder, self.surfels, light, self.shading.accuracy)

        def draw(camera: Camera, aovs: bool | Collection[str], samples: int = 1) -> Frame:
            def once(view: Camera) -> Frame:
                return render(
                    self.surfels,
                    view,
                    self.shading,
                    light,
                    occluder,
                    aovs=aovs,
                    normals=aovs is True,
                    surroundings=self.surroundings,
                    derivatives=False,
                )

            def averaged(view: Camera) -> Frame:
                return supersampled(once, view, samples, details=bool(aovs))

            factor, count = samples_per_axis(samples), self.count
            with dr.suspend_grad():
                return in_passes(averaged, camera, factor, self.shading.neighbours, count)

        return draw


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
