"""Ranges of settings, declared at their fields: `field(default=0.25, metadata=at_least(0))`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

from mi_refgs.errors import InputError

Metadata = dict[str, Any]  # of a dataclass's field


@dataclass(frozen=True)
class Range:
    """Values that a setting may have."""

    allows: Callable[[Any], bool]
    wanted: str  # for messages: "give 0 or more"


def allowed(allows: Callable[[Any], bool], wanted: str) -> Metadata:
    """Metadata of a field whose value must pass a test; None, "not set", always does."""
    return {"range": Range(allows, wanted)}


def at_least(low: float) -> Metadata:
    """Metadata of a finite number that is at least `low`."""
    return allowed(lambda value: low <= value < math.inf, f"{low:,} or more")


def more_than(low: float) -> Metadata:
    """Metadata of a finite number above `low`."""
    return allowed(lambda value: low < value < math.inf, f"more than {low:g}")


def between(low: float, high: float) -> Metadata:
    """Metadata of a number from `low` to `high`, both included."""
    return allowed(lambda value: low <= value <= high, f"a number from {low:g} to {high:g}")


def inside(low: float, high: float) -> Metadata:
    """Metadata of a number between `low` and `high`, both excluded."""
    return allowed(lambda value: low < value < high, f"a number between {low:g} and {high:g}")


def require_in_range(settings: Any, where: str) -> None:
    """Raise InputError for a field of a dataclass whose value is out of its range.

    The values of a dictionary or a tuple are tested one by one.
    """
    for field in fields(settings):
        limit, value = field.metadata.get("range"), getattr(settings, field.name)
        if limit is None or value is None:
            continue
        values = value.values() if isinstance(value, dict) else value if isinstance(value, tuple) else [value]
        for one in values:
            if not limit.allows(one):
                raise InputError(f"{where}: {field.name}: {one} is out of range; give {limit.wanted}")
