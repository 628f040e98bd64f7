"""Reflectance models, one file each; importing this package registers those that ship."""

from mi_refgs.shade.reflectance import radiance, split_sum
from mi_refgs.shade.reflectance.model import (
    MODELS,
    Reflectance,
    SurfelView,
    Surroundings,
    register,
    unregister,
)

register(split_sum.SplitSum())
register(radiance.Radiance())

__all__ = ["MODELS", "Reflectance", "SurfelView", "Surroundings", "register", "unregister"]
