"""Plain data, as TOML has it, to frozen dataclasses and back, strictly by their type hints."""

from __future__ import annotations

import dataclasses
import types
import typing
from dataclasses import MISSING
from typing import Any, Literal

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.errors import InputError, abbreviated
from mi_refgs.methods.ranges import require_in_range
from mi_refgs.methods.window import ITERATIONS, Window
from mi_refgs.shade.options import NOT_A_SETTING

FLAT = {"flat": True}  # metadata of a dataclass's field that is one too, with keys in the same table


def settings(kind: Any) -> dict[str, Any]:
    """Keys of a dataclass in a file, with their types; those of FLAT fields are keys of the same table."""
    hints = typing.get_type_hints(kind)
    found: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        if field.metadata == FLAT:
            found |= settings(hints[field.name])
        elif field.metadata != NOT_A_SETTING:
            found[field.name] = hints[field.name]
    return found


def build(kind: Any, value: Any, where: str) -> Any:
    """Convert plain TOML data to `kind`; raises InputError that begins with `where`, a file and a key."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _build_dataclass(kind, value, where)
    if origin in (types.UnionType, typing.Union):
        return build(next(option for option in arguments if option is not type(None)), value, where)
    if origin is dict:
        if not isinstance(value, dict):
            raise InputError(f"{where}: expected a table, found {abbreviated(value)}; write it as [name]")
        return {key: build(arguments[1], inner, f"{where}.{key}") for key, inner in value.items()}
    if origin is tuple:
        if not isinstance(value, list):
            raise InputError(f"{where}: expected a list, found {abbreviated(value)}; write it in brackets")
        return tuple(build(arguments[0], inner, where) for inner in value)
    if origin is Literal:
        if not isinstance(value, str) or value not in arguments:
            known = ", ".join(map(str, arguments))
            raise InputError(f"{where}: {abbreviated(value)} is not allowed; use one of {known}")
        return value
    if kind is Any:
        return value
    if type(value) in (int, float) and not abs(value) <= MAX_NUMBER:
        raise InputError(f"{where}: {abbreviated(value)} is out of range; correct the value")
    if kind is float and type(value) is int:
        return float(value)
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise InputError(f"{where}: expected {kind.__name__}, found {abbreviated(value)}; correct the value")
    return value


def _build_dataclass(kind: Any, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        found = f"expected a table, found {abbreviated(value)}"
        raise InputError(f"{where}: {found}; the files of variants/ show the form")
    known, hints = settings(kind), typing.get_type_hints(kind)
    for key in value:
        if key not in known:
            raise InputError(f"{where}: unknown key '{key}'; use one of {', '.join(known)}")
    for field in dataclasses.fields(kind):
        if field.default is field.default_factory is MISSING and field.name not in value:
            raise InputError(f"{where}: missing key '{field.name}'; add it")
    built = {key: build(known[key], inner, f"{where}: {key}") for key, inner in value.items()}
    try:
        for field in dataclasses.fields(kind):
            if field.metadata == FLAT:
                inner = hints[field.name]
                built[field.name] = inner(**{key: built.pop(key) for key in settings(inner) if key in built})
        made = kind(**built)
    except (InputError, ValueError) as error:
        raise InputError(f"{where}: {error}") from error
    require_in_range(made, where)
    return made


def plain(value: Any) -> Any:
    """What `build` reads back: dictionaries, lists and values, without those that are None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        found: dict[str, Any] = {}
        for field in dataclasses.fields(value):
            inner = plain(getattr(value, field.name))
            if field.metadata == FLAT:
                found |= inner
            elif field.metadata != NOT_A_SETTING and inner is not None:
                found[field.name] = inner
        return found
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items()}
    return [plain(inner) for inner in value] if isinstance(value, tuple) else value


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
        if not ITERATIONS.items() <= field.metadata.items():
            fields[field.name] = scaled(inner, factor)
        elif inner is not None and inner > 0:
            fields[field.name] = max(round(inner * factor), 1)
    return dataclasses.replace(value, **fields)
