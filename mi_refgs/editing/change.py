"""What is done to the selected surfels of a scene, and to the triangles that are theirs."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mi_refgs.editing import follow
from mi_refgs.editing.expression import Expression, parse_numbers
from mi_refgs.editing.fields import COLOUR, Fields, constant_colour
from mi_refgs.editing.rigid import Placement, rotation_about
from mi_refgs.editing.selection import finite
from mi_refgs.errors import InputError, abbreviated
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.surfels.attributes import SH_DC, logit, sigmoid
from mi_refgs.surfels.table import Surfels

ASSIGNMENT = re.compile(r"\s*([A-Za-z_][\w.]*)\s*(\*?=)(?!=)(.*)", re.ASCII | re.DOTALL)
ANOTHER = re.compile(r"[\s,;][A-Za-z_][\w.]*\s*\*?=(?!=)", re.ASCII)
"""The beginning of a further assignment in the value of one."""
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
SCALES = (1e-6, 1e6)
"""Factors of --scale: beyond, float32 holds no scene."""
COLOUR_FLOOR = 1e-3
"""Constant colour below which a surfel's view dependence is no share of it: a new colour replaces all."""

Value = float | str | Sequence[float | str]
Assignments = Mapping[str, Value] | Iterable[str]
Rotate = tuple[str | Sequence[float], float | str] | Sequence[str]
"""An axis, "x", "y", "z" or three numbers, and degrees."""


@dataclass(frozen=True)
class Assignment:
    """New values of a channel, one of its columns, or `colour`: as many expressions as columns, or one."""

    name: str
    values: tuple[Expression, ...]
    times: bool = False  # the values multiply what is there
    text: str = ""  # as it was written

    @staticmethod
    def parse(text: str) -> Assignment:
        """From `name=value` or `name*=value`, a value being numbers or expressions with commas between them.

        Raises InputError for anything else.
        """
        found = ASSIGNMENT.fullmatch(text)
        if found is None:
            raise InputError(f"--set: {abbreviated(text)}: no assignment; write it like roughness=0.3")
        if ANOTHER.search(found[3]):
            raise InputError(
                f"--set: {abbreviated(text)}: several assignments in one; quote each one separately"
            )
        return Assignment(found[1], tuple(parse_numbers(found[3])), found[2] == "*=", text.strip())


def assignments(given: Assignments) -> tuple[Assignment, ...]:
    """From texts as on the command line, or from values by name, such as {"albedo": (0.9, 0.6, 0.2)}.

    Raises InputError as `Assignment.parse` does.
    """
    if isinstance(given, str):
        given = [given]
    if not isinstance(given, Mapping):
        return tuple(Assignment.parse(text) for text in given)
    texts = []
    for name, value in given.items():
        parts = [value] if isinstance(value, str) or not isinstance(value, Iterable) else [*value]
        texts.append(
            f"{name}={','.join(part if isinstance(part, str) else repr(float(part)) for part in parts)}"
        )
    return tuple(Assignment.parse(text) for text in texts)


@dataclass(frozen=True)
class Change:
    """What is done, in this order: set; scaled, turned and moved about the middle; duplicated; cut.

    The middle is the mean of the selected positions by opacity, as before the change. A duplicate is what
    everything is done to where there is one: the original stays as it is. Raises InputError for what makes no
    sense.
    """

    set: tuple[Assignment, ...] = ()  # `assignments`
    cut: bool = False  # remove the selected surfels
    keep: bool = False  # remove the others
    move: Sequence[float] | None = None  # (3,) scene units
    rotate: Rotate | None = None
    scale: float = 1.0
    duplicate: Sequence[float] | None = None  # (3,) scene units by which the copy is moved

    def __post_init__(self) -> None:
        if self.cut and not replace(self, cut=False).nothing:
            raise InputError("--cut: what is removed cannot be changed, too; leave the rest out")
        if self.keep and self.duplicate is not None:
            raise InputError("--keep: with --duplicate it says nothing; do one after the other")
        _ = self.turn
        if not SCALES[0] <= self.scale <= SCALES[1]:
            raise InputError(f"--scale: {self.scale:g} is out of range; give {SCALES[0]:g} to {SCALES[1]:g}")
        for where, vector in (("--move", self.move), ("--duplicate", self.duplicate)):
            if vector is not None:
                finite(where, vector, 3)

    @property
    def nothing(self) -> bool:
        """Whether it does nothing."""
        given = (self.move, self.rotate, self.duplicate)
        does = self.set or self.cut or self.keep or self.scale != 1
        return not does and all(value is None for value in given)

    @property
    def turn(self) -> Rotation:
        """The rotation; raises InputError for an axis or an angle that is none."""
        if self.rotate is None:
            return Rotation.identity()
        if isinstance(self.rotate, str) or len(self.rotate) != 2:
            raise InputError(f"--rotate: {abbreviated(self.rotate)}: not an axis and an angle; example: z 90")
        axis = _axis(self.rotate[0])
        try:
            degrees = float(self.rotate[1])
        except (ValueError, TypeError) as error:
            raise InputError(
                f"--rotate: {abbreviated(self.rotate[1])}: no angle; give degrees, like z 90"
            ) from error
        if not (np.isfinite(degrees) and np.linalg.norm(axis) > 0):
            raise InputError("--rotate: an axis without length, or an endless angle; give them like z 90")
        return rotation_about(axis, degrees) if degrees % 360 else Rotation.identity()

    def placement(self, raw: Mapping[str, np.ndarray]) -> Placement:
        """Where selected surfels of these raw channels go."""
        shift = np.zeros(3)
        for where, vector in (("--move", self.move), ("--duplicate", self.duplicate)):
            shift = shift if vector is None else shift + finite(where, vector, 3)
        # Not the median, which does not turn with the surfels: a turn and its opposite would shift them.
        weight = sigmoid(raw["opacity"][:, 0]) + np.finfo(np.float64).tiny
        middle = np.average(raw["position"].astype(np.float64), axis=0, weights=weight)
        return Placement(middle, shift, self.turn, float(self.scale))


def apply(scene: TrainedScene, chosen: np.ndarray, change: Change) -> TrainedScene:
    """The scene with the chosen surfels (N,) bool changed; all others keep their values bit for bit.

    The order of the surfels stays; a duplicate comes after all. The mesh follows (`follow`). Raises
    InputError for a selection of nothing, values that cannot be set, and if no surfel would be left.
    """
    if chosen.shape != (scene.surfels.count,) or not chosen.any():
        raise InputError("selection: no surfel is in it; choose a wider one")
    if change.cut and chosen.all():
        raise InputError("--cut: no surfel would be left; choose fewer")
    fields = Fields(scene)
    own = {name: table[chosen] for name, table in fields.raw.items()}
    placement = change.placement(own)
    for assignment in change.set:
        _assign(fields, own, chosen, assignment)
    mesh = _mesh(scene, chosen, own, change, placement)
    placement.place(own, np.ones(len(own["position"]), bool))
    raw = fields.raw
    for name, table in raw.items():
        if change.duplicate is not None:
            raw[name] = np.concatenate([table, own[name]])
        elif change.cut:
            raw[name] = table[~chosen]
        elif change.keep:
            raw[name] = own[name]
        else:
            table[chosen] = own[name]
    return replace(scene, surfels=Surfels.from_numpy(raw), mesh=mesh)


def _mesh(
    scene: TrainedScene,
    chosen: np.ndarray,
    own: Mapping[str, np.ndarray],
    change: Change,
    placement: Placement,
) -> Mesh | None:
    """The mesh after the change; `own` has the new values of the chosen surfels at their old places."""
    mesh, raw = scene.mesh, scene.surfels.to_numpy()
    fades = not np.array_equal(raw["opacity"][chosen], own["opacity"])
    stays = placement.does_nothing and not (fades or change.cut or change.keep)
    if mesh is None or not len(mesh.faces) or (stays and change.duplicate is None):
        return mesh
    owners = follow.Owners(scene)
    after = sigmoid(raw["opacity"][:, 0])
    after[chosen] = sigmoid(own["opacity"][:, 0])
    theirs = owners.chosen(chosen)
    moved = follow.placed(mesh.part(theirs & (owners.share(after) >= follow.MAJORITY)), placement)
    if change.cut:
        return mesh.part(~theirs)
    if change.keep:
        return follow.together(mesh.part(~owners.chosen(np.ones(len(chosen), bool))), moved)
    return follow.together(mesh if change.duplicate is not None else mesh.part(~theirs), moved)


def _assign(fields: Fields, own: dict[str, np.ndarray], chosen: np.ndarray, assignment: Assignment) -> None:
    """Set raw values of the chosen rows, `own`, in place."""
    name, _, letter = assignment.name.partition(".")
    tints = name == COLOUR and COLOUR in fields.settable
    if assignment.name not in fields.settable:
        raise InputError(
            f"--set: {abbreviated(assignment.name)} cannot be set of these surfels; use one of "
            f"{', '.join(fields.settable)}"
        )
    columns = list(range(3)) if tints else fields.columns[assignment.name][1]
    columns = ["rgb".index(letter)] if tints and letter else columns
    values = assignment.values
    if len(values) not in (1, len(columns)):
        raise InputError(f"--set: {assignment.name}: {len(values)} values; give 1 or {len(columns)}")
    for value in values:
        fields.check(value.names, "--set")
    count = len(chosen)
    new = np.stack([np.broadcast_to(value.of(fields), count)[chosen] for value in values], axis=1)
    old = fields.rgb(COLOUR) if tints else fields.activated(name)
    new = np.broadcast_to(
        new * old[chosen][:, columns] if assignment.times else new, (len(new), len(columns))
    )
    if not np.isfinite(new).all():
        raise InputError(f"--set: {assignment.name}: not a finite number for every surfel; mend the formula")
    least, most = new.min(), new.max()
    fixed = not assignment.times and not any(value.names for value in values)
    if fixed and (least < 0 or (most > 1 and not tints)):
        wanted = "0 or more" if tints else "0 to 1"
        raise InputError(f"--set: {assignment.name}: {least:g} … {most:g} is out of range; give {wanted}")
    if not tints:
        own[name][:, columns] = logit(np.clip(new, 0, 1))
        return
    raw, constant = own["radiance_sh"], constant_colour(own["radiance_sh"])
    for column, wanted in zip(columns, np.maximum(new, 0).T, strict=True):
        there = constant[:, column] > COLOUR_FLOOR
        factor = np.where(there, wanted / np.where(there, constant[:, column], 1), 0)
        raw[:, column] = (wanted - 0.5) / SH_DC
        raw[:, 3 + column :: 3] *= factor[:, None].astype(np.float32)


def _axis(axis: Any) -> np.ndarray:
    if isinstance(axis, str):
        if axis not in AXES:
            try:
                return finite("--rotate", [float(part) for part in axis.split(",")], 3)
            except ValueError as error:
                raise InputError(
                    f"--rotate: {abbreviated(axis)}: no axis; give x, y, z, or three numbers like 0,0,1"
                ) from error
        return np.array(AXES[axis])
    return finite("--rotate", axis, 3)
