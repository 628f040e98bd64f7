"""What commands share: options, results, and the set-up of Mitsuba. A command is a frozen dataclass whose
fields are its options (tyro reads names, types, defaults, and comments beside them or strings below; one is
`common`, a `Common`), with a method `run` that returns a `Result`."""

import math
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, UseAppendAction, arg

from mi_refgs import llvm
from mi_refgs.constants import DEFAULT_PRESET
from mi_refgs.errors import InputError, require_between
from mi_refgs.io.files import resource_dir
from mi_refgs.registry import load_plugins


def optional(metavar: str | None = None, hint: str = "", **more: Any) -> Any:
    """An option whose help, or `hint`, states what happens without it."""
    return arg(metavar=metavar, help_behavior_hint=hint, **more)


Flag = Annotated[bool, optional()]

RunFolder = Annotated[Positional[Path], arg(metavar="RUN", help="run folder of `refgs train`")]
Output = Annotated[Path, arg(aliases=("-o",), metavar="PATH")]
OptionalOutput = Annotated[Path | None, optional("PATH", aliases=("-o",))]
OtherData = Annotated[Path | None, optional("DATA", help="data set (default: that of the fit)")]
Cameras = Annotated[Path | None, optional("FILE.json")]
_SAMPLES_HELP = "samples per pixel, box filter: 4 are 2 × 2; 1 is the pixel centre, as in a fit"
Samples = Annotated[int, arg(metavar="N", help=_SAMPLES_HELP)]
Settings = Annotated[
    UseAppendAction[tuple[tuple[str, ...], ...]],
    optional("KEY=VALUE …", help="changes of the method, such as loss.ssim=0.1"),
]  # `sum(self.set, ())` joins the lists of a repeated option
METHODS = ", ".join(sorted(path.stem for path in resource_dir("variants").glob("*.toml")))
_METHOD_HELP = f"method (default: auto, what the scene needs of the full method): {METHODS}, or a file"
MethodName = Annotated[str | None, optional("NAME|FILE.toml", help=_METHOD_HELP)]
_PRESET_HELP = f"length of the fit, or its ITERATIONS:SURFELS (default: {DEFAULT_PRESET})"
Preset = Annotated[str | None, optional("{quick,standard,paper}|N:N", help=_PRESET_HELP)]


def separated(values: Iterable[str]) -> list[str]:
    """Split list items at commas."""
    return [part.strip() for value in values for part in value.split(",") if part.strip()]


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of every command."""

    json: Flag = False  # print one JSON object on standard output and nothing else there
    plugin: Annotated[UseAppendAction[tuple[Path, ...]], optional("FILE.py")] = ()
    """run a Python file that registers models, losses and the like; may be repeated"""

    def prepare(self) -> None:
        """Load plugins, those of installed packages too; raises InputError for one that fails."""
        load_plugins(self.plugin)


@dataclass(frozen=True, kw_only=True)
class Rendering(Common):
    """Options of commands that run kernels."""

    mitsuba_variant: Annotated[str, arg(metavar="NAME")] = "llvm_ad_rgb"  # Mitsuba variant
    threads: Annotated[int | None, optional("N", "(default: all cores)")] = None
    """worker threads; with 1, training is reproducible bit for bit"""

    def prepare(self) -> None:
        """Set threads and variant; raises InputError for unusable ones, UnusableError for a missing LLVM."""
        import drjit as dr
        import mitsuba as mi

        variant = self.mitsuba_variant
        usable = [name for name in mi.variants() if name.endswith("_ad_rgb")]
        if variant not in usable:
            what, remedy = f"{variant}: cannot be used", f"give one of {', '.join(usable)}"
            raise InputError(what, "--mitsuba-variant", remedy=remedy)
        if self.threads is not None:
            require_between(self.threads, "--threads", 1, 4 * (os.cpu_count() or 1))
            dr.set_thread_count(self.threads)
        try:
            mi.set_variant(variant)
        except ImportError as error:
            problem = llvm.problem() if variant.startswith("llvm") else None
            raise UnusableError(f"{problem or error} (`refgs doctor` says more)") from error
        mi.set_log_level(mi.LogLevel.Warn)
        super().prepare()


@dataclass(frozen=True)
class Result:
    """Result of a command: `data` for `--json`, `text` otherwise, and the exit code."""

    data: dict[str, Any]
    text: str
    code: int = 0


class UnusableError(Exception):
    """This installation cannot run the command; the message names what to install."""


def finite(value: Any) -> Any:
    """Replace NaN and infinities, which JSON does not have, by None."""
    if isinstance(value, dict):
        return {key: finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
