"""The folder of a data set: which files in it the last capture wrote, so that the next removes no others.

The file RECORD lists them, and marks the folder as one that a capture may write to.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from mi_refgs.errors import InputError
from mi_refgs.io.files import (
    TEMPORARY,
    cannot_write,
    inside,
    is_file,
    read_json,
    remove_temporaries,
    write_json,
)

WORK = ".work"
"""Folder of working copies, features, matches and models, which may be removed when all is done."""
RECORD = ".capture.json"
"""Key and names of the files of the last output."""
LAST = "sparse/0/images.bin"
"""The file that is removed first and written last: without it the folder is no data set."""


def prepare(folder: Path, sources: Sequence[Path]) -> None:
    """Make or accept the folder of a data set made of what lies in the folders `sources`.

    Raises InputError for a folder that holds or contains a source, that holds something else than a capture,
    and that cannot be written.
    """
    real = folder.resolve()
    for source in sources:
        if real in (source.resolve(), *source.resolve().parents):
            raise InputError(
                f"{folder}: output: the files of {source} are read, and lie in it; choose another folder"
            )
    try:
        empty = not folder.is_dir() or not any(folder.iterdir())
        if not (empty or (is_file(folder / RECORD) and "files" in read_json(folder / RECORD))):
            raise InputError(f"{folder}: output: not empty, and no capture; choose another folder")
        (folder / WORK).mkdir(parents=True, exist_ok=True)
        remove_temporaries(folder)
        if empty:
            write_json(folder / RECORD, {"key": None, "files": []})
    except OSError as error:
        raise cannot_write(folder, error) from error


def holds(folder: Path, key: str) -> bool:
    """Whether the folder has all files of the output with this key."""
    recorded, files = _read(folder)
    return recorded == key and all(is_file(folder / name) for name in files)


def replace_output(folder: Path, made: Path, key: str) -> None:
    """Move the files below `made` to their places in the folder; those of the last output are removed.

    An interrupted call is completed by another one. Raises InputError, and changes nothing, where a file has
    the place of another that no capture wrote; and where the folder cannot be written.
    """
    _, before = _read(folder)
    new = sorted(path.relative_to(made).as_posix() for path in made.rglob("*") if _whole(path))
    for name in sorted({*new} - {*before}):
        if os.path.lexists(folder / name):
            raise InputError(f"{folder / name}: output: not written by a capture; move it to another folder")
    try:
        write_json(folder / RECORD, {"key": None, "files": sorted({*before, *new})})
        for name in sorted(before, key=lambda name: name != LAST):
            (folder / name).unlink(missing_ok=True)
        for name in sorted(new, key=lambda name: name == LAST):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (made / name).rename(folder / name)
        for parent in {(folder / name).parent for name in before}:
            if parent.is_dir() and not any(parent.iterdir()):
                parent.rmdir()
    except OSError as error:
        raise cannot_write(folder, error) from error
    write_json(folder / RECORD, {"key": key, "files": new})


def _whole(path: Path) -> bool:
    """Whether this is a file, and none that a killed process has left half written."""
    return path.is_file() and not TEMPORARY.fullmatch(path.name)


def _read(folder: Path) -> tuple[str | None, list[str]]:
    """Key and files of the last output; names that lead out of the folder are left out."""
    content = read_json(folder / RECORD)
    files = content.get("files")
    names = [name for name in files if inside(folder, name)] if isinstance(files, list) else []
    return content.get("key"), names
