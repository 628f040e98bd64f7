"""Plain data, as TOML has it, to frozen dataclasses and back, strictly by their type hints."""

from __future__ import annotations

import dataclasses
import types
import typing
from typing import Any, Literal

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.errors import InputError, abbreviated


def build(kind: Any, value: Any, where: str) -> Any:
    """Turn plain TOML data into `kind`, strictly; `where` names the file and the key so far."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        if not isinstance(value, dict):
            raise InputError(
                f"{where}: expected a table, found {abbreviated(value)}; the files of variants/ show the form"
            )
        hints = typing.get_type_hints(kind)
        for key in value:
            if key not in hints:
                raise InputError(f"{where}: unknown key '{key}'; use one of {', '.join(hints)}")
        needed = [
            f.name for f in dataclasses.fields(kind) if f.default is f.default_factory is dataclasses.MISSING
        ]
        missing = [name for name in needed if name not in value]
        if missing:
            raise InputError(f"{where}: missing key '{missing[0]}'; add it")
        make: Any = kind
        fields = {key: build(hints[key], inner, f"{where}: {key}") for key, inner in value.items()}
        try:
            return make(**fields)
        except ValueError as error:
            raise InputError(f"{where}: {error}") from error
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


def plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        pairs = ((f.name, getattr(value, f.name)) for f in dataclasses.fields(value))
        return {name: plain(inner) for name, inner in pairs if inner is not None}
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, tuple):
        return [plain(inner) for inner in value]
    return value
