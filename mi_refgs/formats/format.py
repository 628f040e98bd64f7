"""The seam of formats: what one declares, the cameras that it is given, and the registry of all.

The command line reads the declarations before it runs anything: the files of formats import what computes
inside their functions.
"""

from __future__ import annotations

import importlib
import os
import tempfile
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_refgs.errors import InputError
from mi_refgs.io.files import cannot_write, make_folder
from mi_refgs.io.ownership import OutputFolder, require_no_run

if TYPE_CHECKING:
    from mi_refgs.data.view import FileCamera
    from mi_refgs.runs.trained_scene import TrainedScene
    from mi_refgs.splat.camera import Camera


@dataclass(frozen=True, eq=False)
class Shot:
    """A camera by name."""

    name: str  # of its picture, without ending, such as "train/r_003"
    split: str  # "train" or "test"
    camera: Camera
    file: FileCamera | None = None  # of its picture, where there is a data set; the path is relative to that


@dataclass(frozen=True)
class Option:
    """A choice that a format leaves to its user: `--name` on the command line, a keyword of `write`.

    Formats may share one, which is then the same in all of them.
    """

    name: str  # with underscores; the command line has hyphens
    default: Any  # int, float, str, or False for a switch
    help: str


@dataclass(frozen=True)
class Format:
    """A format that other programs read: one file of this package declares one, and `register`s it."""

    name: str
    summary: str  # one line, for `--help` and for the list of formats
    suffix: str  # of its file, such as ".ply"; empty for a format that writes a folder
    write: Callable[..., list[Path]]
    """write(trained, target, shots, **options): writes the file or the folder `target`, atomically, and
    returns the paths of what it wrote. `shots` (a sequence of Shot, never empty) are the cameras of the fit,
    the test views first. Raises InputError for a scene that the format cannot hold."""
    options: tuple[Option, ...] = ()
    extra: str = ""  # that `pip install "mi_refgs[…]"` must have installed


FORMATS: dict[str, Format] = {}
"""Every format by name."""


def register(made: Format) -> Format:
    """Make a format known to `refgs export --to` and `Reconstruction.export`; returns it.

    Raises InputError if another one has its name, or declares one of its options otherwise.
    """
    if made.name in FORMATS:
        raise InputError(f"formats: '{made.name}': there is one of this name; rename it")
    shared = options_of(FORMATS)
    for option in made.options:
        if shared.get(option.name, option) != option:
            raise InputError(f"formats: '{made.name}': {option.name}: another format's differs; rename it")
    FORMATS[made.name] = made
    return made


def module(name: str) -> Any:
    """A module of the extra `export`; raises InputError that says how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(f'--to: {name} is not installed; pip install "mi_refgs[export]"') from None


def options_of(names: Sequence[str] | Mapping[str, Format]) -> dict[str, Option]:
    """The options of some formats by name."""
    return {option.name: option for name in names for option in FORMATS[name].options}


def format_of(name: str) -> Format:
    """The format of this name; raises InputError if there is none."""
    if name not in FORMATS:
        raise InputError(f"--to: {name}: unknown format; use one of {', '.join(FORMATS)}")
    return FORMATS[name]


def place(made: Format, output: Path, several: bool) -> Path:
    """Where a format is written: at `output`, or in it if it is a folder or several formats are written.

    Raises InputError for a file name of another suffix, or a folder that cannot be made.
    """
    inner = several or output.is_dir() or (bool(made.suffix) and not output.suffix)
    if inner:
        target = output / f"{made.name}{made.suffix}"
    else:
        target = output
        if made.suffix and target.suffix.lower() != made.suffix:
            raise InputError(f"{output}: suffix: {made.name} writes {made.suffix}; name the file so")
    make_folder(target.parent if made.suffix else target)
    return target


def write(
    trained: TrainedScene,
    names: Sequence[str],
    output: Path,
    shots: Sequence[Shot],
    options: Mapping[str, Any] | None = None,
    source: Path | None = None,
    overwrite: bool = False,
) -> dict[str, list[Path]]:
    """Write a scene in some formats: one at `output`, several in that folder; returns the files by format.

    `options` are keywords of the formats, each for those that declare it. The file that `output` names is
    replaced. In a folder, only files that the same format wrote of the same `source`, a run folder, are
    replaced, unless `overwrite` permits all. Raises InputError for an unknown format, an option that
    none of them has, a scene that one cannot hold, what cannot be written, and a foreign file in the way.
    """
    chosen, given = [format_of(name) for name in names], dict(options or {})
    if not chosen:
        raise InputError(f"--to: no format; use one of {', '.join(FORMATS)}")
    for name in given:
        if name not in options_of(names):
            able = ", ".join(f for f, made in FORMATS.items() if name in [o.name for o in made.options])
            flag = f"--{name.replace('_', '-')}"
            raise InputError(f"{flag}: means nothing to {', '.join(names)} ({able or 'no format'} has it)")
    found = {}
    remedy = "choose another output, or replace it with --overwrite (overwrite=True in Python)"
    for made in chosen:
        target = place(made, Path(output), len(chosen) > 1)
        owner = f"{made.name} of {source.resolve() if source else uuid.uuid4().hex}"
        own = {option.name: given.get(option.name, option.default) for option in made.options}
        if not made.suffix:
            folder = OutputFolder(target, owner, remedy=remedy, overwrite=overwrite)
            found[made.name] = _write_folder(made, folder, trained, shots, own)
            continue
        if target == Path(output):
            require_no_run(target)
        else:
            OutputFolder(target.parent, owner, remedy=remedy, overwrite=overwrite).claim(target.name)
        found[made.name] = made.write(trained, target, shots, **own)
    return found


def _write_folder(
    made: Format,
    output: OutputFolder,
    trained: TrainedScene,
    shots: Sequence[Shot],
    options: Mapping[str, Any],
) -> list[Path]:
    """Write a format beside `output`, then move its files there; none if a foreign one is in the way.

    Formats need not say beforehand which files they write. Raises InputError as `OutputFolder.claim` does.
    """
    try:
        with tempfile.TemporaryDirectory(prefix=".refgs_", dir=output.path) as name:
            stage = Path(name)
            listed = [path.relative_to(stage) for path in made.write(trained, stage, shots, **options)]
            files = [path.relative_to(stage) for path in stage.rglob("*") if path.is_file()]
            output.claim(*(path.as_posix() for path in files))
            for path in files:
                os.replace(stage / path, output.path / path)
    except OSError as error:
        raise cannot_write(output.path, error) from error
    return [output.path / path for path in listed]
