"""By which keys two methods differ."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any

from mi_refgs.methods.method import About, Method


def differences(before: Method, now: Method) -> dict[str, tuple[Any, Any]]:
    """Dotted keys by which two resolved methods differ, each with both values, None for no such key.

    What a method is called, where its file lies and how its changes were written makes no difference.
    """
    first, second = (
        _flat(replace(method, about=About(), file="", assignments=())) for method in (before, now)
    )
    keys = sorted(first.keys() | second.keys())
    return {key: (first.get(key), second.get(key)) for key in keys if first.get(key) != second.get(key)}


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Dotted keys → leaves of nested dataclasses and dictionaries."""
    if is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if not isinstance(value, dict):
        return {prefix: value}
    flat: dict[str, Any] = {}
    for name, inner in value.items():
        flat |= _flat(inner, f"{prefix}.{name}" if prefix else name)
    return flat
