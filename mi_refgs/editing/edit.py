"""One edit of a scene from selection to notes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mi_refgs.editing.change import Assignments, Change, Rotate, apply, assignments
from mi_refgs.editing.join import join
from mi_refgs.editing.notes import notes
from mi_refgs.editing.select import Selection, select
from mi_refgs.errors import InputError
from mi_refgs.runs.export import TrainedScene
from mi_refgs.runs.relightable import relightable
from mi_refgs.splat import Camera


@dataclass(frozen=True, eq=False)
class Edited:
    """A scene after an edit."""

    scene: TrainedScene
    selected: int  # surfels that were changed, duplicated, cut or kept
    of: int  # surfels that there were to select from
    notes: tuple[str, ...]  # what a person should know: what stayed as fitted, whose light shines


def edit(
    scene: TrainedScene,
    *,
    where: str | None = None,
    box: Sequence[float] | None = None,
    nearest: Sequence[float] | None = None,
    mask: np.ndarray | None = None,
    camera: Camera | None = None,
    invert: bool = False,
    materials: bool = False,
    set: Assignments = (),
    scale: float = 1.0,
    rotate: Rotate | None = None,
    move: Sequence[float] | None = None,
    duplicate: Sequence[float] | None = None,
    cut: bool = False,
    keep: bool = False,
    into: TrainedScene | None = None,
) -> Edited:
    """Change the surfels of a scene that meet every condition, and then add it `into` another scene.

    The options are those of `refgs edit`. Conditions, see `Selection`: `where`, `box`, `nearest`, a `mask`
    (H, W) bool painted in the view of a `camera`; `invert` takes the others. What is done, see `Change`, in
    this order: `materials` first makes materials alone of the scene, and of `into` (`runs.relightable`);
    `set`, by name or as texts; `scale`, `rotate`, `move`; `duplicate`; `cut` or `keep`. Raises InputError for
    what makes no sense, a selection of nothing, and if there is nothing to do.
    """
    change = Change(assignments(set), cut, keep, move, rotate, scale, duplicate)
    if change.nothing and not materials and into is None:
        raise InputError("edit: nothing to do; give --set, --cut, --move or another change")
    if materials:
        scene, into = relightable(scene), None if into is None else relightable(into)
    chosen = select(scene, Selection(where, box, nearest, mask, camera, invert))
    told = notes(scene, change, into is not None)
    changed = scene if change.nothing else apply(scene, chosen, change)
    if into is not None:
        changed, more = join(into, changed)
        told += more
    return Edited(changed, int(chosen.sum()), len(chosen), tuple(told))
