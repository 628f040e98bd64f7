"""Reflectance models, one file each; importing this package registers those that ship."""

from mi_refgs.shade.reflectance import displayed, gaussian_shader, mirror, monte_carlo, radiance, split_sum
from mi_refgs.shade.reflectance.model import (
    MODELS,
    Reflectance,
    SurfelView,
    TraceContext,
    register,
    unregister,
)

register(split_sum.SplitSum())
register(radiance.Radiance())
register(mirror.Mirror())
register(gaussian_shader.GaussianShader())
register(monte_carlo.MonteCarlo())
register(displayed.Displayed())

__all__ = ["MODELS", "Reflectance", "SurfelView", "TraceContext", "register", "unregister"]
