"""Ownership of output folders: the file MARK says which command fills one, and for which run or input."""

from pathlib import Path

from mi_refgs.errors import InputError
from mi_refgs.io.files import cannot_write, write_bytes

MARK = ".refgs"  # file of an output folder, with its owner
RUN = "run"  # owner of a run folder, in which every command writes
RUN_FILES = {
    *("config.toml", "dataset.json", "metrics.jsonl", "decisions.json", "exposure.json", "cameras.json"),
    *("surfels.ply", "mesh.ply", "surroundings.ply", "envmap.exr", "background.exr", "near_field.npz"),
    *("scene.xml", "model.json", "metrics.json", "contact_sheet.png", "edit.json", "checks.json"),
    "light.json",
}
"""What commands write in a run folder; a user's images and exports there have other names."""


def owner_of(folder: Path) -> str | None:
    """The owner that a folder names."""
    try:
        return (folder / MARK).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None


def require_own(folder: Path, owner: str) -> None:
    """Raise InputError for a folder of another owner, or with files besides hidden ones and no owner."""
    try:
        if (found := owner_of(folder)) == owner or not folder.exists():
            return
        if found is None and all(path.name.startswith(".") for path in folder.iterdir()):
            return
    except OSError as error:
        raise cannot_write(folder, error) from error
    what = "belongs to a run, which is never overwritten" if found == RUN else "has other files"
    raise InputError(what, folder, "output", "choose an empty folder, or a new one")


def own_folder(folder: Path, owner: str) -> None:
    """Make an output folder and write its owner there; raises InputError as `require_own` does."""
    require_own(folder, owner)
    write_bytes(folder / MARK, owner.encode())


def require_no_run(path: Path) -> None:
    """Raise InputError if a file that the user names as output is one that a run consists of."""
    if path.name in RUN_FILES and path.exists() and owner_of(path.parent) == RUN:
        what = "belongs to a run, which is never overwritten"
        raise InputError(what, path, "output", "choose another output")
