"""Reflectance models, one file each; importing this package registers those that ship."""

from mi_refgs.shade.reflectance import gaussian_shader, mirror, monte_carlo, radiance, split_sum
from mi_refgs.shade.reflectance.model import MODELS, Reflectance, SurfelView, TraceContext

register, unregister = MODELS.register, MODELS.unregister

for _model in (
    split_sum.SplitSum(),
    radiance.Radiance(),
    mirror.Mirror(),
    gaussian_shader.GaussianShader(),
    monte_carlo.MonteCarlo(),
    radiance.Displayed(),
):
    register(_model)

__all__ = ["MODELS", "Reflectance", "SurfelView", "TraceContext", "register", "unregister"]
