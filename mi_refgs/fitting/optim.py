"""Adam over named tensors: rates per tensor and column, moments that follow the rows, exact resume.

Letters: θ parameter, g gradient, m v first and second moment, t step count of a tensor, η learning rate.
    m ← β₁ m + (1 - β₁) g,   v ← β₂ v + (1 - β₂) g²,   θ ← θ - η √(1 - β₂ᵗ) / (1 - β₁ᵗ) · m / (√v + ε)
[Kingma and Ba 2015, §2, the efficient order].

Two guards. A step whose loss or gradient has a NaN or an infinity changes nothing: the device decides, and
the host reads later (`Adam.report`) how many there were and which rows had such gradients. And |g| is cut to
OUTLIER times what is usual for the entry, √(v / (1 - β₂ᵗ)), or for half of its tensor, whichever is more, and
to RAW_LIMIT, whose square float32 can represent: else v would stop an entry after one huge gradient."""

import math
import operator
from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass
from functools import reduce

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.constants import RAW_LIMIT
from mi_refgs.fitting.row_rates import RowRate
from mi_refgs.kernels.device import upload
from mi_refgs.kernels.timing import phase
from mi_refgs.surfels.table import gather_rows
from mi_refgs.types import Bool, Float, TensorXf, UInt32

BETA_1, BETA_2 = 0.9, 0.999
EPSILON = 1e-15  # as in 3DGS: tiny, as per-surfel gradients of a pixel mean are about 1e-7
OUTLIER = 100.0  # gradients beyond this many times the usual are cut; see above
WIDE_ROW = 64  # columns beyond which rows are not distinguished: SH have 48, a row of the light hundreds
WORD = 32  # tensors whose bits fit one integer of the marks
MEMORY = 4096  # steps that `report` may come late


@dataclass(frozen=True)
class LearningRate:
    """Rate of one tensor: falls from `rate` to `final` between iterations `begin` and `steps`."""

    rate: float  # per step, units of the raw tensor
    final: float | None = None  # None: constant
    steps: int = 1  # iterations
    head: int = 0  # columns that learn at the rate; 0: all
    tail: float = 1.0  # factor of the rate of the other columns: SH beyond degree 0
    by_row: RowRate | None = None  # of `fitting.row_rates`: which rows learn faster
    unit: float = 1.0  # of the raw tensor; moments are without unit, as ε is
    begin: int = 0  # iteration until which it is `rate`
    linear: bool = False  # falls linearly; else log-linearly

    def at(self, iteration: int) -> float:
        """Learning rate at this iteration (0-based)."""
        if self.final is None or self.rate <= 0 or self.final <= 0:
            return self.rate
        progress = min(max((iteration - self.begin) / max(self.steps - self.begin, 1), 0.0), 1.0)
        if self.linear:
            return (1 - progress) * self.rate + progress * self.final
        return math.exp((1 - progress) * math.log(self.rate) + progress * math.log(self.final))


@dataclass(frozen=True)
class Skipped:
    """Steps that changed nothing since the last report."""

    count: int
    iteration: int  # 0-based, of the last one
    rows: dict[str, np.ndarray]  # rows whose gradient was not finite, by tensor; absent where there was none


class Skips:
    """Finds the steps that must change nothing; `params` and `groups` are those of the optimiser."""

    def __init__(self, params: Mapping[str, TensorXf], groups: Mapping[str, LearningRate]) -> None:
        self._params, self._groups = params, groups
        # By number of rows and word w, (rows,): bit b where a gradient of group WORD w + b was not finite.
        self.marks: dict[tuple[int, int], UInt32] = {}
        self._calls, self._iteration = 0, 0  # number and iteration of the last step
        self._reported = 0  # number of the last step that was reported
        # At the number of a step modulo MEMORY: that number, if the step was skipped.
        self._skipped = dr.opaque(mi.UInt32, 0, MEMORY)

    def good(self, gradients: Mapping[str, Float], iteration: int, loss: Float) -> Bool:
        """Whether the step may be applied (width 1), by its gradients (N * D,) and its loss (width 1)."""
        self._calls, self._iteration = self._calls + 1, iteration
        number, place = dr.opaque(mi.UInt32, self._calls), dr.opaque(mi.UInt32, self._calls % MEMORY)
        for skip in self._not_finite(gradients):
            if loss is not None:
                skip |= ~dr.isfinite(loss)
            dr.scatter(self._skipped, number, place, skip)  # almost never active, so it costs nothing
        dr.eval(self._skipped, self.marks)
        good = dr.gather(mi.UInt32, self._skipped, place) != number
        dr.eval(good)  # once, not for each entry of each tensor
        return good

    def report(self) -> Skipped:
        """The steps that were skipped since the last call; waits for the device."""
        skipped = self._skipped.numpy()
        skipped = skipped[skipped > self._reported]
        rows = {}
        for i, name in enumerate(self._groups if len(skipped) else ()):
            if (marks := self.marks.get((self._marked(name), i // WORD))) is not None:
                rows[name] = np.flatnonzero(marks.numpy() >> np.uint32(i % WORD) & 1)
        last = self._iteration - (self._calls - int(skipped.max(initial=0)))
        self._reported = self._calls
        if len(skipped):
            self.marks.clear()
        return Skipped(len(skipped), last, {name: at for name, at in rows.items() if len(at)})

    def _marked(self, name: str) -> int:
        """Rows of the marks that a tensor shares with others; 1 if its rows are wide."""
        rows, width = int(self._params[name].shape[0]), math.prod(self._params[name].shape[1:])
        return rows if width <= WIDE_ROW else 1

    def _not_finite(self, gradients: Mapping[str, Float]) -> list[Bool]:
        """Masks of what is not finite, by rows or by entries; rows are marked with the bit of each group."""
        by_entry: list[Bool] = []
        by_row: dict[tuple[int, int], UInt32] = {}
        for i, name in enumerate(self._groups):
            if name not in gradients:
                continue
            g, rows, bit = gradients[name], self._marked(name), mi.UInt32(1 << i % WORD)
            key = rows, i // WORD
            self.marks.setdefault(key, dr.opaque(mi.UInt32, 0, rows))
            if rows == 1:
                bad = ~dr.isfinite(g)
                dr.scatter_reduce(dr.ReduceOp.Or, self.marks[key], bit, 0, bad, dr.ReduceMode.Direct)
                by_entry.append(bad)
                continue
            width = dr.width(g) // rows
            first = dr.arange(mi.UInt32, rows) * width
            # The gradient of SH columns beyond the head is that of the head times a bounded function.
            columns = [dr.gather(mi.Float, g, first + c) for c in range(self._groups[name].head or width)]
            found = dr.select(reduce(operator.and_, map(dr.isfinite, columns)), mi.UInt32(0), bit)
            by_row[key] = by_row.get(key, mi.UInt32(0)) | found
        for key, found in by_row.items():
            self.marks[key] |= found
        return by_entry + [found != 0 for found in by_row.values()]


class Adam:
    """Adam over the tensors in `params` that have a group; others are left alone. Each step reads `dr.grad`
    of the tensors and replaces them by new leaves; a second one of the same kind compiles nothing."""

    def __init__(
        self, params: MutableMapping[str, TensorXf], groups: Mapping[str, LearningRate | float]
    ) -> None:
        """Let the tensors named in `groups` learn, at a rate each, raw units per step. `params` is changed in
        place: a dictionary, or `mi.traverse` of a scene, to be updated by its user."""
        self.params = params
        self.groups: dict[str, LearningRate] = {}
        self.factors: dict[str, float] = {}  # of learning rates, by tensor; 0 freezes it
        self.stage: Mapping[str, float] = {}  # factors of the present stage of a fit
        self._first: dict[str, Float] = {}
        self._second: dict[str, Float] = {}
        self._steps: dict[str, int] = {}
        self._usual: dict[str, float] = {}  # median √(v / (1 - β₂ᵗ)); 0: not known yet
        self._least: dict[str, Float] = {}  # the same on the device; infinity: not known yet
        self._skips = Skips(params, self.groups)
        for name, group in groups.items():
            self.add(name, group if isinstance(group, LearningRate) else LearningRate(group))

    def add(self, name: str, group: LearningRate) -> None:
        """Let a parameter learn, without history."""
        self.groups[name], self._steps[name] = group, 0
        self._set_usual(name, 0.0)
        self.reset(name)

    def rate(self, name: str, iteration: int) -> float:
        """Learning rate of a tensor's head columns at this iteration."""
        return self.groups[name].at(iteration) * self.factors.get(name, 1.0) * self.stage.get(name, 1.0)

    def report(self) -> Skipped:
        """The steps that were skipped since the last call; waits for the device."""
        return self._skips.report()

    @phase("optimiser")
    def step(self, iteration: int, loss: Float = None) -> None:
        """Apply one update with the learning rates of this iteration (0-based), then clear the gradients.
        Nothing changes if `loss` (width 1) or a gradient is not finite. Tensors that the loss does not depend
        on are skipped, as in PyTorch: their moments and step count stay."""
        # Gradients, and whether all are finite.
        gradients = {}
        for name in self.groups:
            g = dr.grad(self.params[name]).array
            if dr.width(g) and not (g.state == dr.VarState.Literal and float(g[0]) == 0):
                gradients[name] = g
        good = self._skips.good(gradients, iteration, loss)

        # One update per tensor; those of equal step count share an upload.
        updated: dict[str, tuple[Float, tuple[int, ...]]] = {}
        inverse: dict[int, Float] = {}
        for name, g in gradients.items():
            shape, group = self.params[name].shape, self.groups[name]
            t = self._steps[name] + 1
            if t not in inverse:
                inverse[t] = dr.opaque(mi.Float, 1 / (1 - BETA_2 ** max(t - 1, 1)))
            g = self._cut(name, g, t, inverse[t])
            m = BETA_1 * self._first[name] + (1 - BETA_1) * g
            v = BETA_2 * self._second[name] + (1 - BETA_2) * g * g
            correction = math.sqrt(1 - BETA_2**t) / (1 - BETA_1**t)
            η = dr.opaque(mi.Float, self.rate(name, iteration) * correction)
            if 0 < group.head < shape[-1]:
                column = dr.arange(mi.UInt32, math.prod(shape)) % shape[-1]
                η = η * dr.select(column < group.head, 1.0, group.tail)
            θ = dr.detach(self.params[name].array)
            if group.by_row is not None:
                η = group.by_row(η, self.params, name)
            updated[name] = (dr.select(good, θ - η * m / (dr.sqrt(v) + EPSILON), θ), shape)
            self._first[name] = dr.select(good, m, self._first[name])
            self._second[name] = dr.select(good, v, self._second[name])
            self._steps[name] = t

        # Evaluate all at once, then make new leaves.
        dr.eval(self._first, self._second, [θ for θ, _ in updated.values()])
        for name, (θ, shape) in updated.items():
            self.params[name] = mi.TensorXf(θ, shape=shape)
            self._make_leaf(name)

    def _cut(self, name: str, g: Float, t: int, inverse: Float) -> Float:
        """The gradient of step t, without unit, cut, 0 where not finite; `inverse` is 1 / (1 - β₂ᵗ⁻¹)."""
        if self.groups[name].unit != 1:
            g = g * dr.opaque(mi.Float, self.groups[name].unit)
        if t & (t - 1) == 0:  # at steps 1, 2, 4, …, since it waits for the device
            square = _median(g) ** 2 if t == 1 else _median(self._second[name]) / (1 - BETA_2 ** (t - 1))
            self._set_usual(name, math.sqrt(square))
        usual = dr.maximum(dr.sqrt(self._second[name] * inverse), self._least[name])
        limit = dr.minimum(OUTLIER * usual, RAW_LIMIT)
        return dr.select(dr.isfinite(g), dr.clip(g, -limit, limit), 0.0)

    def _set_usual(self, name: str, usual: float) -> None:
        self._usual[name] = usual
        self._least[name] = dr.opaque(mi.Float, usual or math.inf)

    def gather(
        self,
        parent: UInt32,  # (M,) rows of the present tensors
        names: list[str],
        fresh: Bool,  # (M,) rows that start with zero moments: clones and children
    ) -> None:
        """Let the moments of (N, D) tensors follow their rows, after params[name] was gathered."""
        for name in names:
            if name not in self.groups:
                continue
            width = int(self.params[name].shape[-1])
            for moments in (self._first, self._second):
                old = mi.TensorXf(moments[name], shape=(dr.width(moments[name]) // width, width))
                rows = gather_rows(old, parent).array
                if len(parent):
                    row = dr.arange(mi.UInt32, len(parent) * width) // width
                    rows = dr.select(dr.gather(mi.Bool, mi.Bool(fresh), row), 0.0, rows)
                moments[name] = rows
            dr.eval(self._first[name], self._second[name])
            self._make_leaf(name)
        self._skips.marks.clear()

    def reset(self, name: str) -> None:
        """Zero the moments of one tensor, after params[name] was replaced. Its step count stays, as in 3DGS:
        the next update is up to about 3 η long, not η."""
        size = math.prod(self.params[name].shape)
        for moments in (self._first, self._second):
            # Opaque zeros: a literal would give the first step after a reset a kernel of its own.
            moments[name] = dr.opaque(mi.Float, 0.0, size) if size else mi.Float()
        self._make_leaf(name)

    def state_dict(self) -> dict[str, np.ndarray]:
        """Moments, step counts and rate factors as arrays named '<tensor>/first' and so on."""
        state = {}
        for name in self.groups:
            state[f"{name}/first"] = np.array(self._first[name], dtype=np.float32)
            state[f"{name}/second"] = np.array(self._second[name], dtype=np.float32)
            state[f"{name}/steps"] = np.array(self._steps[name])
            state[f"{name}/factor"] = np.array(self.factors.get(name, 1.0))
            state[f"{name}/usual"] = np.array(self._usual[name])
        return state

    def load_state_dict(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore `state_dict`, bit for bit; a tensor that it lacks has no history."""
        for name in self.groups:
            for part, moments in (("first", self._first), ("second", self._second)):
                if (values := state.get(f"{name}/{part}")) is not None:
                    moments[name] = upload(values)
            self._steps[name] = int(state.get(f"{name}/steps", 0))
            self._set_usual(name, float(state.get(f"{name}/usual", 0.0)))
            self.factors[name] = float(state.get(f"{name}/factor", 1.0))

    def _make_leaf(self, name: str) -> None:
        self.params[name] = dr.detach(self.params[name])
        dr.enable_grad(self.params[name])


def _median(values: Float) -> float:
    """Median |x| of the finite entries that are not 0, of about 10,000; 0 if there are none."""
    x = np.abs(values.numpy()[:: max(dr.width(values) // 10_000, 1)])
    x = x[(x > 0) & np.isfinite(x)]
    return float(np.median(x)) if len(x) else 0.0
