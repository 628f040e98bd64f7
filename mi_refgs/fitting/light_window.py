"""The light of a fit, filtered once for several steps, whose gradients it learns from together.

Filtering a light and its adjoint cost the same for one view as for a hundred: with 128 rows a quarter of a
step of 200² pixels on one core.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np

from mi_refgs.kernels.device import upload
from mi_refgs.shade.light.envmap import EnvironmentLight, PrefilteredLight
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.shading import Shading

GATHERED = "light_gradient"
"""Name of the gradient of the levels in a checkpoint."""


class LightWindow:
    """Steps that share the levels of one filtered light; `close` ends them, and passes on their gradient."""

    def __init__(self) -> None:
        self._light: PrefilteredLight | None = None  # under AD, as the environment's levels
        self._leaf: Any = None  # its levels, where the steps leave their gradients

    def light(self, environment: EnvironmentLight | None, shading: Shading) -> Light | None:
        """The light of a step, under AD; one that is not filtered stays attached to its environment."""
        if self._light is not None and self._light.operator.roughness == shading.levels.roughness:
            return replace(self._light, levels=self._leaf)
        light = shading.light_of(environment)
        if not isinstance(light, PrefilteredLight):
            return light
        self._light, self._leaf = light, dr.detach(light.levels)
        dr.enable_grad(self._leaf)
        return replace(light, levels=self._leaf)

    def close(self) -> None:
        """Add what the steps have gathered to the gradient of the environment that they began with."""
        if self._light is not None:
            dr.set_grad(self._light.levels, dr.grad(self._leaf))
            dr.enqueue(dr.ADMode.Backward, self._light.levels)
            dr.traverse(dr.ADMode.Backward)
        self.clear()

    def clear(self) -> None:
        """Forget what was gathered."""
        self._light = self._leaf = None

    def state(self) -> dict[str, np.ndarray]:
        """The gradient of the levels so far, for a checkpoint; empty if no step has left one."""
        return {} if self._leaf is None else {GATHERED: np.array(dr.grad(self._leaf), dtype=np.float32)}

    def restore(
        self, environment: EnvironmentLight | None, shading: Shading, state: Mapping[str, np.ndarray]
    ) -> None:
        """Go on where `state` was taken; a gradient of other levels, as in a trial, is left out."""
        self.clear()
        gathered = state.get(GATHERED)
        if gathered is None or environment is None:
            return
        self.light(environment, shading)
        if self._leaf is not None and dr.width(self._leaf) == len(gathered):
            dr.set_grad(self._leaf, upload(gathered))
