"""The weights of the losses, as a method file has them."""

from __future__ import annotations

from dataclasses import dataclass, field

from mi_refgs.methods.window import ITERATIONS


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

    @property
    def uses_maps(self) -> bool:
        """Whether a loss looks at the blended materials."""
        return self.half_metal > 0 or self.materials > 0

    @property
    def uses_normals(self) -> bool:
        """Whether a loss looks at the blended normals."""
        return self.normal > 0 or self.smooth > 0
