"""Methods as data: the TOML files of `variants/`, read strictly and scaled to a preset."""

from mi_refgs.methods.build import plain
from mi_refgs.methods.method import LossWeight, Method, Stage, SurfelOptions
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
)
from mi_refgs.methods.window import Window

__all__ = [
    "PRESETS",
    "LossWeight",
    "Method",
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
    "plain",
    "preset_of",
]
