"""Read methods strictly from TOML: a file, those that it extends, `key=value` assignments, a preset.

No other module opens a TOML file, and none contains a method's name.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import tomli_w

from mi_refgs.constants import DEFAULT_PRESET
from mi_refgs.errors import InputError, abbreviated
from mi_refgs.io.files import is_file
from mi_refgs.io.resources import resource_dir
from mi_refgs.methods.build import build, plain, scaled
from mi_refgs.methods.method import LIGHT, LOSS_WEIGHTS, About, Method, MethodComponent, Selection
from mi_refgs.render.samples import samples_per_axis
from mi_refgs.shade.light.envmap import MIN_HEIGHT, is_height
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import ATTRIBUTES, MAX_SH_DEGREE

LEAST_CROP = 64 * 64  # pixels; SSIM compares windows of 11 × 11
HEIGHT = f"a multiple of 4 from {MIN_HEIGHT}"  # of an environment map
MAX_TEXT, MAX_LINE = 2**16, 2000
"""Characters of a method and of one of its lines: a parser's time grows with the square of a dotted key."""

RENAMED = {
    "loss.half_metal_rise": "loss.half_metal.rise",
    "loss.half_metal_start": "loss.half_metal.start",
    "loss.normal_rise": "loss.normal.rise",
    "loss.normal_start": "loss.normal.start",
    "loss.registered": "loss",
    "loss.smooth_until": "loss.smooth.until",
    "rates.channel": "rates.attribute",
    "select.term": "select.component",
    "surfels.channels": "surfels.attributes",
    "surfels.from_pictures": "surfels.from_images",
    "terms": "components",
    "variant": "name",
}
"""Earlier keys → what they are called now; files may have either."""

REMOVED = ("refine.gradient", "refine.dense_extent", "select.gain_per_ms")
"""Keys of version 0.1 that resolved files may have: densification by screen-space gradients, and a price of
time in milliseconds."""


@dataclass(frozen=True)
class Preset:
    """How long to run, and how large to grow."""

    iterations: int
    surfels: int
    max_surfels: int
    pixels: int  # per image at most; larger ones are downscaled by the smallest whole factor


# A step of 256² pixels takes 1.14 times as long as one of 200², one of 400² 1.9 times; the paper's images
# have 800². None is below 256².
PRESETS = {
    "quick": Preset(2_000, 15_000, 20_000, 256 * 256),
    "standard": Preset(4_000, 25_000, 40_000, 400 * 400),
    "paper": Preset(50_000, 30_000, 100_000, 800 * 800),
}
START_FRACTION = 0.75
"""Initial surfels over the largest number of surfels where a preset is ITERATIONS:SURFELS, as in `quick`."""


def preset_of(text: str) -> Preset:
    """Return the preset of a name, or of ITERATIONS:SURFELS, the largest number of surfels: "1000:20000".

    The latter has no limit of pixels. Raises InputError for any other text.
    """
    if text in PRESETS:
        return PRESETS[text]
    counts = [int(part) if re.fullmatch(r"[1-9]\d{0,8}", part) else 0 for part in text.split(":")]
    if len(counts) != 2 or not all(counts):
        names = ", ".join(PRESETS)
        raise InputError(f"--preset: {text}: unknown; use one of {names}, or ITERATIONS:SURFELS")
    iterations, surfels = counts
    return Preset(iterations, max(round(START_FRACTION * surfels), 1), surfels, sys.maxsize)


def load(
    name: str,
    preset: str = DEFAULT_PRESET,
    assignments: Sequence[str] | None = None,
    components: Sequence[str] = (),
) -> Method:
    """Read a method by name or TOML path, with some of its components, scaled to a preset (see `preset_of`).

    `assignments` are `key=value`, applied last and not scaled, except that the changes of a component are in
    the iterations of the file, and that nothing is assigned to what a component drops or changes. Raises
    InputError that names the file and the key for anything unknown or of the wrong type.
    """
    path, chosen = _find(name, "--method", Path()), preset_of(preset)
    table = _extended(path, [])
    of_select = [text for text in assignments or () if _keys(text.partition("=")[0].strip())[0] == "select"]
    for assignment in of_select if components else ():
        _assign(table, assignment)
    decided: list[list[str]] = []
    for name_of_component in components:
        component = _component(table, name_of_component, path)
        table = _with_component(table, component, path)
        decided += map(_keys, (*component.drop, *_flat(component.change)))
    method = _built(table, str(path))
    table = plain(scaled(method, chosen.iterations / method.iterations))
    for part in table.keys() & {"surfels", "surroundings"}:
        table[part] |= {"count": chosen.surfels, "max_count": chosen.max_surfels}
    if (
        method.select is not None
        and (most := method.select.surfels) is not None
        and most < chosen.max_surfels
    ):
        table["surfels"] |= {"count": round(START_FRACTION * most), "max_count": most}
    for assignment in assignments or []:
        keys = _keys(assignment.partition("=")[0].strip())
        if not any(keys[: len(other)] == other for other in decided):
            _assign(table, assignment)
    file = str(path.resolve()) if name.endswith(".toml") else name
    table |= {"name": path.stem, "file": file, "preset": preset}
    table |= {"components": [*components], "assignments": [*(assignments or [])]}
    method = build(Method, table, "--set" if assignments else str(path))
    _require_consistent(method, str(path))
    if method.select is not None and not components:
        _require_selectable(method, method.select, str(path))
    return method


def with_components(method: Method, components: Sequence[str]) -> Method:
    """A method with these of its components in place of those that it has, read from its file again.

    The image size stays, and what else differs from the file, unless a component changes its table: the
    components that may be tried, and changes of the `Method` in Python.
    """
    if method.select is None or (*components,) == method.components:
        return method
    then, made = (
        load(method.file, method.preset, method.assignments, names)
        for names in (method.components, components)
    )
    names = {field.name for field in fields(Method)}
    own = {name for name in names if getattr(method, name) != getattr(then, name) == getattr(made, name)}
    made = replace(made, **{name: getattr(method, name) for name in own})
    return made.downscaled(method.data.downscale)


def load_resolved(path: Path) -> Method:
    """Read the resolved `config.toml` of a run, unscaled.

    A run has the losses in its file and no others; a file of 0.1, with numbers as weights, may lack some.
    Without a primitive of its own, the background has that of the object, and shares no limit with it.
    """
    parsed = _parsed(path)
    for key in REMOVED:
        with contextlib.suppress(InputError):  # only older files have it
            _drop(parsed, key, path)
    losses = parsed.get("loss")
    complete = isinstance(losses, dict) and all(isinstance(loss, dict) for loss in losses.values())
    table = _modernised(parsed, str(path))
    method = build(Method, table, str(path)) if complete else _built(table, str(path))
    around = method.surroundings
    if around is not None and "primitive" not in table["surroundings"]:
        share = around.max_count / (method.surfels.most + around.max_count)
        around = replace(around, primitive=method.surfels.primitive, share=share)
    return replace(method, surroundings=around)


def _built(table: dict[str, Any], where: str) -> Method:
    """The method of a file's table; losses that it does not name have the default weights."""
    return build(Method, _merge({"loss": plain(LOSS_WEIGHTS)}, table), where)


def dump(method: Method) -> str:
    """The method as TOML text that `load_resolved` reads back."""
    return tomli_w.dumps(plain(method))


def names() -> list[str]:
    """The methods that ship with the package."""
    return [path.stem for path in _shipped()]


def for_purpose(purpose: str) -> str:
    """The shipped method with this `about.purpose`; raises InputError if there is none."""
    found = {_parsed(path).get("about", {}).get("purpose"): path.stem for path in _shipped()}
    if not purpose or purpose not in found:
        known = ", ".join(sorted(filter(None, found)))
        raise InputError(f"--for: {purpose}: no method is for that; use one of {known}, or choose a --method")
    return found[purpose]


def differences(before: Method, now: Method) -> dict[str, tuple[Any, Any]]:
    """Dotted keys by which two resolved methods differ, each with both values, None for no such key.

    The table `about`, the file's place and how changes were written are not compared.
    """
    compared = (replace(method, about=About(), file="", assignments=()) for method in (before, now))
    first, second = (_flat(plain(method)) for method in compared)
    keys = sorted(first.keys() | second.keys())
    return {key: (first.get(key), second.get(key)) for key in keys if first.get(key) != second.get(key)}


def _flat(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Dotted keys → values of nested dictionaries."""
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return flat


# ---------------- files ----------------


def _shipped() -> list[Path]:
    return sorted(resource_dir("variants").glob("*.toml"))


def _find(name: str, where: str, folder: Path) -> Path:
    """A shipped method by its name, one of scenes/ by its path there, or a .toml in `folder`."""
    shipped = resource_dir("scenes" if "/" in name else "variants")
    path = folder / name if name.endswith(".toml") else shipped / f"{name}.toml"
    if not is_file(path):
        known = ", ".join(names())
        raise InputError(f"{where}: {name}: no such method; use one of {known}, or a path to a .toml")
    return path


def _parsed(path: Path) -> dict[str, Any]:
    """The content of a file as it is."""
    try:
        text = path.read_text(encoding="utf-8")
        if len(text) > MAX_TEXT or max(map(len, text.splitlines()), default=0) > MAX_LINE:
            raise ValueError("too long")
        return tomllib.loads(text)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except (ValueError, RecursionError) as error:  # TOML, UTF-8, long numbers; deep nesting
        raise InputError(f"{path}: not valid TOML ({error}); correct that line") from error


def _read(path: Path) -> dict[str, Any]:
    """The content of a file with the keys of today."""
    return _modernised(_parsed(path), str(path))


def _modernised(table: dict[str, Any], where: str) -> dict[str, Any]:
    """Tables with the keys of today, those in components too; each weight of a loss becomes a table.

    Raises InputError that begins with `where` for a key that is there by its earlier name too.
    """
    loss = table.get("loss")
    if isinstance(loss, dict):
        table = table | {"loss": _weights_as_tables(loss)}
    for old, new in RENAMED.items():
        *parents, last = old.split(".")
        inner = _at(table, parents)
        if isinstance(inner, dict) and last in inner:
            if not old.startswith(f"{new}.") and _at(table, new.split(".")) is not None:
                raise InputError(f"{where}: {old}: is called {new} now, which is there too; remove {old}")
            table = _merge(table, _nested(new.split("."), inner.pop(last)))
    components = _at(table, ["select", "component"])
    for component in components.values() if isinstance(components, dict) else ():
        if isinstance(component, dict) and isinstance(component.get("change"), dict):
            component["change"] = _modernised(component["change"], where)
    return table


def _weights_as_tables(losses: dict[str, Any]) -> dict[str, Any]:
    """Losses, also under the earlier key `registered`, with a table for each number that is a weight."""
    found: dict[str, Any] = {}
    for key, value in losses.items():
        if key == "registered" and isinstance(value, dict):
            value = _weights_as_tables(value)
        elif _is_number(value) and f"loss.{key}" not in RENAMED:
            value = {"weight": value}
        found[key] = value
    return found


def _at(table: dict[str, Any], keys: Sequence[str]) -> Any:
    """The value of a dotted key, given in parts; None if it is not there."""
    value: Any = table
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return value


def _nested(keys: Sequence[str], value: Any) -> dict[str, Any]:
    """Tables with one value, at a dotted key that is given in parts."""
    *parents, last = keys
    table = {last: value}
    for key in reversed(parents):
        table = {key: table}
    return table


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _extended(path: Path, above: list[Path]) -> dict[str, Any]:
    """The table of a file merged over the one that it `extends`; paths are relative to the file.

    `above` are the files that extend this one, resolved.
    """
    if path.resolve() in above:
        raise InputError(f"{path}: extends: the file extends itself, through others or not; break the circle")
    table = _read(path)
    base, dropped = table.pop("extends", None), table.pop("drop", [])
    if base is None and not dropped:
        return table
    if not isinstance(base, str):
        found = f"expected a name or a path in quotes, found {abbreviated(base)}"
        raise InputError(f"{path}: extends: {found}; correct it")
    if not isinstance(dropped, list) or not all(isinstance(key, str) for key in dropped):
        raise InputError(f"{path}: drop: expected a list of keys, such as ['mesh', 'loss.alpha']; correct it")
    parent = _extended(_find(base, f"{path}: extends", path.parent), [*above, path.resolve()])
    if "about" in table:  # these are another file's
        for key in ("deviations", "purpose", "without_alpha"):
            parent.get("about", {}).pop(key, None)
    for key in dropped:
        _drop(parent, key, path)
    return _merge(parent, table)


def _component(table: dict[str, Any], name: str, path: Path) -> MethodComponent:
    """A component of a file's table."""
    where = f"{path}: select.component"
    try:
        return build(MethodComponent, table["select"]["component"][name], f"{where}.{name}")
    except (KeyError, TypeError) as error:
        raise InputError(f"{where}: there is no '{name}'; use one of its components") from error


def _with_component(table: dict[str, Any], component: MethodComponent, path: Path) -> dict[str, Any]:
    """The table of a file with the changes of one of its components."""
    for key in component.drop:
        with contextlib.suppress(InputError):  # another component or a base file may have dropped it
            _drop(table, key, path)
    return _merge(table, component.change)


def _merge(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        both = isinstance(value, dict) and isinstance(base.get(key), dict)
        merged[key] = _merge(base[key], value) if both else value
    return merged


def _keys(dotted: str) -> list[str]:
    """The parts of a dotted key, old ones by their new names, in the changes of a component too."""
    head, separator, change = dotted.partition(".change.")
    if separator:
        return [*_keys(head), "change", *_keys(change)]
    for old, new in RENAMED.items():
        if dotted == old or dotted.startswith(f"{old}."):
            dotted = new + dotted[len(old) :]
    return dotted.split(".")


def _drop(table: dict[str, Any], key: str, path: Path) -> None:
    *parents, last = _keys(key)
    for parent in parents:
        inner = table.get(parent)
        table = inner if isinstance(inner, dict) else {}
    if last not in table:
        raise InputError(f"{path}: drop: no key '{key}' in the extended file; remove it from `drop`")
    del table[last]


def assignments(settings: Mapping[str, object] | Sequence[str]) -> list[str]:
    """Changes of a method as `key=value` with TOML values; a list of such is returned as it is.

    Raises InputError for a value that TOML does not have.
    """
    if not isinstance(settings, Mapping):
        return [*settings]
    try:
        return [f"{key}={_inline(value)}" for key, value in settings.items()]
    except TypeError as error:
        raise InputError(
            f"settings: {error}; give numbers, texts, booleans, or lists and tables of them"
        ) from error


def _inline(value: object) -> str:
    """A value as TOML in one line; raises TypeError for one that TOML does not have."""
    if isinstance(value, Mapping):
        pairs = [f"{json.dumps(str(key), ensure_ascii=False)} = {_inline(x)}" for key, x in value.items()]
        return f"{{{', '.join(pairs)}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_inline, value))}]"
    return tomli_w.dumps({"_": value})[len("_ = ") : -1]


def _assign(table: dict[str, Any], assignment: str) -> None:
    key, separator, text = assignment.partition("=")
    if not separator:
        raise InputError(f"--set: {assignment}: expected key=value, such as loss.ssim=0.1")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        value = text
    key = key.strip()
    *parents, last = _keys(key)
    given = _at(_modernised(_nested(key.split("."), value), "--set"), [*parents, last])
    if _is_number(value) and isinstance(given, dict):  # the weight of a loss; the rest of its table stays
        parents, last = [*parents, last], "weight"
    elif key == "loss.registered" and isinstance(given, dict):  # beside the other losses
        value = _merge(table["loss"], given)
    else:
        value = given
    for parent in parents:
        inner = table.setdefault(parent, {})
        if not isinstance(inner, dict):
            raise InputError(f"--set: {key}: '{parent}' is not a table; check the key")
        table = inner
    table[last] = value


# ---------------- what is not allowed ----------------


def _require_consistent(method: Method, where: str) -> None:
    """Raise InputError for unknown names, values out of range, and stages without what they need."""
    surfels, light = method.surfels, method.light
    for name, table in (("surroundings", method.surroundings), ("surfels", surfels)):
        try:
            attributes = {*table.names} if table is not None else set()
        except InputError as error:
            raise InputError(f"{where}: {name}.{error}") from error
    _require_known_names(method, attributes, where)

    # Numbers: (key, value, whether it is allowed, what is).
    ranges = [
        (f"stage.{name}.rates.{one}", factor, 0 <= factor < math.inf, "0 or more")
        for name, stage in method.stages()
        for one, factor in stage.rates.items()
    ]
    for name, loss in method.loss.items():
        most = 1 if name == "ssim" else math.inf  # 1 - ssim is the weight of L1
        wanted = "0 or more" if most > 1 else "a fraction from 0 to 1"
        ranges.append((f"loss.{name}.weight", loss.weight, 0 <= loss.weight <= most, wanted))
        ranges += [
            (f"loss.{name}.{key}", count, count >= 0, "0 or more")
            for key in ("start", "rise", "until")
            if (count := getattr(loss, key)) is not None
        ]
    blocks = (images.block for images in method.data.coarse)
    ranges += [("data.coarse.block", block, block >= 2, "2 or more") for block in blocks]
    if method.data.crop is not None:
        ranges.append(
            ("data.crop", method.data.crop, method.data.crop >= LEAST_CROP, f"{LEAST_CROP} or more")
        )
    if light is not None:
        ranges.append(("light.height", light.height, is_height(light.height), HEIGHT))
        ranges.append(("light.every", light.every, light.every >= 1, "1 or more"))
    if method.exposure is not None:
        ranges.append(("exposure.rate", method.exposure.rate, method.exposure.rate >= 0, "0 or more"))
    if method.cameras is not None:
        ranges.append(("cameras.rate", method.cameras.rate, method.cameras.rate >= 0, "0 or more"))
    ranges.append(("surfels.capacity", surfels.capacity, surfels.capacity > 0, "more than 0"))
    ranges.append(("refine.grow", method.refine.grow, method.refine.grow >= 0, "0 or more"))
    if (metals := method.metal_trial) is not None:
        ranges.append(("metal_trial.until", metals.until, metals.until >= 1, "1 or more"))
    if (around := method.surroundings) is not None:
        ranges += [
            (f"surroundings.{key}", getattr(around, key), allowed, wanted)
            for key, allowed, wanted in (
                ("count", around.count >= 1, "1 or more"),
                ("share", 0 < around.share < 1, "a number between 0 and 1"),
                ("degree", 0 <= around.degree <= MAX_SH_DEGREE, f"0 to {MAX_SH_DEGREE}"),
                ("scattered", 0 <= around.scattered <= 1, "a fraction from 0 to 1"),
                ("opacity", 0 < around.opacity < 1, "a number between 0 and 1"),
                ("size", around.size > 0, "more than 0"),
                ("prune_extent", around.prune_extent > 0, "more than 0"),
                ("reach", around.reach > 0, "more than 0"),
                ("height", is_height(around.height), HEIGHT),
            )
        ]
    for key, value, allowed, wanted in ranges:
        if not allowed:
            raise InputError(f"{where}: {key}: {value} is out of range; give {wanted}")

    # Stages: what their shading needs, samples, and names of parameters.
    parameters = {LIGHT} if light is not None else set()
    for name, stage in method.stages():
        try:
            shading = Shading.resolve(stage.shading, method.mesh is not None)
            shading.require_inputs(attributes, light is not None)
            samples_per_axis(stage.samples)
        except InputError as error:
            raise InputError(f"{where}: stage.{name}: {error}") from error
        for key, named, known in (
            ("restart", stage.restart, {*surfels.attributes} | parameters),
            ("rates", stage.rates, attributes | parameters),
        ):
            if absent := [one for one in named if one not in known]:
                raise InputError(f"{where}: stage.{name}: {key}: there is no '{absent[0]}'; remove it")

    for key, used in (("refine.propagate", method.refine.propagate), ("metal_trial", method.metal_trial)):
        if used is not None and "metallic" not in attributes:
            raise InputError(f"{where}: {key}: there is no attribute 'metallic'; add it, or drop this")


def _require_known_names(method: Method, attributes: set[str], where: str) -> None:
    """Raise InputError for a name of an attribute that does not exist or does not fit the key."""
    surfels, rates = method.surfels, method.rates
    harmonics = {name for name, attribute in ATTRIBUTES.items() if attribute.harmonics}
    bounded = {name for name in attributes & {*ATTRIBUTES} if ATTRIBUTES[name].activation == "sigmoid"}
    for key, named, known in (
        (
            "surfels.attributes",
            surfels.attributes,
            {name for name, x in ATTRIBUTES.items() if not x.geometry},
        ),
        ("surfels.initial", surfels.initial, attributes),
        ("surfels.degree", surfels.degree, harmonics),
        ("surfels.from_images", surfels.from_images, {*surfels.attributes}),
        ("rates.attribute", rates.attribute, {*ATTRIBUTES}),
        ("rates.rest", rates.rest, harmonics),
        ("refine.reset_raise", method.refine.reset_raise, bounded),
    ):
        if unknown := [name for name in named if name not in known]:
            allowed = ", ".join(name for name in ATTRIBUTES if name in known)
            raise InputError(f"{where}: {key}: '{unknown[0]}' is unknown; use some of {allowed}")


def _require_selectable(method: Method, select: Selection, where: str) -> None:
    """Raise InputError for a selection that cannot be made; each component is loaded with those it needs."""
    if select.holdout < 2:
        raise InputError(f"{where}: select.holdout: {select.holdout} leaves no views to fit; give 2 or more")
    if select.surfels is not None and select.surfels < 1:
        raise InputError(f"{where}: select.surfels: {select.surfels} is out of range; give 1 or more")
    for name, component in select.component.items():
        if unknown := [one for one in (*component.needs, *component.unless) if one not in select.component]:
            key = f"select.component.{name}: needs"
            raise InputError(f"{where}: {key}: there is no '{unknown[0]}'; name a component")
        if component.trial < 1:
            given = f"select.component.{name}.trial: {component.trial}"
            raise InputError(f"{where}: {given} is out of range; give 1 or more")
        load(method.file, method.preset, method.assignments, [*_needed(select, name), name])


def _needed(select: Selection, name: str) -> list[str]:
    """The components that one needs, and those that they need, in the order of their trials."""
    found: list[str] = []
    for needed in select.component[name].needs:
        if needed not in select.order[: select.order.index(name)]:
            raise InputError(f"select.component.{name}: needs: '{needed}' is tried later; try it before")
        found += [other for other in (*_needed(select, needed), needed) if other not in found]
    return found
