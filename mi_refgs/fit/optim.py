"""Adam over named tensors: rates per group and column, moments that follow the parent index, exact resume.

Letters: θ parameter, g gradient, m v first and second moment, t step count of a tensor, η learning rate.
    m ← β₁ m + (1 - β₁) g,   v ← β₂ v + (1 - β₂) g²,   θ ← θ - η √(1 - β₂ᵗ) / (1 - β₁ᵗ) · m / (√v + ε)
[Kingman and Ba 2015, §2, the efficient order]. A NaN or infinite gradient entry counts as 0 and is reported
by `bad`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.device import upload
from mi_refgs.errors import InputError
from mi_refgs.surfels.table import gather_rows

# Adam's decay rates and the ε that 3DGS uses: tiny, as per-surfel gradients of a pixel mean are about 1e-7.
BETA_1 = 0.9
BETA_2 = 0.999
EPSILON = 1e-15


@dataclass(frozen=True)
class Group:
    """Learning rate of one tensor: from `rate` log-linearly to `final` in `steps` iterations, then constant.

    The first `head` columns learn at the rate, the others at rate · tail (spherical harmonics: head 3, tail
    1/20).
    """

    rate: float  # per step, units of the raw tensor
    final: float | None = None  # None: constant
    steps: int = 1  # iterations
    head: int = 0  # columns; 0: every column
    tail: float = 1.0  # factor
    unit: float = 1.0  # of the raw tensor, to which the moments refer: ε, and what float32 squares, have none

    def at(self, iteration: int) -> float:
        """Learning rate at this iteration (0-based)."""
        if self.final is None or self.rate <= 0 or self.final <= 0:
            return self.rate
        progress = min(max(iteration / max(self.steps, 1), 0.0), 1.0)
        return math.exp((1 - progress) * math.log(self.rate) + progress * math.log(self.final))


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
        self._first: dict[str, Any] = {}
        self._second: dict[str, Any] = {}
        self._steps: dict[str, int] = {}
        self._bad: Any = None
        for name in groups:
            self._clear(name)
            self._steps[name] = 0
            self._make_leaf(name)

    def set_factor(self, name: str, factor: float) -> None:
        """Scale the learning rate of one tensor until further notice; 0 freezes it."""
        self.factors[name] = factor

    def rate(self, name: str, iteration: int) -> float:
        """Learning rate of a tensor's head columns at this iteration."""
        return self.groups[name].at(iteration) * self.factors.get(name, 1.0)

    @property
    def bad(self) -> int:
        """How many gradient entries of the last step were NaN or infinite; waits for the device."""
        return 0 if self._bad is None else int(self._bad[0])

    def step(self, iteration: int) -> None:
        """Apply one update with the learning rates of this iteration (0-based), then clear the gradients.

        A tensor that the loss does not depend on rests, as in PyTorch: its moments and step count stay.
        """
        updated, bad = {}, dr.opaque(mi.UInt32, 0)
        for name, group in self.groups.items():
            tensor = self.params[name]
            shape = tuple(int(size) for size in tensor.shape)
            if math.prod(shape) == 0:
                continue
            g = dr.grad(tensor).array
            if g.state == dr.VarState.Literal and float(g[0]) == 0:
                continue
            self._steps[name] += 1
            finite = dr.isfinite(g)
            # Almost never active, so a direct atomic costs nothing and needs no launch of its own.
            dr.scatter_reduce(dr.ReduceOp.Add, bad, mi.UInt32(1), mi.UInt32(0), ~finite, dr.ReduceMode.Direct)
            g = dr.select(finite, g, 0.0) * dr.opaque(mi.Float, group.unit)
            m = BETA_1 * self._first[name] + (1 - BETA_1) * g
            v = BETA_2 * self._second[name] + (1 - BETA_2) * g * g
            t = self._steps[name]
            correction = math.sqrt(1 - BETA_2**t) / (1 - BETA_1**t)
            η = dr.opaque(mi.Float, self.rate(name, iteration) * correction)
            if 0 < group.head < shape[-1]:
                column = dr.arange(mi.UInt32, math.prod(shape)) % shape[-1]
                η = η * dr.select(column < group.head, 1.0, group.tail)
            θ = dr.detach(tensor.array) - η * m / (dr.sqrt(v) + EPSILON)
            self._first[name], self._second[name] = m, v
            updated[name] = (θ, shape)
        self._bad = bad
        dr.eval(self._first, self._second, [θ for θ, _ in updated.values()], bad)
        for name, (θ, shape) in updated.items():
            self.params[name] = mi.TensorXf(θ, shape=shape)
            self._make_leaf(name)

    def gather(self, parent: Any, names: list[str], fresh: Any | None = None) -> None:
        """Let the moments of (N, D) tensors follow their rows: row i takes those of row parent[i].

        parent is an mi.UInt32. Call it together with replacing params[name] by the gathered tensor
        (`Surfels.gather`). Rows where
        `fresh` (mi.Bool) holds start with zero moments: clones and children have no history. Step counts
        stay.
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

    def reset(self, name: str, rows: Any | None = None) -> None:
        """Zero the moments of one tensor, or of the rows where `rows` (mi.Bool) holds; its step count stays.

        Keeping the count is what 3DGS does: the next update is up to about 3 η long, not η. Call it after
        replacing params[name].
        """
        if rows is None:
            self._clear(name)
        else:
            width = int(self.params[name].shape[-1])
            row = dr.arange(mi.UInt32, dr.width(self._first[name])) // width
            cleared = dr.gather(mi.Bool, mi.Bool(rows), row)
            for moments in (self._first, self._second):
                moments[name] = dr.select(cleared, 0.0, moments[name])
            dr.eval(self._first[name], self._second[name])
        self._make_leaf(name)

    def state_dict(self) -> dict[str, np.ndarray]:
        """Moments, step counts and rate factors as arrays named '<tensor>/first' and so on."""
        state = {}
        for name in self.groups:
            state[f"{name}/first"] = np.array(self._first[name], dtype=np.float32)
            state[f"{name}/second"] = np.array(self._second[name], dtype=np.float32)
            state[f"{name}/steps"] = np.array(self._steps[name])
            state[f"{name}/factor"] = np.array(self.factors.get(name, 1.0))
        return state

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
