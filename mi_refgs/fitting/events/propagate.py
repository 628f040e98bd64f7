"""Normal propagation: surfels become opaque, and reflective ones grow over their neighbours.

Reflections then follow normals that explain them. [3DGS-DR, Ye et al. 2024, §3.3; Ref-Gaussian §3.4]"""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.extensions import Event, register_event
from mi_refgs.methods.fields import ITERATIONS, Window, at_least, between
from mi_refgs.surfels.attributes import logit, sigmoid
from mi_refgs.surfels.primitives.primitive import primitive_of
from mi_refgs.surfels.table import Surfels

OPACITY = 0.9  # all surfels become at least this opaque
SCALE = 1.5  # factor of the scales of reflective surfels
DULL = 0.05  # metallic up to which a surfel's colour gets noise


@register_event
@dataclass(frozen=True)
class Propagate(Event[Trainer]):
    """Enlarges the reflective surfels of the object; noise keeps the colour of others from reflections."""

    name: ClassVar[str] = "propagate"
    attributes: ClassVar[tuple[str, ...]] = ("metallic",)
    when: Window  # iterations at which it happens
    metallic: float = field(default=0.02, metadata=between(0, 1))  # reflective: at least this metallic …
    roughness: float | None = None  # … and at most this rough; absent: any roughness
    noise: float = field(default=0.0, metadata=at_least(0))  # half its width, in SH coefficients
    hold: int = field(default=200, metadata=ITERATIONS)  # iterations without opacity learning afterwards

    def due(self, trainer: Trainer) -> bool:
        held = trainer.fit.optimiser.factors.get("opacity", 1.0) == 0
        return self._grows(trainer) or (held and trainer.iteration >= trainer.fit.held_until)

    def apply(self, trainer: Trainer) -> None:
        fit = trainer.fit
        if self._grows(trainer):
            edited = self.propagated(trainer.surfels, trainer.setup.rng(fit.iteration, "propagate"))
            colour = ("radiance_sh",) if self.noise else ()
            fit.tables[0].replace(edited, cleared=("opacity", *edited.primitive.sizes, *colour))
            fit.optimiser.factors["opacity"] = 0.0
            fit.held_until = fit.iteration + self.hold
        if fit.iteration >= fit.held_until:
            fit.optimiser.factors["opacity"] = 1.0

    def _grows(self, trainer: Trainer) -> bool:
        reset = trainer.method.event.get("reset_opacity")
        # One that comes first in this iteration would be undone.
        return self.when.due(trainer.iteration) and not (reset is not None and reset.due(trainer))

    def propagated(self, surfels: Surfels, rng: np.random.Generator) -> Surfels:
        """The enlarged surfels."""
        raw = surfels.to_numpy()
        raw["opacity"] = np.maximum(raw["opacity"], np.float32(logit(OPACITY)))
        metallic = sigmoid(raw["metallic"][:, 0])
        reflective = metallic >= self.metallic
        if self.roughness is not None and "roughness" in raw:
            reflective &= sigmoid(raw["roughness"][:, 0]) <= self.roughness
        primitive_of(raw).resize(raw, reflective, SCALE)
        if self.noise and "radiance_sh" in raw:
            dull = np.flatnonzero(metallic <= DULL)
            noise = rng.uniform(-self.noise, self.noise, (len(dull), 3))
            raw["radiance_sh"][dull, :3] += noise.astype(np.float32)
        return Surfels.from_numpy(raw)
