"""Metadata of settings, declared at their fields: `field(default=0.25, metadata=at_least(0))`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from mi_refgs.errors import InputError

Metadata = dict[str, Any]
"""Of a field. "allowed": a test of values that are not None, and a text that completes "give …"."""


def at_least(low: float) -> Metadata:
    """Metadata of a finite number that is at least `low`."""
    return {"allowed": (lambda value: low <= value < math.inf, f"{low:,} or more")}


def more_than(low: float) -> Metadata:
    """Metadata of a finite number above `low`."""
    return {"allowed": (lambda value: low < value < math.inf, f"more than {low:g}")}


def between(low: float, high: float) -> Metadata:
    """Metadata of a number from `low` to `high`, both included."""
    return {"allowed": (lambda value: low <= value <= high, f"a number from {low:g} to {high:g}")}


def require_allowed(value: Any, metadata: Mapping[str, Any], key: str) -> None:
    """Raise InputError for a value that its field does not allow; those of dicts and tuples one by one."""
    if "allowed" not in metadata or value is None:
        return
    allows, wanted = metadata["allowed"]
    values = value.values() if isinstance(value, dict) else value if isinstance(value, tuple) else [value]
    for one in values:
        if not allows(one):
            raise InputError(f"{one} is out of range", field=key, remedy=f"give {wanted}")
