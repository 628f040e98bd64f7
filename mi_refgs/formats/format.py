"""Interface of the formats of other programs, their registry, and the function that writes them."""

import pkgutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from mi_refgs.errors import InputError, within
from mi_refgs.io.files import make_folder
from mi_refgs.io.ownership import own_folder, require_no_run
from mi_refgs.registry import Registry

if TYPE_CHECKING:
    from mi_refgs.data.view import FileCamera
    from mi_refgs.runs.trained_scene import TrainedScene
    from mi_refgs.splat.camera import Camera


@dataclass(frozen=True, eq=False)
class Shot:
    """A named camera, and the image file that was taken with it."""

    name: str  # of the image, without ending, such as "train/r_003"
    split: str  # "train" or "test"
    camera: "Camera"
    file: "FileCamera | None" = None  # where there is a data set; its path is relative to that


@dataclass(frozen=True)
class Option:
    """An option of formats: `--name` on the command line, a keyword of their `write` in Python."""

    name: str  # with underscores; the command line has hyphens
    default: Any  # int, float, str, or False for a switch
    help: str


@dataclass(frozen=True)
class Format:
    """A format that other programs read."""

    name: str
    summary: str  # one line, for `--help` and for the list of formats
    suffix: str  # of its file, such as ".ply"; empty for a format that writes a folder
    write: Callable[..., list[Path]] | str
    """write(trained, target, shots, **options), or MODULE:NAME of one of this package, imported when it is
    needed: writes the file or the folder `target` atomically and returns the paths that it wrote. `shots` (a
    sequence of Shot, never empty) are the cameras of the fit, the test views first. Raises InputError for a
    scene that the format cannot represent."""
    options: tuple[Option, ...] = ()
    extra: str = ""  # name of the extra that `pip install "mi_refgs[…]"` must have installed

    @property
    def writer(self) -> Callable[..., list[Path]]:
        if not isinstance(self.write, str):
            return self.write
        return cast(Any, pkgutil.resolve_name(f"mi_refgs.formats.{self.write}"))


FORMATS: Registry[Format] = Registry("format", of=Format)  # every format by name
register = FORMATS.register


def options_of(names: Iterable[str]) -> dict[str, Option]:
    """Return the options of some formats by name."""
    return {option.name: option for name in names for option in FORMATS[name].options}


def write(
    trained: "TrainedScene",
    names: Sequence[str],
    output: Path,
    shots: Sequence[Shot],
    options: Mapping[str, Any] | None = None,
    source: Path | None = None,
) -> dict[str, list[Path]]:
    """Write a scene in one format at `output`, or in several in that folder; return the files by format.

    `options` are keywords of the formats; each format gets those that it declares. A file that `output` names
    is replaced; a folder has to be empty, or filled for the same `source`, a run folder. Raises InputError
    for unknown formats, an option that none of them has, a scene that one cannot represent, a bad path."""
    chosen, given = [FORMATS.find(name, "--to") for name in names], dict(options or {})
    if not chosen:
        raise InputError("no format", "--to", remedy=f"use one of {', '.join(FORMATS)}")
    for name in given.keys() - options_of(names):
        able = ", ".join(made.name for made in FORMATS.values() if name in [o.name for o in made.options])
        remedy = f"leave it out, or choose a format that has it ({able or 'none'})"
        raise InputError(f"no option of {', '.join(names)}", f"--{name.replace('_', '-')}", remedy=remedy)
    from mi_refgs.data.dataset import require_no_data

    found, shots, owner = {}, tuple(shots), f"export of {source and source.resolve()}"
    output, several = Path(output), len(chosen) > 1
    if several:
        own_folder(output, owner)
    for made in chosen:
        target = output
        if several or (made.suffix and (output.is_dir() or not output.suffix)):
            target = output / f"{made.name}{made.suffix}"
        elif made.suffix and output.suffix.lower() != made.suffix:
            raise InputError(f"{made.name} writes {made.suffix}", output, "suffix", "name the file so")
        make_folder(target.parent)
        own = {option.name: given.get(option.name, option.default) for option in made.options}
        if made.suffix and target == output:
            require_no_run(target)
            require_no_data(target)
        else:
            own_folder(target.parent if made.suffix else target, owner)
        with within(target):
            found[made.name] = made.writer(trained, target, shots, **own)
    return found
