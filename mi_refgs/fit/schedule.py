"""What a step takes from its iteration number alone, so that a resumed fit goes on as a straight one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mi_refgs.fit.optim import Group
from mi_refgs.methods.config import Method
from mi_refgs.runs.checkpoint import LIGHT

POSITION_STEPS = 0.6
"""Share of the iterations after which positions learn at their final rate: 30,000 of 50,000 in the released
Ref-Gaussian code."""


@dataclass(frozen=True)
class Schedule:
    """The draws and rates of a fit to `views` pictures, by (1-based) iteration."""

    method: Method
    views: int

    def rng(self, iteration: int) -> np.random.Generator:
        """Random numbers of an iteration; 0 is the initialisation."""
        return np.random.default_rng([self.method.seed, iteration])

    def view(self, iteration: int) -> int:
        """Index of the picture: sampling without replacement, a fresh permutation every epoch."""
        epoch, place = divmod(iteration - 1, self.views)
        return int(np.random.default_rng([self.method.seed, epoch, 1]).permutation(self.views)[place])

    def sh_degree(self, iteration: int) -> int:
        """Degree of the radiance channel that is in use."""
        return min(self.method.surfels.sh_raise.count(iteration), self.method.surfels.sh_degree)

    def groups(self, extent: float) -> dict[str, Group]:
        """Learning rates of every parameter that a method may have; `extent` in scene units."""
        rates, iterations = self.method.rates, self.method.iterations

        def group(rate: float, tail: float | None = None) -> Group:
            final = rate * rates.decay
            if tail is None:
                return Group(rate, final, iterations)
            return Group(rate, final, iterations, head=3, tail=tail)

        steps = int(POSITION_STEPS * iterations)
        return {
            "position": Group(rates.position * extent, rates.position_final * extent, steps, unit=extent),
            "rotation": group(rates.rotation),
            "scale": group(rates.scale),
            "opacity": group(rates.opacity),
            "radiance_sh": group(rates.radiance_sh, rates.sh_rest),
            "albedo": group(rates.albedo),
            "metallic": group(rates.metallic),
            "roughness": group(rates.roughness),
            "indirect_sh": group(rates.indirect_sh, rates.indirect_rest),
            LIGHT: group(rates.light),
        }
