"""Reads methods strictly from TOML: a file, those that it extends, `key=value` assignments, a preset.

No other module opens a TOML file, and none contains a method's name.
"""

from __future__ import annotations

import contextlib
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tomli_w

from mi_refgs.constants import DEFAULT_PRESET
from mi_refgs.errors import InputError, abbreviated
from mi_refgs.io.files import is_file
from mi_refgs.io.resources import resource_dir
from mi_refgs.methods.build import build, plain
from mi_refgs.methods.method import LIGHT, Method, Selection, Term
from mi_refgs.methods.presets import PRESETS, scaled
from mi_refgs.render.samples import samples_per_axis
from mi_refgs.shade.light.envmap import MIN_HEIGHT, is_height
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import ATTRIBUTES

MAX_TEXT, MAX_LINE = 2**16, 2000
"""Characters of a method and of one of its lines: a parser's time grows with the square of a dotted key."""


def load(
    variant: str,
    preset: str = DEFAULT_PRESET,
    assignments: Sequence[str] | None = None,
    terms: Sequence[str] = (),
) -> Method:
    """Read a method by name or TOML path, with some of its terms; scale it to a preset, apply `key=value`.

    Raises InputError naming the file and the key for anything unknown or of the wrong type.
    """
    if preset not in PRESETS:
        raise InputError(f"--preset: {preset}: unknown; use one of {', '.join(PRESETS)}")
    path = _find(variant, "--method", Path())
    table = _extended(path, [])
    for name in terms:
        table = _with_term(table, name, path)
    chosen = PRESETS[preset]
    method = build(Method, table, str(path))
    method = scaled(method, chosen.iterations / method.iterations)
    table = plain(method)
    for name in ("surfels", "surroundings"):
        if name in table:
            table[name] |= {"count": chosen.surfels, "max_count": chosen.max_surfels}
    for assignment in assignments or []:
        _assign(table, assignment)
    where = "--set" if assignments else str(path)
    file = str(path.resolve()) if variant.endswith(".toml") else variant
    made = {"variant": path.stem, "file": file, "preset": preset, "terms": [*terms]}
    made["assignments"] = [*(assignments or [])]
    method = _checked(build(Method, table | made, where), str(path))
    if method.select is not None and not terms:
        _check_terms(method, str(path))
    return method


def _check_terms(method: Method, where: str) -> None:
    """Raise InputError for a selection that cannot be made; each term is loaded with those that it needs."""
    select = method.select
    assert select is not None
    if select.holdout < 2:
        raise InputError(f"{where}: select.holdout: {select.holdout} leaves no views to fit; give 2 or more")
    for name, term in select.term.items():
        if unknown := [other for other in (*term.needs, *term.unless) if other not in select.term]:
            raise InputError(f"{where}: select.term.{name}: needs: there is no '{unknown[0]}'; name a term")
        load(method.file, method.preset, method.assignments, [*_needed(select, name), name])


def _needed(select: Selection, name: str) -> list[str]:
    """The terms that one needs, and those that they need, in the order in which they are tried."""
    found: list[str] = []
    for needed in select.term[name].needs:
        if needed not in select.order[: select.order.index(name)]:
            raise InputError(f"select.term.{name}: needs: '{needed}' is tried later; try it before")
        found += [other for other in (*_needed(select, needed), needed) if other not in found]
    return found


def _with_term(table: dict[str, Any], name: str, path: Path) -> dict[str, Any]:
    """The table of a file with the changes of one of its terms."""
    try:
        term = build(Term, table["select"]["term"][name], f"{path}: select.term.{name}")
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: select.term: there is no '{name}'; use one of its terms") from error
    for key in term.drop:
        with contextlib.suppress(InputError):  # another term, or a file below this one, may have dropped it
            _drop(table, key, path)
    return _merge(table, term.change)


def _checked(method: Method, where: str) -> Method:
    """The method; raises InputError for unknown channels and a stage that channels and light cannot serve."""
    surfels, rates = method.surfels, method.rates
    try:
        channels = {*surfels.names}
    except InputError as error:
        raise InputError(f"{where}: surfels.{error}") from error
    bounded = {name for name in channels & ATTRIBUTES.keys() if ATTRIBUTES[name].activation == "sigmoid"}
    for key, named, known in (
        ("surfels.channels", surfels.channels, {name for name, x in ATTRIBUTES.items() if not x.geometry}),
        ("surfels.initial", surfels.initial, channels),
        ("surfels.degree", surfels.degree, {name for name in ATTRIBUTES if ATTRIBUTES[name].harmonics}),
        ("surfels.from_pictures", surfels.from_pictures, {*surfels.channels}),
        ("rates.channel", rates.channel, set(ATTRIBUTES)),
        ("rates.rest", rates.rest, {name for name in ATTRIBUTES if ATTRIBUTES[name].harmonics}),
        ("refine.reset_raise", method.refine.reset_raise, bounded),
    ):
        if unknown := [name for name in named if name not in known]:
            allowed = ", ".join(name for name in ATTRIBUTES if name in known)
            raise InputError(f"{where}: {key}: '{unknown[0]}' is unknown; use some of {allowed}")
    if method.light is not None and not is_height(method.light.height):
        raise InputError(
            f"{where}: light.height: {method.light.height} is no multiple of 4 from {MIN_HEIGHT}; give one"
        )
    if method.light is not None and method.light.every < 1:
        raise InputError(f"{where}: light.every: {method.light.every} is no number of steps; give 1 or more")
    if too_small := [pictures.block for pictures in method.data.coarse if pictures.block < 2]:
        raise InputError(f"{where}: data.coarse: a block of {too_small[0]} averages nothing; give 2 or more")
    for name, stage in method.stages():
        try:
            Shading.resolve(stage.shading, method.mesh is not None).require_inputs(
                channels, method.light is not None
            )
            samples_per_axis(stage.samples)
        except InputError as error:
            raise InputError(f"{where}: stage.{name}: {error}") from error
        light = {LIGHT} if method.light is not None else set()
        for key, named, there in (
            ("restart", stage.restart, {*surfels.channels} | light),
            ("rates", stage.rates, channels | light),
        ):
            if absent := [one for one in named if one not in there]:
                raise InputError(f"{where}: stage.{name}: {key}: there is no '{absent[0]}'; remove it")
        if worst := [one for one, factor in stage.rates.items() if not 0 <= factor < float("inf")]:
            found = f"{worst[0]}: {stage.rates[worst[0]]}"
            raise InputError(f"{where}: stage.{name}: rates: {found} is no factor; give 0 or more")
    _check_priors(method, where)
    if method.exposure is not None and method.exposure.rate < 0:
        raise InputError(f"{where}: exposure.rate: {method.exposure.rate} is no rate; give 0 or more")
    if method.surroundings is not None and (fault := method.surroundings.fault()):
        raise InputError(f"{where}: surroundings.{fault}")
    relocate = method.refine.relocate
    if relocate is not None and relocate.grow < 0:
        raise InputError(f"{where}: refine.relocate.grow: {relocate.grow} is no share; give 0 or more")
    if method.refine.propagate is not None and "metallic" not in surfels.channels:
        raise InputError(f"{where}: refine.propagate: there is no channel 'metallic'; add it, or drop this")
    return method


def _check_priors(method: Method, where: str) -> None:
    """Raise InputError for a prior on what the method does not have."""
    loss, pixels = method.loss, any(stage.shading.at == "pixel" for _, stage in method.stages())
    for name, needed in (("half_metal", {"metallic"}), ("materials", {"metallic", "roughness"})):
        if getattr(loss, name) and not (pixels and needed <= {*method.surfels.channels}):
            raise InputError(
                f"{where}: loss.{name}: needs {' and '.join(sorted(needed))}, and a stage at = pixel; drop it"
            )
    if loss.light_colour and method.light is None:
        raise InputError(f"{where}: loss.light_colour: there is no light; drop it")


def load_resolved(path: Path) -> Method:
    """Read the resolved `config.toml` of a run, unscaled."""
    return build(Method, _read(path), str(path))


def dump(method: Method) -> str:
    """The method as TOML text that `load_resolved` reads back."""
    return tomli_w.dumps(plain(method))


def names() -> list[str]:
    """The methods that ship with the package."""
    return [path.stem for path in _shipped()]


def for_purpose(purpose: str) -> str:
    """The shipped method that says it is for this; raises InputError if none is."""
    found = {_read(path).get("about", {}).get("purpose"): path.stem for path in _shipped()}
    if not purpose or purpose not in found:
        known = ", ".join(sorted(filter(None, found)))
        raise InputError(f"--for: {purpose}: no method is for that; use one of {known}, or choose a --method")
    return found[purpose]


def _shipped() -> list[Path]:
    return sorted(resource_dir("variants").glob("*.toml"))


def _find(variant: str, where: str, folder: Path) -> Path:
    """A shipped method by its name, one of scenes/ by its path there, or a .toml in `folder`."""
    shipped = resource_dir("scenes" if "/" in variant else "variants")
    path = folder / variant if variant.endswith(".toml") else shipped / f"{variant}.toml"
    if not is_file(path):
        known = ", ".join(names())
        raise InputError(f"{where}: {variant}: no such method; use one of {known}, or a path to a .toml")
    return path


def _extended(path: Path, above: list[Path]) -> dict[str, Any]:
    """The table of a file, with those that it `extends`; paths are relative to the file that names them.

    `above` are the files that extend this one, resolved.
    """
    if path.resolve() in above:
        raise InputError(f"{path}: extends: the file extends itself, through others or not; break the circle")
    table = _read(path)
    base, dropped = table.pop("extends", None), table.pop("drop", [])
    if base is None and not dropped:
        return table
    if not isinstance(base, str):
        raise InputError(
            f"{path}: extends: expected a name or a path in quotes, found {abbreviated(base)}; correct it"
        )
    if not isinstance(dropped, list) or not all(isinstance(name, str) for name in dropped):
        raise InputError(f"{path}: drop: expected a list of keys, such as ['mesh', 'loss.alpha']; correct it")
    parent = _extended(_find(base, f"{path}: extends", path.parent), [*above, path.resolve()])
    if "about" in table:  # what another file deviates from is not what this one does
        for key in ("deviations", "purpose"):
            parent.get("about", {}).pop(key, None)
    for name in dropped:
        _drop(parent, name, path)
    return _merge(parent, table)


def _read(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
        if len(text) > MAX_TEXT or max(map(len, text.splitlines()), default=0) > MAX_LINE:
            raise ValueError("too long")
        return tomllib.loads(text)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except (ValueError, RecursionError) as error:  # of TOML, UTF-8, long numbers; deep nesting
        raise InputError(f"{path}: not valid TOML ({error}); correct that line") from error


def _merge(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        both = isinstance(value, dict) and isinstance(base.get(key), dict)
        merged[key] = _merge(base[key], value) if both else value
    return merged


def _drop(table: dict[str, Any], name: str, path: Path) -> None:
    *parents, last = name.split(".")
    for parent in parents:
        inner = table.get(parent)
        table = inner if isinstance(inner, dict) else {}
    if last not in table:
        raise InputError(f"{path}: drop: no key '{name}' in the extended file; remove it from `drop`")
    del table[last]


def assignments(settings: Mapping[str, object] | Sequence[str]) -> list[str]:
    """Changes of a method as `key=value` with values of TOML; what is a list of such is that list.

    Raises InputError for a value that TOML does not have.
    """
    if not isinstance(settings, Mapping):
        return [*settings]
    try:
        return [f"{key}={tomli_w.dumps({'_': value})[len('_ = ') : -1]}" for key, value in settings.items()]
    except TypeError as error:
        raise InputError(f"settings: {error}; give numbers, texts, booleans, or lists of them") from error


def _assign(table: dict[str, Any], assignment: str) -> None:
    key, separator, text = assignment.partition("=")
    if not separator:
        raise InputError(f"--set: {assignment}: expected key=value, such as loss.ssim=0.1")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        value = text
    *parents, last = key.strip().split(".")
    for parent in parents:
        inner = table.setdefault(parent, {})
        if not isinstance(inner, dict):
            raise InputError(f"--set: {key}: '{parent}' is not a table; check the key")
        table = inner
    table[last] = value
