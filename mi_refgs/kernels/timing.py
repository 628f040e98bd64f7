"""Named phases (of `benchmarks.profile`) of a step, for a listener that times them, if there is one."""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar

from mi_refgs.types import Arrays

Function = TypeVar("Function", bound=Callable[..., Any])


class Listener(Protocol):
    """Receives the phases."""

    def call(self, phase: str, function: Callable[[], Any], arguments: Any) -> Any:
        """Call the function, bound to its `arguments`, and return its result."""

    def boundary(self, value: Arrays, phase: str) -> Arrays:
        """Return the value, with a node of the AD graph that notices derivatives."""


_listener: Listener | None = None


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Report every phase in the block to `listener` only."""
    global _listener
    before, _listener = _listener, listener
    try:
        yield
    finally:
        _listener = before


def phase(name: str, backward: str | None = None) -> Callable[[Function], Function]:
    """Decorator: every call of the function is the phase `name`, and its result a boundary to `backward`."""

    def decorate(function: Function) -> Function:
        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            if _listener is None:
                return function(*args, **kwargs)
            result = _listener.call(name, functools.partial(function, *args, **kwargs), (args, kwargs))
            return result if backward is None else _listener.boundary(result, backward)

        return call  # type: ignore[return-value]

    return decorate


def boundary(value: Arrays, name: str) -> Any:
    """The value itself; a backward pass that comes to it enters the phase `name`."""
    return value if _listener is None else _listener.boundary(value, name)
