"""Methods as data: the TOML files of `variants/`, read strictly and scaled to a preset."""

from mi_refgs.methods.method import LightOptions, LossWeight, Method, Refine, Stage, SurfelOptions
from mi_refgs.methods.read import (
    PRESETS,
    assignments,
    differences,
    dump,
    for_purpose,
    load,
    load_resolved,
    names,
    preset_of,
    with_components,
)
from mi_refgs.methods.window import Window

__all__ = [
    "PRESETS",
    "LightOptions",
    "LossWeight",
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
    "preset_of",
    "with_components",
]
