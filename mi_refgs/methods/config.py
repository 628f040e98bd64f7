"""A method as data: frozen dataclasses, read strictly from the TOML files of `variants/`.

Iteration numbers in a file are written for the file's own `iterations`; a preset gives the number to run, and
every window, stage and interval is scaled with it. No other module opens a TOML or knows a method's name.
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
import types
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tomli_w

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.errors import InputError, shown
from mi_refgs.files import is_file
from mi_refgs.resources import resource_dir

MAX_TEXT, MAX_LINE = 2**16, 2000
"""Characters of a method and of one of its lines: a parser's time grows with the square of a dotted key."""
TIE = 1e-6
"""Intervals by which a scaled window may miss a multiple of its interval for the rounding of floats."""


@dataclass(frozen=True)
class Window:
    """Events at the multiples of `every` with start < multiple ≤ until, each at the nearest iteration.

    In iterations, but not whole ones: a preset scales them, and rounded they would hold another number of
    events. Events that fall on one iteration (`every` below 1) happen once.
    """

    start: float
    until: float
    every: float

    def __post_init__(self) -> None:
        """Raise ValueError for an interval that is not positive, and for infinities and NaN."""
        if not self.every > 0 or not math.isfinite(self.start + self.until + self.every):
            raise ValueError("expected finite numbers and an 'every' above 0; correct the window")

    def due(self, iteration: int) -> bool:
        """Whether an event falls on this (1-based) iteration."""
        return self.count(iteration) > self.count(iteration - 1)

    def count(self, iteration: int) -> int:
        """Events up to and including this iteration."""
        return max(self._newest(iteration) - math.floor(self.start / self.every + TIE), 0)

    def since(self, iteration: int) -> int | None:
        """Iterations since the last event before this one; None if there was none yet."""
        if not self.count(iteration - 1):
            return None
        return iteration - math.floor(self._newest(iteration - 1) * self.every + 0.5)

    def _newest(self, iteration: int) -> int:
        """The largest k ≤ until / every for which k · every rounds to this iteration or one before."""
        return min(math.ceil((iteration + 0.5) / self.every) - 1, math.floor(self.until / self.every + TIE))


@dataclass(frozen=True)
class About:
    """What the file stands for."""

    name: str = ""
    paper: str = ""
    deviations: tuple[str, ...] = ()


@dataclass(frozen=True)
class SurfelOptions:
    """The table of surfels at the start, and its limits."""

    channels: tuple[str, ...] = ("radiance_sh", "albedo", "metallic", "roughness", "indirect_sh")
    count: int = 20_000  # initial surfels
    max_count: int = 40_000  # densification stops here
    inside: float = 0.0  # share of the initial surfels in the visual hull's volume; the others on its surface
    sh_degree: int = 3  # of the radiance channel
    indirect_degree: int = 3  # of the indirect channel, from the start
    sh_raise: Window = Window(0, 3, 1)  # one more degree each time it is due
    opacity: float = 0.1  # initial, activated
    metallic: float = 0.01
    roughness: float = 0.1


@dataclass(frozen=True)
class LightOptions:
    """The learnable lat-long environment; absent channels and light cost nothing."""

    height: int = 64  # texels; width is twice that
    radiance: float = 0.5  # initial, everywhere


@dataclass(frozen=True)
class Stage:
    """One stretch of the schedule with its own way to shade, up to and including iteration `until`."""

    until: int
    at: Literal["surfel", "pixel"] = "pixel"
    reflectance: Literal["radiance", "split_sum"] = "split_sum"
    diffuse: Literal["sh", "irradiance"] = "sh"
    reset_materials: bool = False  # albedo, metallic and roughness start anew when the stage begins


@dataclass(frozen=True)
class Refine:
    """Adaptive control of the table [3DGS §5.2, 2DGS; Ref-Gaussian §3.4]."""

    densify: Window | None = None
    gradient: float = 2e-4  # NDC units; a mean over views, which no number of iterations changes
    dense_extent: float = 0.01  # clone below, split above, in scene extents
    prune_opacity: float = 0.05
    prune_extent: float = 0.1  # scene extents; larger surfels go
    reset: Window | None = None  # opacity to at most reset_opacity, metallic to at least its initial value
    reset_opacity: float = 0.01
    propagate: Window | None = None  # material-aware normal propagation
    propagate_opacity: float = 0.9
    propagate_scale: float = 1.5
    propagate_metallic: float = 0.02  # surfels at least this metallic …
    propagate_roughness: float = 0.1  # … and at most this rough are enlarged
    propagate_hold: int = 200  # iterations without opacity learning afterwards


@dataclass(frozen=True)
class MeshOptions:
    """Extraction of the occluding mesh, when due."""

    extract: Window = Window(20_000, 50_000, 2_000)
    resolution: int = 128  # voxels along the longest side


@dataclass(frozen=True)
class LossWeights:
    """L = (1 - ssim) L1 + ssim (1 - SSIM) + normal L_n + smooth L_s + alpha L_α."""

    ssim: float = 0.2
    normal: float = 0.05
    normal_rise: int = 0  # iterations in which the weight of L_n rises linearly from 0
    smooth: float = 0.0
    smooth_until: int = 18_000
    alpha: float = 0.0


@dataclass(frozen=True)
class Rates:
    """Adam learning rates, raw units per step; position in scene extents."""

    position: float = 1.6e-4
    position_final: float = 1.6e-6
    rotation: float = 1e-3
    scale: float = 5e-3
    opacity: float = 0.05
    radiance_sh: float = 7.5e-3
    albedo: float = 7.5e-3
    metallic: float = 5e-3
    roughness: float = 5e-3
    indirect_sh: float = 7.5e-3
    sh_rest: float = 0.05  # factor of the higher degrees of radiance
    indirect_rest: float = 0.05  # … of the indirect channel
    light: float = 0.01
    decay: float = 1.0  # factor that all but the position's rate reach, log-linearly, at the last iteration


@dataclass(frozen=True)
class DataOptions:
    """How pictures are read."""

    images: Literal["png", "exr"] = "png"
    background: Literal["white", "black"] = "white"
    downscale: int | None = None  # pixels of a file along a pixel's side; absent: what the preset can afford


@dataclass(frozen=True)
class Method:
    """Everything that describes a fit; the resolved copy is saved with the run."""

    iterations: int
    stage: dict[str, Stage]
    about: About = About()
    surfels: SurfelOptions = SurfelOptions()
    light: LightOptions | None = None
    refine: Refine = Refine()
    mesh: MeshOptions | None = None
    loss: LossWeights = LossWeights()
    rates: Rates = Rates()
    data: DataOptions = DataOptions()
    seed: int = 0
    checkpoint_every: int = 1_000  # iterations; a kill loses at most so many
    preview_every: int = 1_000
    log_every: int = 50
    variant: str = ""  # filled in by `load`: the file's stem
    preset: str = ""

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError("iterations: less than 1; give how many to run")

    def stages(self) -> list[tuple[str, Stage]]:
        """Stages in the order of their `until`."""
        return sorted(self.stage.items(), key=lambda item: item[1].until)

    def stage_at(self, iteration: int) -> tuple[str, Stage]:
        """The stage a (1-based) iteration belongs to."""
        return next((item for item in self.stages() if iteration <= item[1].until), self.stages()[-1])


@dataclass(frozen=True)
class Preset:
    """How long to run, and how large to grow."""

    iterations: int
    surfels: int
    max_surfels: int
    pixels: int  # of a picture; larger ones are read smaller, so that the preset takes its time


# About 4 and 11 minutes for 200² pictures on one AVX-512 core; the last follows from these. A step of 256²
# pixels takes 1.14 times as long as one of 200², one of 400² 1.9 times; the paper's pictures have 800².
PRESETS = {
    "quick": Preset(2_000, 15_000, 20_000, 256 * 256),
    "standard": Preset(4_000, 25_000, 40_000, 256 * 256),
    "paper": Preset(50_000, 30_000, 100_000, 800 * 800),
}

# Fields that count iterations, and so scale with the preset, as windows do.
_SCALED = {"iterations", "until", "normal_rise", "smooth_until", "propagate_hold"}


def load(variant: str, preset: str = "standard", assignments: list[str] | None = None) -> Method:
    """Read a method by name or TOML path, apply `key=value` assignments, and scale it to a preset.

    Raises InputError naming the file and the key for anything unknown or of the wrong type.
    """
    if preset not in PRESETS:
        raise InputError(f"--preset: {preset}: unknown; use one of {', '.join(PRESETS)}")
    path = _find(variant, "--variant", Path())
    table = _extended(path, [])
    chosen = PRESETS[preset]
    method = _build(Method, table, str(path))
    method = _scale(method, chosen.iterations / method.iterations)
    table = _plain(method)
    table["surfels"] |= {"count": chosen.surfels, "max_count": chosen.max_surfels}
    for assignment in assignments or []:
        _assign(table, assignment)
    where = "--set" if assignments else str(path)
    return _shadable(_build(Method, table | {"variant": path.stem, "preset": preset}, where), str(path))


def _shadable(method: Method, where: str) -> Method:
    """The method; raises InputError naming the stage that its channels and its light cannot serve."""
    from mi_refgs.render.pipeline import MATERIALS, Shading
    from mi_refgs.surfels.table import CHANNELS, GEOMETRY

    channels = {*GEOMETRY, *method.surfels.channels}
    if unknown := [name for name in method.surfels.channels if name not in CHANNELS]:
        raise InputError(
            f"{where}: surfels.channels: '{unknown[0]}' is unknown; use some of {', '.join(CHANNELS)}"
        )
    for name, stage in method.stages():
        try:
            Shading.of(stage, method.mesh is not None).check(channels, method.light is not None)
        except InputError as error:
            raise InputError(f"{where}: stage.{name}: {error}") from error
        if stage.reset_materials and not channels.issuperset(MATERIALS):
            raise InputError(f"{where}: stage.{name}: reset_materials: there are no materials; remove it")
    return method


def load_resolved(path: Path) -> Method:
    """Read the resolved `config.toml` of a run, unscaled."""
    return _build(Method, _read(path), str(path))


def dump(method: Method) -> str:
    """The method as TOML text that `load_resolved` reads back."""
    return tomli_w.dumps(_plain(method))


def names() -> list[str]:
    """The methods that ship with the package."""
    return sorted(path.stem for path in resource_dir("variants").glob("*.toml"))


def _find(variant: str, where: str, folder: Path) -> Path:
    """A shipped method by its name, or a path to a .toml from `folder`; `where` names what asks for it."""
    path = folder / variant if variant.endswith(".toml") else resource_dir("variants") / f"{variant}.toml"
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
            f"{path}: extends: expected a name or a path in quotes, found {shown(base)}; correct it"
        )
    if not isinstance(dropped, list) or not all(isinstance(name, str) for name in dropped):
        raise InputError(f"{path}: drop: expected a list of keys, such as ['mesh', 'loss.alpha']; correct it")
    parent = _extended(_find(base, f"{path}: extends", path.parent), [*above, path.resolve()])
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


def _scale(value: Any, factor: float, key: str = "") -> Any:
    """Scale every field that counts iterations: windows exactly, others to a whole number of at least 1."""
    if isinstance(value, dict):
        return {name: _scale(inner, factor) for name, inner in value.items()}
    if isinstance(value, Window):
        return Window(factor * value.start, factor * value.until, factor * value.every)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: _scale(getattr(value, f.name), factor, f.name) for f in dataclasses.fields(value)}
        return dataclasses.replace(value, **fields)
    if key in _SCALED:
        return max(round(value * factor), 1) if value > 0 else value
    return value


def _build(kind: Any, value: Any, where: str) -> Any:
    """Turn plain TOML data into `kind`, strictly; `where` names the file and the key so far."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        if not isinstance(value, dict):
            raise InputError(
                f"{where}: expected a table, found {shown(value)}; the files of variants/ show the form"
            )
        hints = typing.get_type_hints(kind)
        for key in value:
            if key not in hints:
                raise InputError(f"{where}: unknown key '{key}'; use one of {', '.join(hints)}")
        needed = [f.name for f in dataclasses.fields(kind) if f.default is dataclasses.MISSING]
        missing = [name for name in needed if name not in value]
        if missing:
            raise InputError(f"{where}: missing key '{missing[0]}'; add it")
        make: Any = kind
        fields = {key: _build(hints[key], inner, f"{where}: {key}") for key, inner in value.items()}
        try:
            return make(**fields)
        except ValueError as error:
            raise InputError(f"{where}: {error}") from error
    if origin in (types.UnionType, typing.Union):
        return _build(next(option for option in arguments if option is not type(None)), value, where)
    if origin is dict:
        if not isinstance(value, dict) or not value:
            raise InputError(f"{where}: expected at least one named table; add one")
        return {key: _build(arguments[1], inner, f"{where}.{key}") for key, inner in value.items()}
    if origin is tuple:
        if not isinstance(value, list):
            raise InputError(f"{where}: expected a list, found {shown(value)}; write it in brackets")
        return tuple(_build(arguments[0], inner, where) for inner in value)
    if origin is Literal:
        if not isinstance(value, str) or value not in arguments:
            known = ", ".join(map(str, arguments))
            raise InputError(f"{where}: {shown(value)} is not allowed; use one of {known}")
        return value
    if type(value) in (int, float) and not abs(value) <= MAX_NUMBER:
        raise InputError(f"{where}: {shown(value)} is out of range; correct the value")
    if kind is float and type(value) is int:
        return float(value)
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise InputError(f"{where}: expected {kind.__name__}, found {shown(value)}; correct the value")
    return value


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        pairs = ((f.name, getattr(value, f.name)) for f in dataclasses.fields(value))
        return {name: _plain(inner) for name, inner in pairs if inner is not None}
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, tuple):
        return [_plain(inner) for inner in value]
    return value
