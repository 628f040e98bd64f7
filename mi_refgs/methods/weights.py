"""The weights of the losses, as a method file has them."""

from __future__ import annotations

from dataclasses import dataclass, field

from mi_refgs.methods.window import ITERATIONS


@dataclass(frozen=True)
class LossWeight:
    """Weight of one loss over the iterations."""

    weight: float
    start: int = field(default=0, metadata=ITERATIONS)  # iterations without the loss
    rise: int = field(default=0, metadata=ITERATIONS)  # then its weight rises linearly from 0
    until: int = field(default=2**31, metadata=ITERATIONS)  # last iteration with the loss

    def at(self, iteration: int) -> float:
        """The weight in this (1-based) iteration."""
        if not self.start < iteration <= self.until:
            return 0.0
        return self.weight * (min((iteration - self.start) / self.rise, 1) if self.rise else 1)


@dataclass(frozen=True)
class LossWeights:
    """L = (1 - ssim) L1 + ssim (1 - SSIM) + normal L_n + smooth L_s + alpha L_α, and priors.

    Those are named as their functions in `fitting.losses`, and say what pictures do not. Priors on maps of
    materials count in stages that shade at pixels: others blend no materials.
    """

    ssim: float = 0.2
    normal: float = 0.05
    normal_start: int = field(default=0, metadata=ITERATIONS)  # iterations before L_n counts
    normal_rise: int = field(default=0, metadata=ITERATIONS)  # then its weight rises linearly from 0
    smooth: float = 0.0
    smooth_until: int = field(default=18_000, metadata=ITERATIONS)
    alpha: float = 0.0
    half_metal: float = 0.0  # metals or dielectrics, not half of each
    half_metal_start: int = field(default=0, metadata=ITERATIONS)  # before, pictures decide
    half_metal_rise: int = field(default=0, metadata=ITERATIONS)  # then this weight rises linearly
    materials: float = 0.0  # neighbours of like colour share roughness and metallic
    light_colour: float = 0.0  # colour belongs to the albedo rather than to the light
    registered: dict[str, LossWeight] = field(default_factory=dict)  # losses of `register_loss`, by name

    def of(self, name: str) -> LossWeight:
        """Weight and window of a loss by its name."""
        if name in self.registered:
            return self.registered[name]
        window = {end: getattr(self, f"{name}_{end}", None) for end in ("start", "rise", "until")}
        return LossWeight(getattr(self, name, 0.0), **{end: x for end, x in window.items() if x is not None})
