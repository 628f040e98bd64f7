"""Presets: how much time a fit of any method gets, and its schedule for another number of iterations."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from mi_refgs.methods.window import ITERATIONS, Window


@dataclass(frozen=True)
class Preset:
    """How long to run, and how large to grow."""

    iterations: int
    surfels: int
    max_surfels: int
    # Of a picture; larger ones are read smaller where methods are compared, or nothing is promised.
    pixels: int
    minutes: float | None = None  # that a fit takes at most, on two cores; larger pictures are read smaller


# About 4 and 11 minutes for 200² pictures on one AVX-512 core; the last follows from these. A step of 256²
# pixels takes 1.14 times as long as one of 200², one of 400² 1.9 times; the paper's pictures have 800².
PRESETS = {
    "quick": Preset(2_000, 15_000, 20_000, 256 * 256, 5.0),
    "standard": Preset(4_000, 25_000, 40_000, 256 * 256, 30.0),
    "paper": Preset(50_000, 30_000, 100_000, 800 * 800),
}


def scaled(value: Any, factor: float) -> Any:
    """Scale windows exactly, and fields whose metadata is ITERATIONS to whole numbers of at least 1."""
    if isinstance(value, dict):
        return {name: scaled(inner, factor) for name, inner in value.items()}
    if isinstance(value, tuple):
        return tuple(scaled(inner, factor) for inner in value)
    if isinstance(value, Window):
        return Window(factor * value.start, factor * value.until, factor * value.every)
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    fields = {}
    for field in dataclasses.fields(value):
        inner = getattr(value, field.name)
        if field.metadata != ITERATIONS:
            fields[field.name] = scaled(inner, factor)
        elif inner > 0:
            fields[field.name] = max(round(inner * factor), 1)
    return dataclasses.replace(value, **fields)
