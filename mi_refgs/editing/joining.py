"""Union of two scenes: one surfel model, one mesh, the light of the first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mi_refgs.editing.placement import joined_mesh, object_mesh
from mi_refgs.errors import InputError
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.options import TRACED
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.surfels.table import Surfels


def join(first: TrainedScene, second: TrainedScene) -> tuple[TrainedScene, list[str]]:
    """Return both scenes as one, the surfels of `first` before those of `second`, and notes for the user.

    Light, background and shading options are those of the first; it takes the light of the second if it has
    none, and the options for rays if it traces none. SH that one of them lacks, such as indirect_sh,
    are zero there, which changes none of its images. The meshes of both occlude and reflect each other.

    Raises InputError for scenes of different primitives, reflectance or diffuse terms: one would look wrong.
    """
    primitives = first.surfels.primitive, second.surfels.primitive
    if primitives[0] is not primitives[1]:
        one, other = (primitive.name for primitive in primitives)
        raise InputError(f"--join: one has {one}s, the other {other}s; join runs of one primitive")
    for what in ("reflectance", "diffuse", "shaded_at"):
        pair = getattr(first.shading, what), getattr(second.shading, what)
        if pair[0] != pair[1]:
            raise InputError(
                f"--join: {what}: '{pair[0]}' and '{pair[1]}' are not shaded alike; make both materials with "
                "`refgs edit RUN --materials -o NEW`, or fit both by one method"
            )
    tables = [scene.surfels.to_numpy() for scene in (first, second)]
    raw = {
        name: np.concatenate(_columns(name, tables)) for name in ATTRIBUTES if any(name in t for t in tables)
    }
    joined = replace(
        first,
        surfels=Surfels.from_numpy(raw),
        light=first.light or second.light,
        near=first.near if first.light is not None else second.near,
        mesh=joined_mesh(first.mesh, object_mesh(second)),
        shading=joined_shading(first.shading, second.shading),
    )
    notes = []
    if joined.light is not None:
        whose = "RUN" if first.light is not None else "the joined run, RUN has none"
        notes.append(f"the light is that of {whose}")
    if second.surroundings is not None:
        notes.append("the background of the joined run is left out")
    for whose, scene in (("RUN", first), ("the joined run", second)):
        if joined.shading.occlusion and scene.mesh is None:
            notes.append(f"{whose} has no mesh: it casts no shadows on the other and is not reflected in it")
    return joined, notes


def joined_shading(first: Shading, second: Shading) -> Shading:
    """Return the options of the first; if only the second traces rays, with its options for rays."""
    if first.occlusion or not second.occlusion:
        return first
    rays = {name: getattr(second, name) for name in TRACED}
    return replace(first, occlusion=True, **rays)


def _columns(name: str, tables: list[dict[str, np.ndarray]]) -> list[np.ndarray]:
    """Return an attribute of both, padded to one width; raises InputError for materials that one lacks."""
    width = max(table[name].shape[1] for table in tables if name in table)
    found = []
    for table in tables:
        values = table.get(name)
        if values is None and not ATTRIBUTES[name].harmonics:
            raise InputError(f"--join: {name}: one of the runs has no such attribute; fit both by one method")
        values = np.zeros((len(table["position"]), 0), np.float32) if values is None else values
        found.append(np.pad(values, ((0, 0), (0, width - values.shape[1]))))
    return found
