"""Losses of a fit, as methods know them: names with weights, checked before the fit begins."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from mi_refgs.errors import InputError
from mi_refgs.registry import Registry
from mi_refgs.types import Float

Inputs = TypeVar("Inputs")


@dataclass(frozen=True)
class Loss(Generic[Inputs]):
    """A loss, which a method weighs by its name; the same for all of a fit, photometric or not. `Inputs` is
    `mi_refgs.LossInputs`."""

    name: str  # of its weight in `[loss]` of a method file
    value: Callable[[Inputs], Float | None]  # width 1; None: not defined for these inputs
    normals: bool = False  # reads blended normals
    maps: bool = False  # reads blended materials, which deferred stages have
    light: bool = False  # reads the light
    attributes: tuple[str, ...] = ()  # of surfels, that it reads


def _check(loss: Loss[Any]) -> None:
    if not re.fullmatch("[A-Za-z0-9_-]+", loss.name):
        what = f"'{loss.name}' has characters besides letters, digits, _ and -"
        raise InputError(what, "loss", remedy="choose another name")


LOSSES = Registry[Loss[Any]]("loss", _check, package="mi_refgs.fitting.objective", of=Loss)
register = LOSSES.register
"""Add a loss, which method files can weigh from then on."""
