"""What users can add to a fit: events, initialisers and losses, which methods know by their names."""

import re
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.region import Region
from mi_refgs.errors import InputError
from mi_refgs.registry import Registry
from mi_refgs.types import Float

Fit = TypeVar("Fit")
Inputs = TypeVar("Inputs")


class Event(Generic[Fit]):
    """What happens to a fit (a `mi_refgs.Trainer`) after steps, in the order of `fitting.events`; subclasses
    are frozen dataclasses of settings, without state: what they change belongs to the fit."""

    name: ClassVar[str]  # of its table in a method file, `[event.NAME]`
    always: ClassVar[bool] = False  # happens, with the settings' defaults, in methods without its table
    outside: ClassVar[bool] = False  # happens in `Trainer.train` alone, not in the steps of a trial
    attributes: ClassVar[tuple[str, ...]] = ()  # of surfels, without which it cannot happen

    def require(self, attributes: Collection[str]) -> None:
        """Raise InputError if the event cannot happen to surfels with these attributes."""
        for name in self.attributes:
            if name not in attributes:
                raise InputError(f"there is no attribute '{name}'", remedy="add it, or drop this")

    def observes(self, fit: Fit) -> bool:
        """Whether the coming step adds to `ParameterTable.error_sum`, the error that each surfel causes."""
        return False

    def due(self, fit: Fit) -> bool:
        """Whether the event happens now, after `fit.iteration` steps; 0 is before the first one."""
        raise NotImplementedError

    def apply(self, fit: Fit) -> None:
        """Change the fit."""
        raise NotImplementedError


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
    """A way to start; of those that a method names, the first that fits the data is used."""

    name: str  # in `surfels.start`
    start: Callable[[Wanted], Start | None]  # None: not with these data


@dataclass(frozen=True)
class Loss(Generic[Inputs]):
    """A loss, which a method weighs by its name; the same for all of a fit. Inputs: `mi_refgs.LossInputs`."""

    name: str  # of its weight in `[loss]` of a method file
    value: Callable[[Inputs], Float | None]  # width 1; None: not defined for these inputs
    normals: bool = False  # reads blended normals
    maps: bool = False  # reads blended materials, which deferred stages have
    light: bool = False  # reads the light
    attributes: tuple[str, ...] = ()  # of surfels, that it reads


def _check_loss(loss: Loss[Any]) -> None:
    if not re.fullmatch("[A-Za-z0-9_-]+", loss.name):
        what = f"'{loss.name}' has characters besides letters, digits, _ and -"
        raise InputError(what, "loss", remedy="choose another name")


EVENTS = Registry[type[Event[Any]]]("event", package="mi_refgs.fitting.events", of=Event, classes=True)
INITIALISERS = Registry[Initialiser]("initialiser", package="mi_refgs.fitting.initialisers", of=Initialiser)
LOSSES = Registry[Loss[Any]]("loss", _check_loss, package="mi_refgs.fitting.objective", of=Loss)

register_event = EVENTS.register
"""Add an event, for which method files can have a table from then on."""
register_initialiser = INITIALISERS.register
"""Add an initialiser, which methods can name from then on."""
register_loss = LOSSES.register
"""Add a loss, which method files can weigh from then on."""
