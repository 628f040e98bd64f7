"""A method as data: what the TOML files of `variants/` say, read strictly, scaled to a preset."""

from mi_refgs.methods.difference import differences
from mi_refgs.methods.method import LightOptions, Method, Refine, Stage, SurfelOptions
from mi_refgs.methods.presets import PRESETS
from mi_refgs.methods.read import assignments, dump, for_purpose, load, load_resolved, names
from mi_refgs.methods.weights import LossWeights
from mi_refgs.methods.window import Window

__all__ = [
    "PRESETS",
    "LightOptions",
    "LossWeights",
    "Method",
    "Refine",
    "Stage",
    "SurfelOptions",
    "Window",
    "assignments",
    "differences",
    "dump",
    "for_purpose",
    "load",
    "load_resolved",
    "names",
]
