"""Functions of arrays, applied to sequences, dictionaries and dataclasses of arrays."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any

import drjit as dr

from mi_refgs.types import Arrays


def mapped(function: Callable[..., Any], *trees: Arrays) -> Arrays:
    """Apply a function to corresponding arrays of trees; None and flags stay."""
    first = trees[0]
    if first is None or isinstance(first, bool):
        return first
    if isinstance(first, dict):
        return {name: mapped(function, *(tree[name] for tree in trees)) for name in first}
    if isinstance(first, list | tuple):
        return type(first)(mapped(function, *parts) for parts in zip(*trees, strict=True))
    if is_dataclass(first) and not isinstance(first, type):
        values = {field.name: [getattr(tree, field.name) for tree in trees] for field in fields(first)}
        return replace(first, **{name: mapped(function, *several) for name, several in values.items()})
    if dr.depth_v(first) > 1:
        return type(first)(*(mapped(function, *parts) for parts in zip(*trees, strict=True)))
    return function(*trees)
