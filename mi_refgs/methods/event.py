"""Events of a fit, as methods know them: a table of settings, checked before the fit begins."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, ClassVar, Generic, TypeVar

from mi_refgs.registry import Registry

Fit = TypeVar("Fit")


class Event(Generic[Fit]):
    """What happens to a fit (a `mi_refgs.Trainer`) after steps, in the order of `fitting.events`; subclasses
    are frozen dataclasses of settings, without state: what they change belongs to the fit."""

    name: ClassVar[str]  # of its table in a method file, `[event.NAME]`
    always: ClassVar[bool] = False  # happens, with the settings' defaults, in methods without its table
    outside: ClassVar[bool] = False  # happens in `Trainer.train` alone, not in the steps of a trial

    def require(self, attributes: Collection[str]) -> None:
        """Raise InputError if the event cannot happen to surfels with these attributes."""

    def observes(self, fit: Fit) -> bool:
        """Whether the coming step adds to `ParameterTable.error_sum`, the error that each surfel causes."""
        return False

    def due(self, fit: Fit) -> bool:
        """Whether the event happens now, after `fit.iteration` steps; 0 is before the first one."""
        raise NotImplementedError

    def apply(self, fit: Fit) -> None:
        """Change the fit."""
        raise NotImplementedError


EVENTS = Registry[type[Event[Any]]]("event", package="mi_refgs.fitting.events", of=Event, classes=True)
register = EVENTS.register
"""Add an event, for which method files can have a table from then on."""
