"""What a checkpoint holds of a fit, as named arrays; `runs.checkpoint` reads and checks the files."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.methods.method import GAIN, LIGHT, Method
from mi_refgs.methods.surroundings import AROUND, BACKGROUND
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.surface_materials import VertexSurfels
from mi_refgs.occlusion.vertex_colours import VertexColours
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.runs.checkpoint import MESH, OPTIMISER, PARAMS, part

if TYPE_CHECKING:
    from mi_refgs.fitting.train import Trainer


def shapes(method: Method, open_scene: bool) -> dict[str, tuple[int, ...]]:
    """The shape of every parameter of a method, without the first axis; of surroundings if `open_scene`."""
    surfels, around = method.surfels, method.surroundings
    found: dict[str, tuple[int, ...]] = {name: (surfels.columns(name),) for name in surfels.names}
    if open_scene and around is not None:
        harmonics = replace(surfels, degree={"radiance_sh": around.degree})
        found |= {AROUND + name: (harmonics.columns(name),) for name in around.names(surfels.primitive)}
        found[BACKGROUND] = (2 * around.height, 3)
    return found if method.light is None else found | {LIGHT: (2 * method.light.height, 3)}


def packed(trainer: Trainer) -> dict[str, np.ndarray]:
    """Everything that a checkpoint holds."""
    mesh = trainer.occluder.mesh()
    state = {f"{PARAMS}{name}": tensor.numpy() for name, tensor in trainer.params.items()}
    state |= {f"{OPTIMISER}{name}": value for name, value in trainer.optimiser.state_dict().items()}
    for table in trainer.control.tables:
        state |= table.state()
    state |= {"iteration": np.array(trainer.iteration), "seconds": np.array(trainer.seconds)}
    state["held_until"] = np.array(trainer.control.held_until)
    state |= trainer.window.state() | trainer.exposure.state()
    if trainer.decisions:
        state["decisions"] = np.frombuffer(json.dumps(trainer.decisions).encode(), np.uint8)
    if mesh is not None:
        state |= {
            "mesh/vertices": mesh.vertices,
            "mesh/faces": mesh.faces,
            "mesh/voxel": np.array(mesh.voxel),
        }
    if trainer.occluder.vertex_surfels is not None:
        state |= {
            f"{MESH}{name}": values for name, values in trainer.occluder.vertex_surfels.arrays().items()
        }
    if trainer.occluder.ambient is not None:
        state["mesh/ambient"] = trainer.occluder.ambient.numpy()
    return state


def decisions_of(state: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """What was decided about the terms of the method so far."""
    if "decisions" not in state:
        return []
    found: list[dict[str, Any]] = json.loads(state["decisions"].tobytes().decode())
    return found


def occluder_of(state: dict[str, np.ndarray]) -> Occluder:
    """The occluder, with its materials' surfels and its ambient ratios if it has any."""
    occluder = Occluder()
    if "mesh/faces" in state:
        mesh = Mesh(state["mesh/vertices"], state["mesh/faces"], float(state["mesh/voxel"]))
        occluder.update(mesh)
        if "mesh/surfels" in state:
            count = len(state[f"{PARAMS}position"])
            occluder.vertex_surfels = VertexSurfels.restored(mesh, count, part(state, MESH))
        if "mesh/ambient" in state:
            occluder.ambient = VertexColours.of(mesh, state["mesh/ambient"])
    return occluder


def require_fit(method: Method, state: dict[str, np.ndarray], open_scene: bool = False) -> None:
    """Raise InputError if the method, or what its pictures show, has changed since the state was written."""
    expected = shapes(method, open_scene)
    found = {name: value.shape[1:] for name, value in part(state, PARAMS).items() if name != GAIN}
    for name in expected.keys() | found.keys():
        if found.get(name) != expected.get(name):
            raise InputError(
                f"config.toml: {name}: the checkpoint has {found.get(name, 'none')}, the method "
                f"{expected.get(name, 'none')}; undo the change, or start another run"
            )
