"""Read methods strictly from TOML: a file, those that it extends, `key=value` assignments, a preset."""

import json
import re
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tomli_w

from mi_refgs.constants import DEFAULT_PRESET
from mi_refgs.errors import InputError, UnknownNameError, abbreviated, within
from mi_refgs.io.files import is_file, resource_dir
from mi_refgs.methods.build import build, plain, scaled, settings as keys_of
from mi_refgs.methods.extensions import EVENTS
from mi_refgs.methods.method import LOSS_WEIGHTS, About, Method
from mi_refgs.registry import load_again, plugin_files
from mi_refgs.shade.light.kind import LIGHTS

DEFAULT_LOSSES = plain(LOSS_WEIGHTS)
MAX_TEXT, MAX_LINE = 2**16, 2000
"""Characters of a method and of one of its lines: a parser's time grows with the square of a dotted key."""


@dataclass(frozen=True)
class Preset:
    iterations: int
    surfels: int
    max_surfels: int
    pixels: int  # per image at most; larger ones are downscaled by the smallest whole factor


PRESETS = {
    "quick": Preset(2_000, 15_000, 20_000, 80_000),
    "standard": Preset(4_000, 25_000, 40_000, 400 * 400),
    "paper": Preset(50_000, 30_000, 100_000, 800 * 800),  # the size of the paper's images
}
START_FRACTION = 0.75  # of the largest number of surfels, where a preset is ITERATIONS:SURFELS; as in `quick`


def preset_of(text: str) -> Preset:
    """The preset of a name, or of ITERATIONS:SURFELS, without limit of pixels; else raises InputError."""
    if text in PRESETS:
        return PRESETS[text]
    counts = [int(part) if re.fullmatch(r"[1-9]\d{0,8}", part) else 0 for part in text.split(":")]
    if len(counts) != 2 or not all(counts):
        remedy = f"use one of {', '.join(PRESETS)}, or ITERATIONS:SURFELS"
        raise InputError(f"{text}: unknown", "--preset", remedy=remedy)
    iterations, surfels = counts
    return Preset(iterations, max(round(START_FRACTION * surfels), 1), surfels, sys.maxsize)


def load(
    name: str, preset: str = DEFAULT_PRESET, assignments: Sequence[str] | None = None, folder: Path = Path()
) -> Method:
    """Read a method by name or TOML path in `folder`, scaled to a preset; `assignments`, key=value, apply
    unscaled. Raises InputError that names the file and the key for anything unknown or of the wrong type."""
    path, chosen = _find(name, "--method", folder), preset_of(preset)
    method = _built(_extended(path, []), path)
    table = plain(scaled(method, chosen.iterations / method.iterations))
    for part in table.keys() & {"surfels", "surroundings"}:
        table[part] |= {"count": chosen.surfels, "max_count": chosen.max_surfels}
    if (most := method.surfels.preset_limit or chosen.max_surfels) < chosen.max_surfels:
        table["surfels"] |= {"count": round(START_FRACTION * most), "max_count": most}
    assignments = [_placed(assignment) for assignment in assignments or ()]
    for assignment in assignments:
        _assign(table, assignment)
    file = str(path.resolve()) if name.endswith(".toml") else name
    table |= {"name": path.stem, "file": file, "preset": preset, "assignments": assignments}
    return _built(table, "--set" if assignments else path)


def load_resolved(path: Path) -> Method:
    """Read the resolved `config.toml` of a run, unscaled; it has the losses in its file and no others."""
    return _built(_read(path), path, resolved=True)


def _built(table: dict[str, Any], where: str | Path, resolved: bool = False) -> Method:
    """The method of a table: checked, or of a `resolved` file, taken as it is and without default losses."""
    with within(where):
        try:
            method: Method = build(Method, _merge({"loss": {} if resolved else DEFAULT_LOSSES}, table))
        except UnknownNameError as error:  # the kind of light
            files = table.get("plugins")
            raise load_again(error, files if isinstance(files, list) else []) from error
        if not resolved:
            method.check()
        return method


def dump(method: Method) -> str:
    """The method as TOML text that `load_resolved` reads back, with the plugins of this process."""
    plugins = tuple(dict.fromkeys([*method.plugins, *plugin_files()]))
    return tomli_w.dumps(plain(replace(method, plugins=plugins)))


def names() -> list[str]:
    """The methods that ship with the package."""
    return sorted(path.stem for path in resource_dir("variants").glob("*.toml"))


def for_purpose(purpose: str) -> str:
    """The shipped method with this `about.purpose`; raises InputError if there is none."""
    files = resource_dir("variants").glob("*.toml")
    found = {_read(path).get("about", {}).get("purpose"): path.stem for path in files}
    if not purpose or purpose not in found:
        remedy = f"use one of {', '.join(sorted(filter(None, found)))}, or choose a --method"
        raise InputError("no method is for that", "--for", purpose, remedy)
    return found[purpose]


def differences(before: Method, now: Method) -> dict[str, tuple[Any, Any]]:
    """Dotted keys by which two resolved methods differ beside `about`, with both values, None for none."""
    left_out: dict[str, Any] = {"about": About(), "file": "", "assignments": (), "plugins": ()}
    first, second = (_flat(plain(replace(method, **left_out))) for method in (before, now))
    keys = sorted(first.keys() | second.keys())
    return {key: (first.get(key), second.get(key)) for key in keys if first.get(key) != second.get(key)}


def _flat(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return flat


def _find(name: str, where: str, folder: Path) -> Path:
    """A shipped method by its name, one of scenes/ by its path there, or a .toml in `folder`."""
    shipped = resource_dir("scenes" if "/" in name else "variants")
    path = folder / name if name.endswith(".toml") else shipped / f"{name}.toml"
    if not is_file(path):
        known = ", ".join(names())
        raise InputError("no such method", where, name, f"use one of {known}, or a path to a .toml")
    return path


def _read(path: Path) -> dict[str, Any]:
    """The content of a file; each weight of a loss becomes a table."""
    try:
        text = path.read_text(encoding="utf-8")
        if len(text) > MAX_TEXT or max(map(len, text.splitlines()), default=0) > MAX_LINE:
            raise ValueError("too long")
        return _with_tables_of_losses(tomllib.loads(text))
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", path, remedy="check the path") from error
    except (ValueError, RecursionError) as error:  # TOML, UTF-8, long numbers; deep nesting
        raise InputError(f"not valid TOML ({error})", path, remedy="correct that line") from error


def _with_tables_of_losses(table: dict[str, Any]) -> dict[str, Any]:
    if not isinstance(losses := table.get("loss"), dict):
        return table
    return table | {"loss": {name: {"weight": x} if _is_number(x) else x for name, x in losses.items()}}


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _extended(path: Path, above: list[Path]) -> dict[str, Any]:
    """The table of a file merged over the one that it `extends`; `above` are the files that extend it."""
    if path.resolve() in above:
        raise InputError("the file extends itself", path, "extends", "break the circle")
    table = _read(path)
    if isinstance(light := table.get("light"), dict) and isinstance(light.get("file"), str):
        light["file"] = str(path.parent.resolve() / light["file"])
    base, dropped = table.pop("extends", None), table.pop("drop", [])
    if base is None and not dropped:
        return table
    if not isinstance(base, str):
        found = f"expected a name or a path in quotes, found {abbreviated(base)}"
        raise InputError(found, path, "extends", "correct it")
    if not isinstance(dropped, list) or not all(isinstance(key, str) for key in dropped):
        raise InputError("expected a list of keys", path, "drop", "write it as ['mesh', 'loss.alpha']")
    parent = _extended(_find(base, f"{path}: extends", path.parent), [*above, path.resolve()])
    if "about" in table:  # these are another file's
        for key in ("deviations", "purpose", "without_alpha"):
            parent.get("about", {}).pop(key, None)
    for key in dropped:
        *parents, last = key.split(".")
        if (inner := table_at(parent, parents)) is None or last not in inner:
            raise InputError(f"no key '{key}' in the extended file", path, "drop", "remove it from `drop`")
        del inner[last]
    return _merge(parent, table)


def table_at(table: object, keys: Sequence[str]) -> dict[str, Any] | None:
    """The table inside a table; None if there is none."""
    for key in keys:
        table = table.get(key) if isinstance(table, dict) else None
    return table if isinstance(table, dict) else None


def _merge(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        both = isinstance(value, dict) and isinstance(base.get(key), dict)
        merged[key] = _merge(base[key], value) if both else value
    return merged


def assignments(settings: Mapping[str, object] | Sequence[str]) -> list[str]:
    """Changes of a method as `key=value`; raises InputError for a value that TOML does not have."""
    if not isinstance(settings, Mapping):
        return [*settings]
    try:
        return [f"{key}={_inline(value)}" for key, value in settings.items()]
    except TypeError as error:
        remedy = "give numbers, texts, booleans, or lists and tables of them"
        raise InputError(str(error), "settings", remedy=remedy) from error


def _inline(value: object) -> str:
    if isinstance(value, Mapping):
        pairs = [f"{json.dumps(str(key), ensure_ascii=False)} = {_inline(x)}" for key, x in value.items()]
        return f"{{{', '.join(pairs)}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_inline, value))}]"
    return tomli_w.dumps({"_": value})[len("_ = ") : -1]


def _placed(assignment: str) -> str:
    """The assignment with the path of a light from the root: a run is read from anywhere."""
    key, _, text = assignment.partition("=")
    if key.strip() != "light.file":
        return assignment
    return f"{key}={_inline(str(Path(_value(text)).absolute()))}"


def _value(text: str) -> Any:
    """What TOML makes of a text, or the text."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


def _assign(table: dict[str, Any], assignment: str) -> None:
    """Apply `key=value`; `event.NAME=false` removes an event."""
    key, separator, text = assignment.partition("=")
    if not separator:
        raise InputError("expected key=value, such as loss.ssim=0.1", "--set", assignment)
    value = _value(text)
    *parents, last = key.strip().split(".")
    if parents == ["loss"] and _is_number(value):  # its weight; the rest of its table stays
        parents, last = ["loss", last], "weight"
    for parent in parents:
        inner = table.setdefault(parent, {})
        if not isinstance(inner, dict):
            raise InputError(f"'{parent}' is not a table", "--set", key.strip(), "check the key")
        table = inner
    if parents == ["light"] and last == "kind":  # keys of the former kind that this one lacks are dropped
        known = keys_of(LIGHTS.find(value, "light.kind"))
        for name in [name for name in table if name not in known]:
            del table[name]
    if parents == ["event"] and value is False:
        if table.pop(last, None) is None:
            EVENTS.find(last, "--set: event")
    else:
        table[last] = _with_tables_of_losses({last: value})[last]
