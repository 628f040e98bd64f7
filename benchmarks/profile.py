"""Where the time of a step of a fitted run goes: python -m benchmarks.profile RUN

Wall time and kernel launches by phase, between barriers. The clock listens to the hooks of
`mi_refgs.kernels.timing`. The backward pass is one call of Dr.Jit: identities at the boundaries between
phases notify the clock of the phase that the pass has reached. Nothing is written."""

import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.common.report import plain_parser
from mi_refgs.errors import InputError
from mi_refgs.fitting.schedule import FitSetup
from mi_refgs.fitting.train import Trainer
from mi_refgs.kernels.timing import listening
from mi_refgs.kernels.trees import mapped
from mi_refgs.runs.run import Run
from mi_refgs.runs.views import views_of_run

PHASES = (
    *("prefilter forward", "shade forward", "project", "tile lists", "sort", "splat forward", "ssim forward"),
    *("loss backward", "shade backward", "splat backward", "surfels backward", "prefilter backward"),
    *("optimiser", "rest"),
)
"""Every phase, in the order of a step. The adjoint of forward shading is in `surfels backward`, with the
projection. `rest`: all that no other covers."""

WARM_UP = 4  # steps with barriers that are not measured: a kernel that ends at one is compiled anew
NEAR_END = 100  # steps before the end of a stage, where every SH degree is in use


class PhaseClock:
    """Sums wall time and kernel launches by innermost phase; a `timing.Listener`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.launches: dict[str, int] = defaultdict(int)  # with Dr.Jit's KernelHistory only
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
            leaves.extend([leaf] if dr.grad_enabled(leaf) else [])
            return leaf

        mapped(collect, value)
        passed = iter(dr.custom(_Boundary, leaves, lambda: self._enter(phase)) if leaves else ())
        return mapped(lambda leaf: next(passed) if dr.grad_enabled(leaf) else leaf, value)

    def _enter(self, phase: str | None) -> None:
        dr.eval()
        dr.sync_thread()
        now = time.perf_counter()
        launched = len(dr.kernel_history([dr.KernelType.JIT]))
        if self._phase is not None:
            self.seconds[self._phase] += now - self._since
            self.launches[self._phase] += launched
        self._phase, self._since = phase, time.perf_counter()


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


def phases_of(step: Callable[[], Any], steps: int) -> list[dict[str, Any]]:
    """Measure PHASES of a step in order: name, median `ms`, `launches` of kernels, `share` of all ms.
    Barriers between them undo fusion, so the sum is longer."""
    clocks = [PhaseClock() for _ in range(WARM_UP + steps)]
    for clock in clocks:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory), listening(clock):
            dr.kernel_history_clear()
            clock.call("rest", step)
    clocks = clocks[WARM_UP:]
    named = [phase for phase in PHASES if any(phase in clock.seconds for clock in clocks)]
    ms = {name: 1e3 * float(np.median([clock.seconds[name] for clock in clocks])) for name in named}
    whole = max(sum(ms.values()), 1e-9)
    launches = clocks[-1].launches
    return [dict(phase=n, ms=ms[n], launches=launches[n], share=ms[n] / whole) for n in named]


def stepper(trainer: Trainer, name: str) -> Callable[[], None]:
    """A function that takes steps near the end of a stage, without events; each filters its light."""
    method, end = trainer.method, trainer.method.stage[name].until
    begin = max((stage.until for _, stage in method.stages() if stage.until < end), default=0)
    if method.light is not None:
        method = replace(method, light=replace(method.light, every=1))
    trainer.fit.prefilter.close()
    trainer.setup = FitSetup(method, trainer.data)
    iterations = cycle(range(max(begin + 1, end - NEAR_END), end + 1))
    return lambda: trainer.gradient_step(next(iterations))


def table(run: Run, steps: int = 15) -> str:
    """Lines of the phases of a run, at its newest checkpoint; raises InputError without one."""
    method = run.method()
    if not run.checkpoints():
        raise InputError("none", run.path, "checkpoints", "measure the run that was fitted")
    trainer = Trainer(method, views_of_run(run, method, "train"), run)
    rows = phases_of(stepper(trainer, trainer.method.stage_at(max(trainer.iteration, 1))[0]), steps)
    rows.append({"phase": "sum", "share": 1, **{n: sum(row[n] for row in rows) for n in ("ms", "launches")}})
    line = "{phase:<20}{ms:>10.2f}{launches:>10}{share:>8.0%}"
    head = f"{'phase':<20}{'ms':>10}{'launches':>10}{'share':>8}"
    return "\n".join([head, *(line.format(**row) for row in rows)])


if __name__ == "__main__":
    parser = plain_parser("profile", __doc__)
    parser.add_argument("run", type=Path, help="run folder with a checkpoint")
    mi.set_variant("llvm_ad_rgb")
    print(table(Run(parser.parse_args().run)))
