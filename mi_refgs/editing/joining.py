"""Two scenes as one: surfels in one table, meshes as one occluder, under the light of the first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mi_refgs.editing import follow
from mi_refgs.errors import InputError
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.accuracy import NEED_OCCLUSION
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import CHANNELS
from mi_refgs.surfels.table import Surfels


def join(first: TrainedScene, second: TrainedScene) -> tuple[TrainedScene, list[str]]:
    """Both scenes, the surfels of `first` before those of `second`; and what a person should be told.

    Light, surroundings and shading options are those of the first; of the second are the light where the
    first has none, and the options that only rays of a mesh need where the first traces none. Harmonics that
    one of them lacks, such as what it reflects of itself, are zero there, which changes none of its pictures.
    The meshes of both are traced: each shades and mirrors the other.

    Raises InputError for scenes of different primitives, reflectance or diffuse terms: one would look wrong.
    """
    if first.surfels.primitive is not second.surfels.primitive:
        names = first.surfels.primitive.name, second.surfels.primitive.name
        raise InputError(f"--join: one has {names[0]}s, the other {names[1]}s; join runs of one primitive")
    for what in ("reflectance", "diffuse", "at"):
        pair = getattr(first.shading, what), getattr(second.shading, what)
        if pair[0] != pair[1]:
            raise InputError(
                f"--join: {what}: '{pair[0]}' and '{pair[1]}' are not shaded alike; make both materials with "
                "`refgs edit RUN --materials -o NEW`, or fit both by one method"
            )
    tables = [scene.surfels.to_numpy() for scene in (first, second)]
    raw = {
        name: np.concatenate(_columns(name, tables)) for name in CHANNELS if any(name in t for t in tables)
    }
    joined = replace(
        first,
        surfels=Surfels.from_numpy(raw),
        light=first.light or second.light,
        mesh=follow.together(first.mesh, follow.without_surroundings(second)),
        shading=joined_shading(first.shading, second.shading),
    )
    return joined, _notes(first, second, joined)


def joined_shading(first: Shading, second: Shading) -> Shading:
    """The options of the first; rays are traced if one of the two traces them, as that one does."""
    if first.occlusion or not second.occlusion:
        return first
    rays = {name: getattr(second.accuracy, name) for name in NEED_OCCLUSION}
    return replace(first, occlusion=True, accuracy=replace(first.accuracy, **rays))


def _columns(name: str, tables: list[dict[str, np.ndarray]]) -> list[np.ndarray]:
    """A channel of both tables, as wide as the wider one; raises InputError for materials that one lacks."""
    width = max(table[name].shape[1] for table in tables if name in table)
    found = []
    for table in tables:
        values = table.get(name)
        if values is None and not CHANNELS[name].harmonics:
            raise InputError(f"--join: {name}: one of the runs has no such channel; fit both by one method")
        values = np.zeros((len(table["position"]), 0), np.float32) if values is None else values
        found.append(np.pad(values, ((0, 0), (0, width - values.shape[1]))))
    return found


def _notes(first: TrainedScene, second: TrainedScene, joined: TrainedScene) -> list[str]:
    notes = []
    if joined.light is not None:
        whose = "RUN" if first.light is not None else "the joined run, RUN has none"
        notes.append(f"the light is that of {whose}")
    if second.surroundings is not None:
        notes.append("the surroundings of the joined run are left out")
    for whose, scene in (("RUN", first), ("the joined run", second)):
        if joined.shading.occlusion and scene.mesh is None:
            notes.append(
                f"{whose} has no mesh: it casts no shadows on the other and is in none of its mirrors"
            )
    return notes
