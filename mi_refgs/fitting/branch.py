"""A fit that goes on with another method: what both have is kept, what is new starts as the method says."""

from __future__ import annotations

import numpy as np

from mi_refgs.fitting.initial import first_light
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.method import LIGHT, Method
from mi_refgs.methods.surroundings import AROUND, BACKGROUND
from mi_refgs.runs.checkpoint import MESH, OPTIMISER, PARAMS, part
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.lobe_matrices import resample
from mi_refgs.surfels.attributes import channel


def branched(trainer: Trainer, method: Method) -> Trainer:
    """A trainer of `method`, at the same iteration of the same data; `trainer` stays as it is.

    Harmonics of another degree are cut or filled with zeros, a light of another size is resampled, and both
    keep their history as far as they keep their entries. It has no run folder.
    """
    state = trainer.state()
    old, count = part(state, PARAMS), trainer.surfels.count
    rng = trainer.schedule.rng(trainer.iteration, "branch")
    wanted: dict[str, np.ndarray] = {}
    for name in method.surfels.names:
        width = method.surfels.columns(name)
        if name not in old:
            wanted[name] = channel(name).start(count, width, rng, method.surfels.start(name))
        else:
            wanted[name] = _columns(old[name], width)
    wanted |= {name: old[name] for name in old if name == BACKGROUND or name.startswith(AROUND)}
    if method.light is not None:
        height = method.light.height
        if LIGHT not in old:
            wanted[LIGHT] = first_light(method.light).raw.numpy()
        elif len(old[LIGHT]) == height:
            wanted[LIGHT] = old[LIGHT]
        else:
            radiance = EnvironmentLight(trainer.params[LIGHT]).radiance().numpy()
            wanted[LIGHT] = EnvironmentLight.from_radiance(resample(radiance, height)).raw.numpy()
    dropped = (PARAMS, OPTIMISER) if method.mesh is not None else (PARAMS, OPTIMISER, MESH)
    new = {name: value for name, value in state.items() if not name.startswith(dropped)}
    for name, values in wanted.items():
        new[f"{PARAMS}{name}"] = np.asarray(values, np.float32)
        new |= {f"{OPTIMISER}{key}": value for key, value in _history(state, old, name, values).items()}
    made = Trainer(method, trainer.data, state=new)
    if method.mesh is not None and made.occluder.empty and made.shading().traceable:
        made.extract_mesh()
    return made


def _columns(table: np.ndarray, width: int) -> np.ndarray:
    """The first `width` columns, zeros beyond those that are there."""
    kept = table[:, :width]
    return np.pad(kept, ((0, 0), (0, width - kept.shape[1])))


def _history(
    state: dict[str, np.ndarray], old: dict[str, np.ndarray], name: str, values: np.ndarray
) -> dict[str, np.ndarray]:
    """Adam's moments of one tensor, by the names of `Adam.state_dict`."""
    found: dict[str, np.ndarray] = {}
    for key in ("first", "second"):
        moments = state.get(f"{OPTIMISER}{name}/{key}")
        kept = np.zeros(values.shape, np.float32)
        if moments is not None and values.ndim == 2:
            kept = _columns(moments.reshape(old[name].shape), values.shape[1])
        elif moments is not None and moments.size == values.size:
            kept = moments
        found[f"{name}/{key}"] = kept.ravel()
    for key, fresh in (("steps", 0), ("factor", 1.0), ("usual", 0.0)):
        found[f"{name}/{key}"] = state.get(f"{OPTIMISER}{name}/{key}", np.array(fresh))
    return found
