"""Plain data, as TOML has it, to frozen dataclasses and back, strictly by their type hints."""

import dataclasses
import types
import typing
from collections.abc import Mapping
from dataclasses import MISSING
from typing import Any, Literal

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.errors import InputError, abbreviated
from mi_refgs.methods.fields import FLAT, ITERATIONS, Window
from mi_refgs.shade.options import NOT_A_SETTING


def settings(kind: Any) -> dict[str, tuple[Any, Mapping[str, Any]]]:
    """Keys of a dataclass in a file, with types and metadata; FLAT fields have theirs in the same table."""
    hints = typing.get_type_hints(kind)
    found: dict[str, tuple[Any, Mapping[str, Any]]] = {}
    for field in dataclasses.fields(kind):
        if field.metadata == FLAT:
            found |= settings(hints[field.name])
        elif field.metadata != NOT_A_SETTING:
            found[field.name] = hints[field.name], field.metadata
    return found


def build(
    kind: Any, value: Any, key: str = "", metadata: Mapping[str, Any] = types.MappingProxyType({})
) -> Any:
    """Convert plain TOML data to `kind`; raises InputError with the dotted key of what is wrong."""
    if "by_name" in metadata:
        registry, tables = metadata["by_name"], _converted(dict[str, Any], value, key)
        kinds = {name: registry.get(name, dict[str, Any]) for name in tables}
        return {name: build(kinds[name], table, f"{key}.{name}") for name, table in tables.items()}
    if "by_kind" in metadata:
        registry, default = metadata["by_kind"]
        table = _converted(dict[str, Any], value, key)
        return build(registry.find(table.pop("kind", default), f"{key}.kind"), table, key)
    built = _converted(kind, value, key)
    if built is not None and (allowed := metadata.get("allowed")):
        allows, wanted = allowed
        values = built.values() if isinstance(built, dict) else built if isinstance(built, tuple) else [built]
        for one in values:
            if not allows(one):
                raise InputError(f"{one} is out of range", field=key, remedy=f"give {wanted}")
    return built


def _converted(kind: Any, value: Any, key: str) -> Any:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        return _converted(next(option for option in arguments if option is not type(None)), value, key)
    if origin is Literal:
        if value not in arguments:
            remedy = f"use {' or '.join(arguments)}"
            raise InputError(f"{abbreviated(value)} is not allowed", field=key, remedy=remedy)
        return value
    if type(value) in (int, float) and not abs(value) <= MAX_NUMBER:
        raise InputError(f"{abbreviated(value)} is out of range", field=key, remedy="correct the value")
    if kind is float and type(value) is int:
        return float(value)
    form: Any = object if kind is Any else kind
    wanted = getattr(kind, "__name__", "")
    if origin is dict or dataclasses.is_dataclass(kind):
        form, wanted = dict, "a table"
    elif origin is tuple:
        form, wanted = list, "a list"
    if not isinstance(value, form) or (kind is int and isinstance(value, bool)):
        found = f"expected {wanted}, found {abbreviated(value)}"
        raise InputError(found, field=key or None, remedy="correct the value")
    if dataclasses.is_dataclass(kind):
        return _build_dataclass(kind, value, key)
    if origin is dict:
        return {name: _converted(arguments[1], inner, f"{key}.{name}") for name, inner in value.items()}
    return tuple(_converted(arguments[0], inner, key) for inner in value) if origin is tuple else value


def _build_dataclass(kind: Any, table: dict[str, Any], key: str) -> Any:
    known, fields = settings(kind), dataclasses.fields(kind)
    for name in table:
        if name not in known:
            remedy = f"use one of {', '.join(known)}"
            raise InputError(f"unknown key '{name}'", field=key or None, remedy=remedy)
    for field in fields:
        if field.default is field.default_factory is MISSING and field.name not in table:
            raise InputError(f"missing key '{field.name}'", field=key or None, remedy="add it")
    below = f"{key}." if key else ""
    built = {n: build(known[n][0], inner, f"{below}{n}", known[n][1]) for n, inner in table.items()}
    try:
        for field in fields:
            if field.metadata == FLAT:
                inner = typing.get_type_hints(kind)[field.name]
                own = {name: built.pop(name) for name in settings(inner) if name in built}
                built[field.name] = inner(**own)
        return kind(**built)
    except InputError as error:
        raise error.at(field=key or None) from error
    except ValueError as error:
        raise InputError(str(error), field=key or None) from error


def plain(value: Any) -> Any:
    """What `build` reads back: dictionaries, lists and values, without those that are None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        found: dict[str, Any] = {}
        for field in dataclasses.fields(value):
            inner = plain(getattr(value, field.name))
            if "by_kind" in field.metadata and inner is not None:
                inner = {"kind": getattr(value, field.name).name} | inner
            if field.metadata == FLAT:
                found |= inner
            elif field.metadata != NOT_A_SETTING and inner is not None:
                found[field.name] = inner
        return found
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items()}
    return [plain(inner) for inner in value] if isinstance(value, tuple) else value


def scaled(value: Any, factor: float) -> Any:
    """Scale windows exactly, and fields whose metadata has ITERATIONS to whole numbers of at least 1."""
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
