"""Adam over named tensors: rates per group and column, moments that follow the parent index, exact resume.

Letters: θ parameter, g gradient, m v first and second moment, t step count of a tensor, η learning rate.
    m ← β₁ m + (1 - β₁) g,   v ← β₂ v + (1 - β₂) g²,   θ ← θ - η √(1 - β₂ᵗ) / (1 - β₁ᵗ) · m / (√v + ε)
[Kingma and Ba 2015, §2, the efficient order].

Two guards. A step whose loss or gradient has a NaN or an infinity changes nothing (`fitting.skips`). And |g|
is cut to OUTLIER times what is usual for the entry, √(v / (1 - β₂ᵗ)), or for half of its tensor, whichever is
more, and to RAW_LIMIT, whose square float32 holds. A step is at most (1 - β₁) / √(1 - β₂) = 3.2
η long however large g is, so the cut shortens the one in hand by less than 5 %. What it bounds is the memory
of v: after one gradient of 10¹⁰, an entry of usual gradients 10⁻⁷ would not move for 2 ln(10¹⁷ √(1 - β₂)) /
(1 - β₂) = 71,000 steps; cut, it moves 3.3 times slower, or ten times if it happens in the first hundred
steps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.constants import RAW_LIMIT
from mi_refgs.errors import InputError
from mi_refgs.fitting.rates import Group
from mi_refgs.fitting.skips import Skipped, Skips
from mi_refgs.kernels.device import upload
from mi_refgs.kernels.timing import phase
from mi_refgs.surfels.table import gather_rows

# Adam's decay rates and the ε that 3DGS uses: tiny, as per-surfel gradients of a pixel mean are about 1e-7.
BETA_1 = 0.9
BETA_2 = 0.999
EPSILON = 1e-15
OUTLIER = 100.0
"""Gradients beyond this many times the usual are cut; see above."""

SAMPLES = 10_000
"""Entries that a median is taken of."""


class Adam:
    """Adam over `params`, a mutable mapping of name to tensor that it updates in place (new entries).

    Each step reads `dr.grad` of the tensors, replaces them by fresh leaves, and leaves names without a group
    alone. Everything that changes from step to step is opaque, so a second step of the same kind compiles
    nothing; one kernel is launched per distinct tensor size.
    """

    def __init__(self, params: MutableMapping[str, Any], groups: Mapping[str, Group]) -> None:
        """Own the moments of params[name] for every name in groups; raises InputError for a group without
        one."""
        for name in groups:
            if name not in params:
                raise InputError(
                    f"optimiser: {name}: a learning rate without a parameter; use one of {', '.join(params)}"
                )
        self.params = params
        self.groups = dict(groups)
        self.factors: dict[str, float] = {}
        self.stage: Mapping[str, float] = {}  # factors of the present stage of a fit
        self._first: dict[str, Any] = {}
        self._second: dict[str, Any] = {}
        self._steps: dict[str, int] = {}
        self._usual: dict[str, float] = {}  # median √(v / (1 - β₂ᵗ)); 0: not known yet
        self._least: dict[str, Any] = {}  # the same on the device; infinity: not known yet
        self._skips = Skips(params, self.groups)
        for name in groups:
            self._clear(name)
            self._steps[name] = 0
            self._set_usual(name, 0.0)
            self._make_leaf(name)

    def set_factor(self, name: str, factor: float) -> None:
        """Scale the learning rate of one tensor until further notice; 0 freezes it."""
        self.factors[name] = factor

    def rate(self, name: str, iteration: int) -> float:
        """Learning rate of a tensor's head columns at this iteration."""
        return self.groups[name].at(iteration) * self.factors.get(name, 1.0) * self.stage.get(name, 1.0)

    def report(self) -> Skipped:
        """The steps that were skipped since the last call; waits for the device, so not for every step."""
        return self._skips.report()

    @phase("optimiser")
    def step(self, iteration: int, loss: Any = None) -> None:
        """Apply one update with the learning rates of this iteration (0-based), then clear the gradients.

        Nothing changes if `loss` (a mi.Float) or a gradient is not finite. Tensors that the loss does not
        depend on are skipped, as in PyTorch: their moments and step count stay.
        """
        gradients = {}
        for name in self.groups:
            g = dr.grad(self.params[name]).array
            if dr.width(g) and not (g.state == dr.VarState.Literal and float(g[0]) == 0):
                gradients[name] = g
        good = self._skips.good(gradients, iteration, loss)

        updated: dict[str, tuple[Any, Any]] = {}
        inverse: dict[int, Any] = {}  # by step count, which tensors share: each number costs time to send
        for name, g in gradients.items():
            shape, group = tuple(int(size) for size in self.params[name].shape), self.groups[name]
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
            if group.relative:
                η = η * dr.maximum(θ, 1)
            updated[name] = (dr.select(good, θ - η * m / (dr.sqrt(v) + EPSILON), θ), shape)
            self._first[name] = dr.select(good, m, self._first[name])
            self._second[name] = dr.select(good, v, self._second[name])
            self._steps[name] = t
        dr.eval(self._first, self._second, [θ for θ, _ in updated.values()])
        for name, (θ, shape) in updated.items():
            self.params[name] = mi.TensorXf(θ, shape=shape)
            self._make_leaf(name)

    def _cut(self, name: str, g: Any, t: int, inverse: Any) -> Any:
        """The gradient of step t, without unit, cut where it is far beyond the usual, 0 where not finite.

        `inverse` is 1 / (1 - β₂ᵗ⁻¹), of the steps so far.
        """
        if self.groups[name].unit != 1:
            g = g * dr.opaque(mi.Float, self.groups[name].unit)
        if t & (t - 1) == 0:  # at steps 1, 2, 4, …, since it waits for the device
            square = _median(g) ** 2 if t == 1 else _median(self._second[name]) / (1 - BETA_2 ** (t - 1))
            self._set_usual(name, math.sqrt(square))
        limit = OUTLIER * dr.maximum(dr.sqrt(self._second[name] * inverse), self._least[name])
        limit = dr.minimum(limit, RAW_LIMIT)
        return dr.select(dr.isfinite(g), dr.clip(g, -limit, limit), 0.0)

    def _set_usual(self, name: str, usual: float) -> None:
        self._usual[name] = usual
        self._least[name] = dr.opaque(mi.Float, usual or math.inf)

    def gather(self, parent: Any, names: list[str], fresh: Any | None = None) -> None:
        """Let the moments of (N, D) tensors follow their rows: row i takes those of row parent[i].

        parent is an mi.UInt32. Call it together with replacing params[name] by the gathered tensor
        (`Surfels.gather`). Rows where `fresh` (mi.Bool) holds start with zero moments: clones and children
        have no history. Step counts stay.
        """
        for name in names:
            if name not in self.groups:
                continue
            width = int(self.params[name].shape[-1])
            for moments in (self._first, self._second):
                old = mi.TensorXf(moments[name], shape=(dr.width(moments[name]) // width, width))
                rows = gather_rows(old, parent).array
                if fresh is not None and len(parent):
                    row = dr.arange(mi.UInt32, len(parent) * width) // width
                    rows = dr.select(dr.gather(mi.Bool, mi.Bool(fresh), row), 0.0, rows)
                moments[name] = rows
            dr.eval(self._first[name], self._second[name])
            self._make_leaf(name)
        self._skips.forget_rows()

    def reset(self, name: str) -> None:
        """Zero the moments of one tensor; its step count stays.

        Keeping the count is what 3DGS does: the next update is up to about 3 η long, not η. Call it after
        replacing params[name].
        """
        self._clear(name)
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

    @staticmethod
    def fresh_state(name: str, size: int) -> dict[str, np.ndarray]:
        """What `state_dict` has of a tensor of so many numbers before its first step."""
        zeros = np.zeros(size, np.float32)
        parts = {"first": zeros, "second": zeros, "steps": 0, "factor": 1.0, "usual": 0.0}
        return {f"{name}/{part}": np.array(value) for part, value in parts.items()}

    def load_state_dict(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore `state_dict`, bit for bit; raises InputError when it does not fit the tensors."""
        for name in self.groups:
            size = math.prod(int(extent) for extent in self.params[name].shape)
            for part, moments in (("first", self._first), ("second", self._second)):
                values = state.get(f"{name}/{part}")
                if values is None or values.size != size:
                    found = "nothing" if values is None else f"{values.size} values"
                    raise InputError(
                        f"checkpoint: {name}/{part}: found {found}, expected {size}; resume its own run"
                    )
                moments[name] = upload(values)
            self._steps[name] = int(state[f"{name}/steps"])
            self._set_usual(name, float(state[f"{name}/usual"]))
            factor = float(state[f"{name}/factor"])
            self.factors.pop(name, None)
            if factor != 1.0:
                self.factors[name] = factor

    def _clear(self, name: str) -> None:
        size = math.prod(int(extent) for extent in self.params[name].shape)
        # Opaque zeros: a literal would give the first step after a reset a kernel of its own.
        self._first[name] = dr.opaque(mi.Float, 0.0, size) if size else mi.Float()
        self._second[name] = dr.opaque(mi.Float, 0.0, size) if size else mi.Float()

    def _make_leaf(self, name: str) -> None:
        tensor = dr.detach(self.params[name])
        dr.enable_grad(tensor)
        self.params[name] = tensor


def _median(values: Any) -> float:
    """Median |x| of the finite entries that are not 0, of at most SAMPLES; 0 if there are none."""
    x = np.abs(values.numpy()[:: max(dr.width(values) // SAMPLES, 1)])
    x = x[(x > 0) & np.isfinite(x)]
    return float(np.median(x)) if len(x) else 0.0
