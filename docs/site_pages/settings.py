"""The page of a method file's keys, from the dataclasses that read it and the comments beside fields."""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
import typing
from typing import Any

from mi_refgs.methods.fields import FLAT, Window
from mi_refgs.methods.method import Method
from mi_refgs.shade.options import NOT_A_SETTING
from site_pages import table

FILLED_IN = ("name", "file", "preset", "assignments")
"""Fields of `Method` that no file gives: `load` fills them in."""


def page() -> str:
    """A section for the top level and for each table of a method file."""
    text = [
        "# Settings of a method",
        'Keys of a method file. `extends = "NAME or FILE"` begins with another method, of which '
        '`drop = ["loss.alpha"]` removes keys. `--set` changes keys for one '
        "run: `--set loss.ssim=0.1 light.height=64`. "
        "Defaults are those of a file that says nothing; [methods](methods.md) shows what each says, and "
        "`config.toml` in a run folder what the run was fitted with. Numbers of iterations are written for "
        "the file's own `iterations`, and a preset scales them. A *window* is a table of `start`, `until` "
        "and `every`: events at the multiples of `every` beyond `start`, up to `until`.",
    ]
    named = {name.partition(".")[0] for name in tables()}
    for name, kind in tables().items():
        rows = [
            [f"`{field}`", f"`{typed}`", f"`{default}`" if default else "", comment]
            for field, typed, default, comment in fields(kind)
            if not (kind is Method and (field in FILLED_IN or field in named))
        ]
        title = f"`[{name}]`" if name else "Top level"
        remark = (inspect.getdoc(kind) or "").split("\n\n")[0]
        text += [
            f"## {title}",
            remark,
            table(["key", "type", "default", "meaning"], rows),
        ]
    return "\n\n".join(text) + "\n"


def tables() -> dict[str, type]:
    """Dotted name of each table of a method file → its class, the top level first."""
    found: dict[str, type] = {"": Method}
    waiting: list[tuple[str, type]] = [("", Method)]
    while waiting:
        prefix, kind = waiting.pop(0)
        hints = typing.get_type_hints(kind)
        for field in (one for one in dataclasses.fields(kind) if one.metadata != FLAT):
            name, registry = field.name, field.metadata.get("by_name", {})
            by_name = [(inner, f".{key}") for key, inner in sorted(registry.items())]
            kinds, usual = field.metadata.get("by_kind", ({}, ""))
            by_kind = [(inner, "" if key == usual else f", kind = {key}") for key, inner in kinds.items()]
            for inner, suffix in by_name or by_kind or _classes(hints[name]):
                if inner is not Window and dataclasses.fields(inner):
                    found[f"{prefix}{name}{suffix}"] = inner
                    waiting.append((f"{prefix}{name}{suffix}.", inner))
    return found


def _classes(hint: Any) -> list[tuple[type, str]]:
    """Dataclasses in a type, and what follows a key: a dictionary's tables have names of their own."""
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return [(hint, "")]
    inner = [found for part in typing.get_args(hint) for found in _classes(part)]
    return [(kind, ".NAME") for kind, _ in inner] if typing.get_origin(hint) is dict else inner


def fields(kind: type) -> list[tuple[str, str, str, str]]:
    """Name, type, default and remark of each field: the comment beside or above it in the source."""
    found = []
    owners = [owner for owner in kind.__mro__ if dataclasses.is_dataclass(owner)]
    source, hints = "".join(map(inspect.getsource, owners)), typing.get_type_hints(kind)
    for field in (one for one in dataclasses.fields(kind) if one.metadata != NOT_A_SETTING):
        if field.metadata == FLAT:
            found += fields(hints[field.name])
            continue
        line = re.search(
            r"(?:^    # (?P<above>.*)\n)?"
            rf"^    {field.name}: (?P<type>.*?)(?: = .*?)?(?:  # (?P<remark>.*))?$",
            source,
            re.M,
        )
        assert line is not None, f"{kind.__name__}.{field.name}: its declaration is not one line"
        remark = line["remark"] or line["above"] or ""
        found.append((field.name, _plain(line["type"], hints[field.name]), _shown(field.default), remark))
    return found


def _shown(default: Any) -> str:
    """A default as TOML has it; empty for tables, and where there is none."""
    if default is dataclasses.MISSING or (
        dataclasses.is_dataclass(default) and not isinstance(default, Window)
    ):
        return ""
    if default is None:
        return "absent"
    if isinstance(default, Window):
        return f"{{ start = {default.start:g}, until = {default.until:g}, every = {default.every:g} }}"
    if isinstance(default, tuple):
        return f"[{', '.join(map(_shown, default))}]"
    if isinstance(default, str | bool):
        return json.dumps(default)
    return f"{default:_}" if isinstance(default, int) else f"{default:g}"


def _plain(annotation: str, hint: Any) -> str:
    """A type as a writer of TOML thinks of it."""
    if typing.get_origin(hint) is typing.Literal:
        return " or ".join(map(json.dumps, typing.get_args(hint)))
    annotation = annotation.replace(" | None", "").replace("Window", "window")
    return re.sub(r"Literal\[(.*?)\]", lambda m: " or ".join(m[1].split(", ")), annotation)
