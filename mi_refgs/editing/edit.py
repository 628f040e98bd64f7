"""An edit of a scene, from the selection to the notes for the user."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, Unpack

from mi_refgs.editing.change import Assignment, apply, assignments
from mi_refgs.editing.options import Change, EditOptions, Selection
from mi_refgs.editing.selection import COLOUR, select
from mi_refgs.errors import InputError
from mi_refgs.runs.relightable import lacking, relightable
from mi_refgs.runs.trained_scene import TrainedScene


def edit(scene: TrainedScene, **options: Unpack[EditOptions]) -> tuple[TrainedScene, dict[str, Any]]:
    """Change surfels of a scene; with `materials`, the light stays that of the photographs. The record, for
    JSON, has the options given, `selected` surfels `of` so many, `surfels` now, and `notes` for the user.
    Raises InputError for bad values, an unknown option, an empty selection, and if there is nothing to do."""
    known = EditOptions.__annotations__
    for name in options.keys() - known:
        raise InputError("unknown option", "edit", name, f"use some of {', '.join(known)}")
    given: dict[str, Any] = {name: value for name, value in options.items() if value is not None}
    selection = Selection(**{f.name: given.pop(f.name) for f in fields(Selection) if f.name in given})
    made = assignments(given.get("set", ()))
    change = Change(**given | {"set": tuple(assignment.text for assignment in made)})
    if not (change.materials or change.set or change.cut):
        raise InputError("nothing to do", "edit", remedy="give --set, --cut or another change")
    if change.materials:
        scene = replace(relightable(scene), surroundings=scene.surroundings, near=scene.near)
    chosen = select(scene, selection)
    notes = notes_of(scene, made, change.cut)
    changed = apply(scene, chosen, made, change.cut)
    counts = {"selected": int(chosen.sum()), "of": len(chosen), "surfels": changed.surfels.count}
    used = {name: value for name, value in (vars(selection) | vars(change)).items() if value is not None}
    record = json.loads(json.dumps(used, default=lambda x: x.tolist()))  # arrays and tuples as lists
    record = {name: value for name, value in record.items() if value}
    return changed, {**record, **counts, "notes": notes}


def notes_of(scene: TrainedScene, made: Sequence[Assignment], cut: bool) -> list[str]:
    """Return what of a fit does not follow a change: values that depend on its light."""
    shading, surfels = scene.shading, scene.surfels
    names = [assignment.name.partition(".")[0] for assignment in made]
    indirect = shading.occlusion and surfels.has("indirect_sh") and not shading.traced_bounces
    read = {*shading.required_attributes, *surfels.primitive.widths}
    read |= {"indirect_sh"} if indirect else set()
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
        notes.append(f"interreflection (indirect_sh) stays as it was fitted{trace}")
    return notes
