"""An edit of a scene: changes of selected surfels and of their triangles, and the notes for the user."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Unpack

import numpy as np
from scipy.spatial import cKDTree

from mi_refgs.editing.options import Assignments, EditOptions, Selection
from mi_refgs.editing.selection import COLOUR, SurfelValues, activated, select
from mi_refgs.errors import InputError, abbreviated
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.runs.relightable import lacking, relightable
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.surfels.attributes import SH_DC, logit, sigmoid
from mi_refgs.surfels.table import Surfels

ASSIGNMENT = re.compile(r"\s*([A-Za-z_][\w.]*)\s*(\*?=)(.*)", re.ASCII)
NEIGHBOURS, MAJORITY = 8, 0.5  # surfels that decide about a triangle, by a share of their opacity


@dataclass(frozen=True)
class Assignment:
    """New values of an attribute, of one of its columns, or of `colour`."""

    name: str
    values: tuple[float, ...]  # one per column, or one for all
    multiplies: bool  # the values multiply the old ones
    text: str  # as it was written

    @staticmethod
    def parse(text: str) -> "Assignment":
        """Parse `name=value` or `name*=value` with numbers between commas; raises InputError."""
        try:
            name, sign, values = ASSIGNMENT.fullmatch(text).groups()  # type: ignore[union-attr]
            numbers = tuple(map(float, values.split(",")))
        except (AttributeError, TypeError, ValueError):
            remedy = "write it like roughness=0.3 or albedo*=1,0.5,0.5"
            raise InputError("no assignment of numbers", "--set", abbreviated(text), remedy) from None
        if not np.isfinite(numbers).all():
            raise InputError("not finite", "--set", abbreviated(text), "give finite numbers")
        return Assignment(name, numbers, sign == "*=", text.strip())


def assignments(given: Assignments) -> tuple[Assignment, ...]:
    """Parse texts as on the command line, or numbers by name; raises InputError for anything else."""
    if isinstance(given, Mapping):
        lists = {name: ",".join(map(str, np.atleast_1d(value).tolist())) for name, value in given.items()}
        given = [f"{name}={values}" for name, values in lists.items()]
    texts = given if isinstance(given, Iterable) and not isinstance(given, str) else [given]
    return tuple(map(Assignment.parse, texts))


def edit(scene: TrainedScene, **options: Unpack[EditOptions]) -> tuple[TrainedScene, dict[str, Any]]:
    """Change surfels of a scene; with `materials`, the light stays that of the photographs. The record, for
    JSON, has the options given, `selected` surfels `of` so many, `surfels` now, and `notes` for the user.
    Raises InputError for bad values, an unknown option, an empty selection, and if there is nothing to do."""
    known = EditOptions.__annotations__
    for name in options.keys() - known:
        raise InputError("unknown option", "edit", name, f"use some of {', '.join(known)}")
    given: dict[str, Any] = {name: value for name, value in options.items() if value is not None}
    made = assignments(given.get("set", ()))
    given["set"] = [assignment.text for assignment in made]
    materials, cut = (given.get(name, False) for name in ("materials", "cut"))
    if not (materials or made or cut):
        raise InputError("nothing to do", "edit", remedy="give --set, --cut or another change")
    if materials:
        light = {name: getattr(scene, name) for name in ("surroundings", "near", "turntable")}
        scene = replace(relightable(scene), **light)
    chosen = select(scene, Selection(**{f.name: given[f.name] for f in fields(Selection) if f.name in given}))
    changed = apply(scene, chosen, made, cut)
    counts = {"selected": int(chosen.sum()), "of": len(chosen), "surfels": changed.surfels.count}
    record = json.loads(json.dumps(given, default=lambda x: x.tolist()))  # arrays and tuples as lists
    record = {name: value for name, value in record.items() if value}
    return changed, {**record, **counts, "notes": notes_of(scene, made, cut)}


def notes_of(scene: TrainedScene, made: Sequence[Assignment], cut: bool) -> list[str]:
    """Return what of a fit does not follow a change: values that depend on its light."""
    shading, surfels = scene.shading, scene.surfels
    names = [assignment.name.partition(".")[0] for assignment in made]
    harmonics = "residual_sh" if shading.traced_bounces else "indirect_sh"
    indirect = shading.occlusion and surfels.has(harmonics)
    read = {*shading.required_attributes, *surfels.primitive.widths}
    read |= {harmonics} if indirect else set()
    why = f"no image of this run depends on it (its shading is {shading.reflectance}, {shading.diffuse})"
    notes = [f"{n}: {why}" for n in names if ("radiance_sh" if n == COLOUR else n) not in read]
    lit = shading.model.light != "none" and "radiance_sh" in read
    has_materials = not lacking(scene)
    convert = "; --materials computes an albedo instead" if has_materials and lit else ""
    if lit and {*names} & {"albedo", "metallic"}:
        notes.append(
            "the diffuse colour was fitted to the light as radiance_sh and stays so: albedo and metallic "
            f"change what is reflected, colour= changes it{convert}"
        )
    if indirect and (cut or {*names} - {"roughness"}):
        trace = "; --materials traces rays instead" if has_materials else ""
        notes.append(f"interreflection ({harmonics}) stays as it was fitted{trace}")
    return notes


def apply(
    scene: TrainedScene, chosen: np.ndarray, made: Sequence[Assignment] = (), cut: bool = False
) -> TrainedScene:
    """Return the scene with surfels (N,) bool changed, or `cut`, and their triangles; others stay exactly.
    Raises InputError for values that cannot be set, a cut of what is set, and if no surfel would be left."""
    if cut and made:
        raise InputError("what is removed cannot be changed, too", "--cut", remedy="leave the rest out")
    if cut and chosen.all():
        raise InputError("no surfel would be left", "--cut", remedy="choose fewer")
    values = SurfelValues(scene)
    raw = values.raw
    own = {name: table[chosen] for name, table in raw.items()}
    for assignment in made:
        _assign(values, own, assignment)
    for name, table in raw.items():
        if cut:
            raw[name] = table[~chosen]
        else:
            table[chosen] = own[name]
    return replace(scene, surfels=Surfels.from_numpy(raw), mesh=_mesh(scene, chosen, own["opacity"], cut))


def _mesh(scene: TrainedScene, chosen: np.ndarray, opacity: np.ndarray, cut: bool) -> Mesh | None:
    """Return the mesh without the triangles of surfels (N,) bool that are cut, or of such raw opacity now:
    those whose opacity around them is mostly of these surfels, and of which no majority is left."""
    mesh, tables = scene.mesh, [scene.surfels.to_numpy()]
    stays = np.array_equal(tables[0]["opacity"][chosen], opacity) and not cut
    if mesh is None or not len(mesh.faces) or stays:
        return mesh
    # The surfels around the middle of each triangle: the object's, then those of the background.
    if scene.surroundings is not None:
        tables.append(scene.surroundings.surfels.to_numpy())
    position, raw = (np.concatenate([table[name] for table in tables]) for name in ("position", "opacity"))
    near = np.arange(1, min(NEIGHBOURS, len(position)) + 1)
    around = cKDTree(position).query(mesh.vertices[mesh.faces].mean(axis=1), k=near)[1]
    before, changed = sigmoid(raw[:, 0]), np.flatnonzero(chosen)
    theirs, after = np.zeros_like(before), before.copy()
    theirs[changed], after[changed] = before[changed], 0 if cut else sigmoid(opacity[:, 0])
    total, part, left = (values[around].sum(axis=1) for values in (before, theirs, after))
    return mesh.part((part <= MAJORITY * total) | (left >= MAJORITY * total))


def _assign(values: SurfelValues, own: dict[str, np.ndarray], assignment: Assignment) -> None:
    """Set raw attributes (chosen, D) of the chosen surfels; raises InputError for what cannot be set."""
    name, given = assignment.name, np.array(assignment.values)
    if name not in values.settable:
        what = f"{abbreviated(name)} cannot be set of these surfels"
        raise InputError(what, "--set", remedy=f"use one of {', '.join(values.settable)}")
    attribute, columns = values.columns[name]
    is_colour = attribute == COLOUR
    if len(given) not in (1, len(columns)):
        raise InputError(f"{len(given)} values", "--set", name, f"give 1 or {len(columns)}")
    if given.min() < 0 or (given.max() > 1 and not (is_colour or assignment.multiplies)):
        remedy = "give 0 or more" if is_colour or assignment.multiplies else "give 0 to 1"
        raise InputError("out of range", "--set", assignment.text, remedy)

    # The raw values (chosen, columns). A new colour scales the SH of all degrees, those of a surfel that is
    # darker than they are in the mean so that they are at most as bright as it.
    old = activated(attribute, own)[:, columns]
    new = given * old if assignment.multiplies else np.broadcast_to(given, old.shape)
    if not is_colour:
        own[attribute][:, columns] = logit(np.clip(new, 0, 1))
        return
    raw = own["radiance_sh"]
    for i, column in enumerate(columns):
        harmonics = raw[:, 3 + column :: 3]
        spread = SH_DC * np.linalg.norm(harmonics, axis=1)  # root mean square over all directions
        factor = new[:, i] / np.maximum(np.maximum(old[:, i], spread), 1e-12)
        factor = np.broadcast_to(given, len(columns))[i] if assignment.multiplies else factor[:, None]
        harmonics *= np.float32(factor)
        raw[:, column] = (new[:, i] - 0.5) / SH_DC
