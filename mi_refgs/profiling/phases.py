"""Where the time of a training step goes: wall time by stage, between barriers.

Forward stages are functions that a clock wraps. The backward pass is one call of Dr.Jit: invisible identities
at the stages' boundaries are visited by it in turn, and tell the clock which stage it has come to. Only the
names of the package's own functions are known here, nothing of the kernels behind them.
"""

from __future__ import annotations

import importlib
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

PHASES = (
    "prefilter forward",
    "shade forward",
    "project",
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
"""In the order of a step. `shade forward` and `shade backward` are those of shading at pixels; shading at
surfels goes back in `surfels backward`, with the projection. `rest`: whatever no stage covers."""


WARM_UP = 4
"""Steps with barriers before the first that counts: a kernel that ends at a barrier is compiled anew."""


class PhaseClock:
    """Wraps functions so that each call is evaluated, waited for and booked under a name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._undo: list[tuple[Any, str, Any]] = []
        self._stage: str | None = None  # of the backward pass
        self._since = 0.0

    def wrap(
        self,
        owner: Any,
        attribute: str,
        stage: str | None,
        *,
        entered: str | None = None,
        left: str | None = None,
    ) -> None:
        """Replace owner.attribute by a version timed as `stage`, until `restore`.

        The backward pass is in stage `entered` from where it reaches the function's result, and in `left`
        once it has come to its arguments.
        """
        original = getattr(owner, attribute)

        def timed(*args: Any, **kwargs: Any) -> Any:
            if left is not None:
                args, kwargs = self._boundary((args, kwargs), left)
            if stage is None:
                result = original(*args, **kwargs)
            else:
                dr.eval(args, kwargs)  # what the stage is given is not its own time
                result = self.measure(stage, lambda: original(*args, **kwargs))
            return result if entered is None else self._boundary(result, entered)

        self._replace(owner, attribute, timed)

    def wrap_backward(self, stage: str) -> None:
        """Time Dr.Jit's backward pass by boundaries; it begins in this stage."""
        original = dr.backward

        def timed(*args: Any, **kwargs: Any) -> Any:
            dr.eval(args)
            self._barrier()
            self._stage, self._since = stage, time.perf_counter()
            original(*args, **kwargs)
            self._reach(None)

        self._replace(dr, "backward", timed)

    def measure(self, stage: str, call: Callable[[], Any]) -> Any:
        """Run, evaluate, wait, book."""
        self._barrier()
        begin = time.perf_counter()
        result = call()
        dr.eval(result)
        self._barrier()
        self.seconds[stage] += time.perf_counter() - begin
        return result

    def restore(self) -> None:
        """Put the originals back."""
        while self._undo:
            setattr(*self._undo.pop())

    def _replace(self, owner: Any, attribute: str, function: Any) -> None:
        self._undo.append((owner, attribute, getattr(owner, attribute)))
        setattr(owner, attribute, function)

    def _boundary(self, value: Any, stage: str) -> Any:
        """The value, with identities on all that carries derivatives."""
        leaves: list[Any] = []

        def collect(leaf: Any) -> Any:
            if dr.grad_enabled(leaf):
                leaves.append(leaf)
            return leaf

        _map(value, collect)
        if not leaves:
            return value
        passed = iter(dr.custom(_Boundary, leaves, lambda: self._reach(stage)))
        return _map(value, lambda leaf: next(passed) if dr.grad_enabled(leaf) else leaf)

    def _reach(self, stage: str | None) -> None:
        if self._stage is None:  # another backward pass than the timed one
            return
        self._barrier()
        now = time.perf_counter()
        self.seconds[self._stage] += now - self._since
        self._stage, self._since = stage, now

    @staticmethod
    def _barrier() -> None:
        dr.eval()
        dr.sync_thread()


class _Boundary(dr.CustomOp):
    """Identity that tells when derivatives pass it on their way back."""

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
    """The value with every Dr.Jit array in it changed."""
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


def phase_times(trainer: Any, steps: int, before: Callable[[], None] = lambda: None) -> dict[str, float]:
    """Median milliseconds a step by stage, in the order of PHASES; `before` is called ahead of every step.

    With barriers between them: their sum is more than a step takes, as kernels otherwise fuse across stages.
    """

    def module(name: str) -> Any:
        return importlib.import_module(f"mi_refgs.{name}")

    clock = PhaseClock()
    splat, optim = module("splat"), module("fit.optim")
    clock.wrap(splat, "project", "project")
    clock.wrap(splat, "list_by_tile", "sort")
    clock.wrap(splat, "blend", "splat forward", entered="splat backward", left="surfels backward")
    clock.wrap(module("render.pipeline"), "shade", "shade forward")
    clock.wrap(module("fit.train"), "render", None, entered="shade backward")
    clock.wrap(
        module("shade.envmap").EnvironmentLight,
        "prefilter",
        "prefilter forward",
        entered="prefilter backward",
    )
    clock.wrap(module("fit.losses"), "ssim", "ssim forward")
    clock.wrap(optim.Adam, "step", "optimiser")
    clock.wrap_backward("loss backward")
    rows = []
    try:
        for _ in range(WARM_UP + steps):
            before()
            clock.seconds.clear()
            clock.measure("all", trainer.step)
            row = dict(clock.seconds)
            whole = row.pop("all")
            rows.append(row | {"rest": whole - sum(row.values())})
    finally:
        clock.restore()
    rows = rows[WARM_UP:]
    named = [stage for stage in PHASES if any(stage in row for row in rows)]
    return {stage: 1e3 * float(np.median([row.get(stage, 0.0) for row in rows])) for stage in named}
