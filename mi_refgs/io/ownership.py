"""Ownership of files in output folders: which command wrote each file.

One rule for all commands: a file that the user names (`-o view.exr`) is replaced, unless it belongs to a run.
In an output folder, a command replaces and removes only files that it wrote itself for the same run or
input; RECORD lists them. If any other file is in the way, the command refuses before it changes anything.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from mi_refgs.errors import InputError
from mi_refgs.io.files import cannot_write, make_folder

RECORD = ".refgs"
"""File of an output folder: lines of JSON, each with an owner and its files. Lines are only appended, so that
two processes lose none of each other's."""
RUN = "run"  # owner of the files of a run folder, whichever command wrote them


@dataclass
class OutputFolder:
    """A folder that a command fills, and the owner of the files that it writes."""

    path: Path
    owner: str  # command and run or input; files of other owners are not replaced
    files: tuple[str, ...] = ()  # glob patterns of all files that the command may write
    marker: str = ""  # file by which a folder without RECORD is recognised as filled by this command
    remedy: str = "move it away, or choose another output folder"
    overwrite: bool = False  # replace files of other owners, except those of a run
    _claimed: set[str] = field(default_factory=set, init=False, repr=False)

    def owners(self) -> dict[str, str]:
        """Owner of each recorded file, by its path relative to the folder.

        All `files` of a folder with `marker` but without RECORD, which an earlier version filled, are the
        owner's.
        """
        try:
            lines = (self.path / RECORD).read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError:
            marked = bool(self.marker) and (self.path / self.marker).is_file()
            return dict.fromkeys(self._present(), self.owner) if marked else {}
        found: dict[str, str] = {}
        for line in lines:
            with contextlib.suppress(ValueError, KeyError, TypeError):  # half a line of a killed process
                entry = json.loads(line)
                found |= {str(name): str(entry["owner"]) for name in entry["files"]}
        return found

    def require_free(self, names: Iterable[str] | None = None) -> None:
        """Raise InputError if one of these files, by default any of `files`, exists and has another owner."""
        owners = self.owners()
        for name in self._present() if names is None else names:
            owner = owners.get(name)
            if owner == self.owner or not os.path.lexists(self.path / name):
                continue
            if owner == RUN:
                raise InputError(
                    "belongs to a run, which is never overwritten",
                    self.path / name,
                    "output",
                    "choose another output",
                )
            if not self.overwrite:
                raise InputError(
                    "exists, and was not written by this command for the same input",
                    self.path / name,
                    "output",
                    self.remedy,
                )

    def claim(self, *names: str) -> None:
        """Record files as the owner's before they are written, and make their folders.

        Raises InputError as `require_free` does, before anything is changed, and for a folder that cannot be
        written.
        """
        new = [name for name in names if name not in self._claimed]
        if not new:
            return
        self.require_free(new)
        owners = self.owners()
        make_folder(self.path)
        for folder in {(self.path / name).parent for name in new}:
            make_folder(folder)
        record = self.path / RECORD
        mine = [name for name in new if owners.get(name) != self.owner]
        if not record.exists():  # of an earlier version
            mine += [name for name in owners if name not in mine]
        try:
            if mine:
                line = json.dumps({"owner": self.owner, "files": sorted(mine)})
                with record.open("a", encoding="utf-8") as file:
                    file.write(f"\n{line}\n")  # after half a line of a killed process, too
        except OSError as error:
            raise cannot_write(self.path, error) from error
        self._claimed.update(new)

    def own(self, name: str) -> Path:
        """Claim a file that is written next, and return its path; raises InputError as `claim` does."""
        self.claim(name)
        return self.path / name

    def owned(self, pattern: str) -> list[Path]:
        """Existing files of the owner that match a pattern."""
        owners = self.owners()
        found = sorted(self.path.glob(pattern))
        return [path for path in found if owners.get(path.relative_to(self.path).as_posix()) == self.owner]

    def remove(self, names: Iterable[str]) -> None:
        """Remove files; raises InputError as `require_free` does, before anything is removed."""
        names = [*names]
        self.require_free(names)
        try:
            for name in names:
                (self.path / name).unlink(missing_ok=True)
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def _present(self) -> list[str]:
        found = (path for pattern in self.files for path in sorted(self.path.glob(pattern)))
        return [path.relative_to(self.path).as_posix() for path in found]


def require_no_run(path: Path) -> None:
    """Raise InputError if a file that the user names as output belongs to a run."""
    OutputFolder(path.parent, "", overwrite=True).require_free([path.name])
