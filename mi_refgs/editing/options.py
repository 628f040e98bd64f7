"""Options of an edit: which surfels, and what is done to them. `refgs edit` reads its own from here."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, TypedDict

from tyro.conf import UseAppendAction, arg

Assignments = Mapping[str, float | Sequence[float]] | Iterable[str]
"""{"roughness": 0.3, "albedo": (0.9, 0.6, 0.2)}, or texts such as "roughness*=0.5"."""

optional = partial(arg, help_behavior_hint="")
Flag = Annotated[bool, optional()]
Six: Any = tuple[float, float, float, float, float, float] | None


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Surfels that meet all of these (default: all surfels)."""

    where: Annotated[str | None, optional(metavar="CONDITION")] = None
    """such as "metallic > 0.5 and z < 0": comparisons with a number, between `and` and `or`, of x y z,
    opacity, size (the largest standard deviation), normal.x … .z (outwards), materials such as albedo.r, or
    colour.r … .b (the fitted radiance, its SH term of degree 0; of imported splats it is display-encoded);
    an unknown name lists the known ones"""
    box: Annotated[Sequence[float] | None, optional(constructor=Six, metavar="X0 Y0 Z0 X1 Y1 Z1")] = None
    """centres inside an axis-aligned box"""
    invert: Flag = False
    """all other surfels instead"""


@dataclass(frozen=True, kw_only=True)
class Change:
    """What is done to the selected surfels: `materials` first, then `set` or `cut`."""

    materials: Flag = False
    """first replace colours that were fitted to the environment map, of the whole scene, by materials"""
    set: Annotated[
        Assignments,
        optional(constructor=UseAppendAction[tuple[tuple[str, ...], ...]], metavar="NAME=VALUE …"),
    ] = ()
    """such as roughness=0.3 albedo=0.9,0.6,0.2 opacity*=0.5, one after the other; colour=R,G,B for methods
    with fitted colours"""
    cut: Flag = False
    """remove the selection; with --invert everything else"""


class EditOptions(TypedDict, total=False):
    """Keywords of `Reconstruction.edit`: those of `Selection` and of `Change`, applied in its order."""

    where: str | None
    box: Sequence[float] | None  # (6,)
    invert: bool
    materials: bool
    set: Assignments
    cut: bool
