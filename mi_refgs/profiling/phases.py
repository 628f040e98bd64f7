"""Wall time of a training step by phase, between barriers.

The clock listens to the hooks of `mi_refgs.kernels.timing`. The backward pass is one call of Dr.Jit:
identities at the boundaries between phases notify the clock of the phase that the pass has reached.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from mi_refgs.kernels.timing import listening

PHASES = (
    "prefilter forward",
    "shade forward",
    "project",
    "tile lists",
    "sort",
    "splat forward",
    "ssim forward",
    "loss backward",
    "shade backward",
    "splat backward",
    "surfels backward",
    "prefilter backward",
    "optimiser",
    "rest",
)
"""Every phase, in the order of a step. `shade forward` and `shade backward` are those of deferred shading;
the adjoint of forward shading is in `surfels backward`, with the projection. `rest`: all that no other
covers."""

WARM_UP = 4
"""Steps with barriers before the first measured one: a kernel that ends at a barrier is compiled anew."""


class PhaseClock:
    """Sums wall time by innermost phase; a `timing.Listener`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._phase: str | None = None
        self._since = 0.0

    def call(self, phase: str, function: Callable[[], Any], arguments: Any = ()) -> Any:
        """Evaluate the arguments, whose time is not the phase's; run the function, wait, and add the time."""
        dr.eval(arguments)
        outer = self._phase
        self._enter(phase)
        try:
            result = function()
            dr.eval(result)
        finally:
            self._enter(outer)
        return result

    def boundary(self, value: Any, phase: str) -> Any:
        """The value, with identities on everything under AD."""
        leaves: list[Any] = []

        def collect(leaf: Any) -> Any:
            if dr.grad_enabled(leaf):
                leaves.append(leaf)
            return leaf

        _map(value, collect)
        if not leaves:
            return value
        passed = iter(dr.custom(_Boundary, leaves, lambda: self._enter(phase)))
        return _map(value, lambda leaf: next(passed) if dr.grad_enabled(leaf) else leaf)

    def _enter(self, phase: str | None) -> None:
        dr.eval()
        dr.sync_thread()
        now = time.perf_counter()
        if self._phase is not None:
            self.seconds[self._phase] += now - self._since
        self._phase, self._since = phase, now


class _Boundary(dr.CustomOp):
    """Identity that calls a function when the backward pass reaches it."""

    def eval(self, values: list[Any], reached: Callable[[], None]) -> list[Any]:
        self.reached = reached
        return [type(value)(value) for value in values]

    def backward(self) -> None:
        δvalues = self.grad_out()
        dr.eval(δvalues)
        self.reached()
        self.set_grad_in("values", δvalues)

    def name(self) -> str:
        return "boundary"


def _map(value: Any, change: Callable[[Any], Any]) -> Any:
    """Apply a function to every Dr.Jit array in a value."""
    if dr.is_array_v(value):
        return change(value)
    if isinstance(value, list | tuple):
        return type(value)([_map(item, change) for item in value])
    if isinstance(value, dict):
        return {key: _map(item, change) for key, item in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        found = {f.name: _map(getattr(value, f.name), change) for f in fields(value) if f.init}
        return replace(value, **found)
    return value


def phase_times(
    step: Callable[[], Any], steps: int, before: Callable[[], None] = lambda: None
) -> dict[str, float]:
    """Median milliseconds of a step by phase, in the order of PHASES; `before` is called before each step.

    The sum exceeds the time of a step if kernels fuse across phases, since there are barriers in between.
    """
    rows = []
    for _ in range(WARM_UP + steps):
        before()
        clock = PhaseClock()
        with listening(clock):
            clock.call("rest", step)
        rows.append(clock.seconds)
    rows = rows[WARM_UP:]
    named = [phase for phase in PHASES if any(phase in row for row in rows)]
    return {phase: 1e3 * float(np.median([row.get(phase, 0.0) for row in rows])) for phase in named}
