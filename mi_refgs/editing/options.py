"""Options of an edit: which surfels, and what is done to them. `refgs edit` reads its own from here."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, TypedDict

from tyro.conf import UseAppendAction, arg

Assignments = Mapping[str, float | Sequence[float]] | Iterable[str]
"""{"roughness": 0.3, "albedo": (0.9, 0.6, 0.2)}, or texts such as "roughness*=0.5"."""
Rotate = tuple[str | Sequence[float], float | str] | Sequence[str]
"""An axis, "x", "y", "z" or three numbers, and degrees."""

optional = partial(arg, help_behavior_hint="")
Flag = Annotated[bool, optional()]
# What commands parse.
Three: Any = tuple[float, float, float] | None
Four: Any = tuple[float, float, float, float] | None
Six: Any = tuple[float, float, float, float, float, float] | None
AxisAngle: Any = tuple[str, str] | None
Vector = Annotated[Sequence[float] | None, optional(constructor=Three, metavar="X Y Z")]


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Surfels that meet all of these (default: all surfels)."""

    where: Annotated[str | None, optional(metavar="CONDITION")] = None
    """such as "metallic > 0.5 and z < 0": comparisons with a number, between `and` and `or`, of x y z,
    opacity, size (the largest standard deviation), normal.x … .z (outwards), materials such as albedo.r, or
    colour.r … .b (the fitted radiance, its SH term of degree 0); an unknown name lists the known ones"""
    box: Annotated[Sequence[float] | None, optional(constructor=Six, metavar="X0 Y0 Z0 X1 Y1 Z1")] = None
    """centres inside an axis-aligned box"""
    nearest: Annotated[Sequence[float] | None, optional(constructor=Four, metavar="X Y Z R")] = None
    """centres within R of the surfel that is nearest to the point"""
    invert: Flag = False
    """all other surfels instead"""


@dataclass(frozen=True, kw_only=True)
class Change:
    """What is done to the selected surfels, in this order."""

    materials: Flag = False
    """first replace colours that were fitted to the environment map, of the whole scene, by materials"""
    set: Annotated[
        Assignments,
        optional(constructor=UseAppendAction[tuple[tuple[str, ...], ...]], metavar="NAME=VALUE …"),
    ] = ()
    """such as roughness=0.3 albedo=0.9,0.6,0.2 opacity*=0.5, one after the other; colour=R,G,B for methods
    with fitted colours"""
    scale: Annotated[float, arg(metavar="F")] = 1.0
    """scale about the middle of the selection, the mean of the positions weighted by opacity"""
    rotate: Annotated[Rotate | None, optional(constructor=AxisAngle, metavar="AXIS DEG")] = None
    """rotate about the middle of the selection and the axis x, y, z or X,Y,Z, counter-clockwise"""
    move: Vector = None
    """translate, scene units"""
    duplicate: Vector = None
    """change a copy that is translated by this; the original stays"""
    cut: Flag = False
    """remove the selection"""
    keep: Flag = False
    """remove everything else"""

    @property
    def is_empty(self) -> bool:
        """Whether it changes nothing."""
        return not (self.materials or self.set or self.cut or self.keep or self.moves)

    @property
    def moves(self) -> bool:
        """Whether it places surfels elsewhere, or larger."""
        return self.scale != 1 or any(x is not None for x in (self.move, self.rotate, self.duplicate))


class EditOptions(TypedDict, total=False):
    """Keywords of `Reconstruction.edit`, described by `Selection` and `Change` of `mi_refgs.editing.options`.

    The surfels that meet every given condition are selected, without a condition all of them. Changes are
    applied in the order of `Change`. Lengths are in scene units.
    """

    where: str | None
    box: Sequence[float] | None  # (6,)
    nearest: Sequence[float] | None  # (4,)
    invert: bool
    materials: bool
    set: Assignments
    scale: float
    rotate: Rotate | None
    move: Sequence[float] | None  # (3,)
    duplicate: Sequence[float] | None  # (3,)
    cut: bool
    keep: bool
