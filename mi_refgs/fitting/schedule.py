"""What a step takes from its iteration number alone, so that a resumed fit goes on as a straight one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from mi_refgs.fitting.optim import Group
from mi_refgs.kernels.device import upload
from mi_refgs.methods.method import AROUND, BACKGROUND, LIGHT, Method
from mi_refgs.shade.light.envmap import EnvironmentLight, PrefilteredLight
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import attribute

POSITION_STEPS = 0.6
"""Share of the iterations after which positions learn at their final rate: 30,000 of 50,000 in the released
Ref-Gaussian code."""


@dataclass(frozen=True)
class Schedule:
    """The draws and rates of a fit to `views` pictures, by (1-based) iteration."""

    method: Method
    views: int

    def rng(self, iteration: int, operation: str) -> np.random.Generator:
        """Random numbers of one operation of an iteration, such as "densify"; 0 is the initialisation."""
        return np.random.default_rng([self.method.seed, iteration, *operation.encode()])

    def view(self, iteration: int) -> int:
        """Index of the picture: sampling without replacement, a fresh permutation every epoch."""
        epoch, place = divmod(iteration - 1, self.views)
        return int(np.random.default_rng([self.method.seed, epoch, 1]).permutation(self.views)[place])

    def sh_degree(self, iteration: int) -> int:
        """Degree of the radiance channel that is in use."""
        return min(
            self.method.surfels.sh_raise.count(iteration), self.method.surfels.degree_of("radiance_sh")
        )

    def light_learns(self, iteration: int) -> bool:
        """Whether the light learns from the iterations since it last did; always where a stage ends."""
        light = self.method.light
        ends = [stage.until for _, stage in self.method.stages()]
        return light is not None and (iteration % light.every == 0 or iteration in ends)

    def groups(self, extent: float, open_scene: bool = False) -> dict[str, Group]:
        """Learning rates of every parameter of the method; `extent` in scene units.

        `open_scene`: with those of the surroundings, whose positions have an extent of their own.
        """
        rates, iterations = self.method.rates, self.method.iterations
        groups = self._of_table(self.method.surfels.names, extent)
        around = self.method.surroundings
        if open_scene and around is not None:
            table = self._of_table(around.names(self.method.surfels.primitive), around.reach * extent)
            groups |= {AROUND + name: group for name, group in table.items()}
            groups[BACKGROUND] = Group(around.rate, around.rate * rates.decay, iterations)
        if self.method.light is not None:
            texels = rates.light, rates.light * rates.decay, iterations
            groups[LIGHT] = Group(*texels, relative=rates.light_relative)
        return groups

    def _of_table(self, names: tuple[str, ...], extent: float) -> dict[str, Group]:
        """Learning rates of the channels of one table."""
        rates, iterations = self.method.rates, self.method.iterations
        groups = {}
        for name in names:
            rate = rates.of(name)
            head = 3 if attribute(name).harmonics else 0
            groups[name] = Group(rate, rate * rates.decay, iterations, head, rates.rest_of(name))
        steps = int(POSITION_STEPS * iterations)
        start, final = rates.of("position") * extent, rates.position_final * extent
        groups["position"] = Group(start, final, steps, unit=extent)
        return groups


GATHERED = "light_gradient"
"""Name of the gradient of the levels in a checkpoint."""


class SharedPrefilter:
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
