"""Everything in a step that depends on the iteration number alone: random draws, learning rates, shared
lights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import drjit as dr
import numpy as np

from mi_refgs.fitting.optim import Group
from mi_refgs.kernels.device import upload
from mi_refgs.methods.method import AROUND, BACKGROUND, LIGHT, Method
from mi_refgs.shade.light.envmap import EnvironmentLight, PrefilteredLight
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import attribute
from mi_refgs.types import Float

POSITION_STEPS = 0.6
"""Fraction of the iterations after which positions learn at their final rate: 30,000 of 50,000 in the
released Ref-Gaussian code."""


@dataclass(frozen=True)
class Schedule:
    """Random draws and learning rates of a fit to `views` images, by (1-based) iteration."""

    method: Method
    views: int

    def rng(self, iteration: int, operation: str) -> np.random.Generator:
        """Generator for one operation, such as "densify", of an iteration; 0 is the initialisation."""
        return np.random.default_rng([self.method.seed, iteration, *operation.encode()])

    def view(self, iteration: int) -> int:
        """Index of the training view: sampling without replacement, a new permutation every epoch."""
        epoch, place = divmod(iteration - 1, self.views)
        return int(np.random.default_rng([self.method.seed, epoch, 1]).permutation(self.views)[place])

    def sh_degree(self, iteration: int) -> int:
        """SH degree of the radiance that is in use."""
        surfels = self.method.surfels
        return min(surfels.sh_raise.count(iteration), surfels.degree_of("radiance_sh"))

    def light_learns(self, iteration: int) -> bool:
        """Whether the light learns from the iterations since it last did; always where a stage ends."""
        light = self.method.light
        ends = [stage.until for _, stage in self.method.stages()]
        return light is not None and (iteration % light.every == 0 or iteration in ends)

    def groups(self, extent: float, open_scene: bool = False) -> dict[str, Group]:
        """Learning rates by parameter; `extent` in scene units; `open_scene`: also of the background."""
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
        """Learning rates of the attributes of one set of surfels."""
        rates, iterations = self.method.rates, self.method.iterations
        groups = {}
        for name in names:
            rate, head = rates.of(name), 3 if attribute(name).harmonics else 0
            groups[name] = Group(rate, rate * rates.decay, iterations, head, rates.rest_of(name))
        start, final = rates.of("position") * extent, rates.position_final * extent
        groups["position"] = Group(start, final, int(POSITION_STEPS * iterations), unit=extent)
        return groups


GATHERED = "light_gradient"  # name of the gradient of the levels in a checkpoint


class SharedPrefilter:
    """The light of a fit, filtered once for several steps, whose gradients it learns from together.

    Filtering a light and its adjoint cost the same for one view as for a hundred: with 128 rows a quarter of
    a step of 200² pixels on one core. `close` ends the steps that share a light, and passes on their
    gradient.
    """

    def __init__(self) -> None:
        self._light: PrefilteredLight | None = None  # attached to the environment
        self._leaf: Float = None  # its levels, which accumulate the gradients of the steps

    def light(self, environment: EnvironmentLight | None, shading: Shading) -> Light | None:
        """The light of a step, under AD; a light that is not filtered stays attached to its environment."""
        if self._light is not None and self._light.operator.roughness == shading.levels.roughness:
            return replace(self._light, levels=self._leaf)
        light = shading.light_of(environment)
        if not isinstance(light, PrefilteredLight):
            return light
        self._light, self._leaf = light, dr.detach(light.levels)
        dr.enable_grad(self._leaf)
        return replace(light, levels=self._leaf)

    def close(self) -> None:
        """Add the accumulated gradient to that of the environment."""
        if self._light is not None:
            dr.set_grad(self._light.levels, dr.grad(self._leaf))
            dr.enqueue(dr.ADMode.Backward, self._light.levels)
            dr.traverse(dr.ADMode.Backward)
        self.clear()

    def clear(self) -> None:
        """Discard the accumulated gradient."""
        self._light = self._leaf = None

    def state(self) -> dict[str, np.ndarray]:
        """The accumulated gradient for a checkpoint; empty if there is none."""
        return {} if self._leaf is None else {GATHERED: np.array(dr.grad(self._leaf), dtype=np.float32)}

    def restore(
        self, environment: EnvironmentLight | None, shading: Shading, state: Mapping[str, np.ndarray]
    ) -> None:
        """Continue from a checkpoint; a gradient of other levels, as in a trial, is left out."""
        self.clear()
        if (gathered := state.get(GATHERED)) is None or environment is None:
            return
        self.light(environment, shading)
        if self._leaf is not None and dr.width(self._leaf) == len(gathered):
            dr.set_grad(self._leaf, upload(gathered))
