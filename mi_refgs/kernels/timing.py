"""Named phases of a step, for a listener that times them.

`phase` marks a function as a phase, `boundary` a value at which the backward pass enters another one. While
nobody listens both do nothing: no kernel, no launch, no node of the derivative graph. Names of phases are
those of `profiling.phases`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])


class Listener(Protocol):
    """What is told of phases."""

    def call(self, phase: str, function: Callable[[], Any], arguments: Any) -> Any:
        """Call the function, which holds its `arguments`, and return its result."""

    def boundary(self, value: Any, phase: str) -> Any:
        """Return the value, changed only in what happens when derivatives pass it."""


_listener: Listener | None = None


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Tell `listener` of every phase in the block, and nobody else."""
    global _listener
    before, _listener = _listener, listener
    try:
        yield
    finally:
        _listener = before


def phase(name: str) -> Callable[[Function], Function]:
    """Decorator: every call of the function is the phase `name`."""

    def decorate(function: Function) -> Function:
        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            if _listener is None:
                return function(*args, **kwargs)
            return _listener.call(name, functools.partial(function, *args, **kwargs), (args, kwargs))

        return call  # type: ignore[return-value]

    return decorate


def boundary(value: Any, name: str) -> Any:
    """The value itself; a backward pass that comes to it enters the phase `name`."""
    return value if _listener is None else _listener.boundary(value, name)
