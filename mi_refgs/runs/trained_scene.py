"""A fitted scene, and the names of its files."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import drjit as dr
import numpy as np

from mi_refgs.errors import InputError, UnknownNameError
from mi_refgs.io.files import read_json
from mi_refgs.kernels.device import require_supported_variant, upload_tensor
from mi_refgs.methods.method import TURNTABLE, Method
from mi_refgs.occlusion.mesh import Mesh, read_mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.registry import load_again
from mi_refgs.render.passes import in_passes
from mi_refgs.render.pipeline import Frame, Request, SurfelScene, render
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs import checkpoint
from mi_refgs.shade.ambient import update_occluder_caches
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.near_field import NearField
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.attributes import attribute
from mi_refgs.surfels.ply import read_ply
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import TensorXf

SURFELS, LIGHT_MAP, MESH, SCENE, MODEL = "surfels.ply", "envmap.exr", "mesh.ply", "scene.xml", "model.json"
AROUND_FILE, BACKGROUND_MAP, NEAR_FIELD = "surroundings.ply", "background.exr", "near_field.npz"
OPTIONAL = (LIGHT_MAP, NEAR_FIELD, AROUND_FILE, BACKGROUND_MAP)
ARTEFACTS = (SURFELS, *OPTIONAL, MESH, SCENE, MODEL)


@dataclass(frozen=True, eq=False)
class TrainedScene:
    """A fitted scene: all that rendering requires, and nothing that only training requires."""

    surfels: Surfels
    light: EnvironmentLight | None
    mesh: Mesh | None
    shading: Shading
    iteration: int
    seconds: float  # spent training
    surroundings: Surroundings | None = None  # background Gaussians and map, of images without alpha
    near: NearField | None = None  # distances of what the light shows; None: infinitely far
    turntable: TensorXf | None = None  # as in `SurfelScene`; the first training camera's

    @staticmethod
    def from_state(method: Method, state: Mapping[str, np.ndarray]) -> "TrainedScene":
        """The scene of a checkpoint."""
        params, iteration, mesh = checkpoint.tensors(state, checkpoint.PARAMS), int(state["iteration"]), None
        if len(state.get("mesh/faces", ())):
            mesh = Mesh(state["mesh/vertices"], state["mesh/faces"], float(state["mesh/voxel"]))
        _, stage = method.stage_at(max(iteration, 1))
        light = checkpoint.light_of(method.light, params)
        near = checkpoint.part(state, checkpoint.PHOTOGRAPHED)
        return TrainedScene(
            Surfels(checkpoint.channels_of(params)),
            None if light is None else light.environment(),
            mesh,
            Shading.resolve(stage.shading, mesh is not None).antialiased(),
            iteration,
            float(state["seconds"]),
            surroundings=checkpoint.surroundings_of(params),
            near=NearField(near["centre"], near["nearness"]) if near else None,
            turntable=params.get(TURNTABLE),
        )

    @property
    def count(self) -> int:
        """Number of surfels of the object and the background."""
        return self.surfels.count + (0 if self.surroundings is None else self.surroundings.surfels.count)

    @staticmethod
    def read(folder: Path, plugins: Sequence[str] = ()) -> "TrainedScene":
        """Read the artefacts of a run folder, fitted with these plugins; raises InputError for bad files."""
        note = folder / MODEL
        remedy = f"restore it, or write it again with `refgs export {folder}` if the run has checkpoints"
        try:
            content = read_json(note)
            shading = Shading(**content["shading"])
            for name in shading.required_attributes:
                attribute(name)  # is registered
            iteration, seconds = int(content["iteration"]), float(content["seconds"])
            files = {*content.get("files", ())}  # earlier versions did not write it
            axes = np.array(content.get("turntable", []), np.float32).reshape(-1, 3, 3)
            if iteration < 0 or not 0 <= seconds < math.inf:
                raise ValueError("iteration or seconds out of range")
        except UnknownNameError as error:
            raise load_again(error, plugins).at(note) from error
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            reason = f"no {error}" if isinstance(error, KeyError) else error
            raise InputError(f"cannot be read ({reason})", note, remedy=remedy) from error
        needed = {LIGHT_MAP} if shading.model.light != "none" else set()
        optional = [folder / name for name in OPTIONAL]
        for path in optional:
            if path.name in needed | files and not path.is_file():
                raise InputError("missing", path, "file", remedy)
        light, near, around, behind = (path if path.is_file() else None for path in optional)
        fitted = TrainedScene(
            read_ply(folder / SURFELS),
            None if light is None else EnvironmentLight.from_file(light),
            read_mesh(folder / MESH) if shading.occlusion or (folder / MESH).is_file() else None,
            shading,
            iteration,
            seconds,
            None if around is None else Surroundings.read(around, behind),
            None if near is None else NearField.read(near),
            upload_tensor(axes[0]) if len(axes) else None,
        )
        try:
            shading.require_inputs(fitted.surfels.raw, fitted.light is not None)
            if fitted.surroundings is not None:
                fitted.surroundings.check(fitted.surfels)
        except InputError as error:
            raise InputError(f"{error}", folder, remedy=f"or {remedy}") from error
        return fitted

    def renderer(
        self, aovs: bool | Collection[str] = True, samples: int = 1, turning: bool = False
    ) -> Callable[[Camera], Frame]:
        """A function that renders views, detached, with these AOVs (all, or by name), `samples` per pixel;
        `turning`: a turntable's as they were photographed, others under the light of the first."""
        require_supported_variant("TrainedScene.renderer")
        with dr.suspend_grad():
            light = self.shading.light_of(self.light)
        occluder = Occluder(self.mesh)
        turntable = self.turntable if turning else None
        around = light if turntable is None else self.shading.light_of(EnvironmentLight.constant())
        update_occluder_caches(occluder, self.surfels, around, self.shading)
        given = (light, occluder, self.surroundings, self.near, turntable)
        scene = SurfelScene(self.surfels, self.shading, *given)
        asked = aovs if not isinstance(aovs, bool) else scene.all_aovs if aovs else ()
        once = partial(render, scene, request=Request(asked, forward_only=True))

        def draw(camera: Camera) -> Frame:
            with dr.suspend_grad():
                return in_passes(once, camera, samples, self.shading.neighbours, self.count, bool(aovs))

        return draw
