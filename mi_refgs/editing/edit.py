"""One edit of a scene from selection to notes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np

from mi_refgs.editing.change import Assignments, Change, Rotate, apply, assignments
from mi_refgs.editing.joining import join
from mi_refgs.editing.notes import notes
from mi_refgs.editing.selection import Selection, select
from mi_refgs.errors import InputError
from mi_refgs.runs.relightable import relightable
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.splat import Camera


class EditOptions(TypedDict, total=False):
    """Keywords of `Reconstruction.edit`, options of `refgs edit`: which surfels, and what is done to them.

    Selected are the surfels that meet every condition which is given, without any all of them. What is done
    is done in the order below. Lengths are in scene units.
    """

    where: str | None
    """An expression such as "metallic > 0.5 and z < 0", of activated values: x y z, opacity, size (the
    largest standard deviation), normal.x … .z (outwards), the shares of the run such as albedo.r, roughness
    and metallic, colour.r … .b (of fitted radiance, what is the same from everywhere), luminance; with
    + - * / **, comparisons, and or not, abs sqrt min max."""
    box: Sequence[float] | None
    """(6,): two opposite corners, between which centres lie."""
    nearest: Sequence[float] | None
    """(x, y, z, r): centres within r of the surfel that is nearest to the point."""
    mask: np.ndarray | str | Path | None
    """(H, W) bool, or a picture painted white: what the view shows there, and not what is behind."""
    invert: bool
    """Select the others instead."""
    materials: bool
    """First make materials alone of the whole scene, so that nothing stays as fitted to its light."""
    set: Assignments
    """{"roughness": 0.3, "albedo": (0.9, 0.6, "0.5 * albedo.b")}, or texts such as "roughness*=0.5"."""
    scale: float
    """Factor of the size, about the mean of the selected positions by opacity."""
    rotate: Rotate | None
    """("z", degrees): a turn about an axis through there, counter-clockwise; or three numbers for it."""
    move: Sequence[float] | None
    """(3,)."""
    duplicate: Sequence[float] | None
    """(3,): do all that to a copy, which is moved so far; what was there stays."""
    cut: bool
    """Remove the selected surfels."""
    keep: bool
    """Remove the others."""


DOES = ("cut", "keep", "move", "rotate", "scale", "duplicate")
"""Options that are fields of `Change` as they are."""
RECORDED = tuple(name for name in EditOptions.__annotations__ if name not in ("mask", "set"))
"""Options that a record has as they are given."""


@dataclass(frozen=True, eq=False)
class Edited:
    """A scene after an edit."""

    scene: TrainedScene
    notes: tuple[str, ...]  # what a person should know: what stayed as fitted, whose light shines
    record: dict[str, Any]  # for JSON: the options given, `selected` surfels `of` so many, `surfels` now


def edit(
    scene: TrainedScene,
    *,
    camera: Camera | None = None,
    into: TrainedScene | None = None,
    **options: Unpack[EditOptions],
) -> Edited:
    """Change surfels of a scene, and then add it `into` another scene, if there is one.

    `camera` is that of the view which a mask was painted in; `materials` makes those of both scenes. Raises
    InputError for what makes no sense, an unknown option, a selection of nothing, and if there is nothing to
    do.
    """
    for name in options.keys() - EditOptions.__annotations__:
        raise InputError(
            f"edit: {name}: unknown option; use some of {', '.join(EditOptions.__annotations__)}"
        )
    which = Selection(
        options.get("where"),
        options.get("box"),
        options.get("nearest"),
        options.get("mask"),
        camera,
        options.get("invert", False),
    )
    does = {name: options[name] for name in DOES if name in options}  # type: ignore[literal-required]
    change = Change(set=assignments(options.get("set", ())), **does)
    materials = options.get("materials", False)
    if change.nothing and not materials and into is None:
        raise InputError("edit: nothing to do; give --set, --cut, --move or another change")
    if materials:
        scene, into = relightable(scene), None if into is None else relightable(into)
    chosen = select(scene, which)
    told = notes(scene, change, into is not None)
    changed = scene if change.nothing else apply(scene, chosen, change)
    if into is not None:
        changed, more = join(into, changed)
        told += more
    counts = {"selected": int(chosen.sum()), "of": len(chosen), "surfels": changed.surfels.count}
    return Edited(changed, tuple(told), {**_asked(options, change), **counts, "notes": told})


def _asked(options: EditOptions, change: Change) -> dict[str, Any]:
    """The options that were given, as JSON has them."""
    given = {name: value for name, value in options.items() if name in RECORDED}
    record = {name: _plain(value) for name, value in given.items() if not _unset(name, value)}
    if isinstance(options.get("mask"), str | Path):
        record["mask"] = str(options["mask"])
    if change.set:
        record["set"] = [assignment.text for assignment in change.set]
    return record


def _unset(name: str, value: Any) -> bool:
    """Whether an option has the value that it has when it is left out; a value may be an array."""
    return value is None or value is False or (name == "scale" and value == 1)


def _plain(value: Any) -> Any:
    """A value as JSON has it."""
    if isinstance(value, str | bool):
        return value
    return [_plain(part) for part in value] if isinstance(value, Iterable) else float(value)
