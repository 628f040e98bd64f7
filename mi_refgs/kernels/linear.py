"""Linear functions of arrays under AD, by the transposed function."""

from collections.abc import Callable
from typing import Any

import drjit as dr


def linear(value: Any, function: Callable[[Any], Any], transposed: Callable[[Any], Any]) -> Any:
    """A linear function of arrays, whose derivatives are itself and the transposed one: Dr.Jit's own adjoint
    of a gather scatters, in no fixed order and into memory that other terms write to."""
    return dr.custom(_Linear, value, function, transposed)


class _Linear(dr.CustomOp):
    def eval(self, value: Any, function: Callable[[Any], Any], transposed: Callable[[Any], Any]) -> Any:
        self.function, self.transposed = function, transposed
        return function(value)

    def forward(self) -> None:
        self.set_grad_out(self.function(self.grad_in("value")))

    def backward(self) -> None:
        self.set_grad_in("value", self.transposed(self.grad_out()))
