"""Initialisers: where the surfels of a fit start. Methods name some; the first that fits the data is used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.region import Region
from mi_refgs.registry import Registry


@dataclass(frozen=True)
class Wanted:
    """What an initialiser is asked for."""

    count: int
    data: Dataset
    rng: np.random.Generator
    share: float = 0.0  # fraction that starts anywhere, not where surfaces may be: `surfels.inside`
    region: Region | None = None  # of interest, in an open scene
    inside: bool = True  # the object, in the region; else the background, outside of it


@dataclass(frozen=True)
class Start:
    """Where surfels start."""

    position: np.ndarray  # (count, 3) scene units
    colour: np.ndarray  # (count, 3) linear radiance
    normal: np.ndarray | None = None  # (count, 3) unit; by default random


@dataclass(frozen=True)
class Initialiser:
    """A way to start."""

    name: str  # in `surfels.start`
    start: Callable[[Wanted], Start | None]  # None: not with these data


INITIALISERS: Registry[Initialiser]
INITIALISERS = Registry("initialiser", package="mi_refgs.fitting.initialisers", of=Initialiser)
register = INITIALISERS.register
"""Add an initialiser, which methods can name from then on."""
