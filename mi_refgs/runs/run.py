"""The run folder: readable by other programs, written atomically, resumable.

config.toml  dataset.json  checks.json  metrics.jsonl  checkpoints/  previews/  written during the fit
surfels.ply  envmap.exr  mesh.ply  scene.xml  model.json                        by `runs.export`
metrics.json  contact_sheet.png  eval/                                          by `evaluation`"""

import json
import math
import os
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.region import Region
from mi_refgs.errors import InputError, UnknownNameError
from mi_refgs.io import files
from mi_refgs.io.ownership import RUN, own_folder, require_own
from mi_refgs.io.progress import warn
from mi_refgs.methods.method import Method
from mi_refgs.methods.read import dump, load_resolved
from mi_refgs.registry import load_again
from mi_refgs.runs import checkpoint

DATASET = "dataset.json"  # the folder of the data set, and its region of interest
DATA = "data"  # folder of the views that an import rendered
CAMERAS = "cameras.json"  # corrected poses of the training views, where they were corrected
DECISIONS = "decisions.json"  # about components of the method
EXPOSURE = "exposure.json"  # gains of the training views
LOCK = ".refgs.lock"  # exists, and is locked, while a process changes the run
LOG = "metrics.jsonl"  # the training log; other logs of a run are other .jsonl files
CONFIG = "config.toml"
RELIT = "relight.json"  # of a folder that `refgs relight` wrote, which is no run


class Run:
    """A run folder."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def exists(self) -> bool:
        return (self.path / CONFIG).is_file()

    def require_none(self) -> None:
        """Raise InputError if the folder contains a run or other files."""
        if (self.path / CONFIG).exists():
            remedy = "continue it with `refgs train --resume`, or choose another -o"
            raise InputError("contains a run already", self.path, remedy=remedy)
        require_own(self.path, RUN)

    def alone(self, wait: float = 0.0) -> AbstractContextManager[None]:
        """Lock the run for changes; raises BusyError if another process has it locked for `wait` seconds."""
        busy = "another process trains this run or writes it; wait until it ends, or choose another folder"
        return files.locked(self.path / LOCK, f"{self.path}: run folder: {busy}", wait)

    def create(
        self,
        method: Method,
        dataset: str | None,
        region: Region | None = None,
        images: dict[str, str] | None = None,
        offset: Sequence[float] | None = None,
    ) -> None:
        """Start a run on the data set in folder `dataset`, None in memory; raises as `require_none`."""
        self.require_none()
        own_folder(self.path, RUN)
        self._make_folders()
        self.write_dataset(dataset, region, images, offset)
        self.write_method(method)

    def write_dataset(
        self,
        dataset: str | None,
        region: Region | None,
        images: dict[str, str] | None = None,
        offset: Sequence[float] | None = None,
    ) -> None:
        """Record folder and region of a data set; digests of images and its offset, by default as before."""
        record: dict[str, Any] = {"path": dataset, "images": self.images() if images is None else images}
        record["offset"] = self.offset() if offset is None else [*offset]
        if region is not None:
            began = self.record(DATASET).get("began", region.content)  # before it followed the object
            record |= {"region": region.content, "began": began}
        files.write_bytes(self.path / DATASET, json.dumps(record).encode())

    def write_method(self, method: Method) -> None:
        files.write_bytes(self.path / CONFIG, dump(method).encode())

    def method(self) -> Method:
        """The resolved method; raises InputError if this is no run folder."""
        if not self.exists():
            remedy = "give the folder that `refgs train -o` wrote"
            if (self.path / RELIT).is_file():
                remedy = "it is a relit scene: give its run; in Python, load(RUN).relight(…) exports one"
            raise InputError("missing", self.path, CONFIG, remedy)
        return load_resolved(self.path / CONFIG)

    def record(self, name: str) -> dict[str, Any]:
        """The content of a JSON file of the run; {} without it."""
        return files.read_json(self.path / name) if (self.path / name).is_file() else {}

    def images(self) -> dict[str, str]:
        """Digests of the images and cameras that the run began with, by name; none of older runs."""
        return dict(self.record(DATASET).get("images") or {})

    def offset(self) -> Sequence[float] | None:
        """What was subtracted from positions of the data set (`Dataset.offset`), if the run records it."""
        return self.record(DATASET).get("offset")

    def dataset(self) -> Path | None:
        """Folder of the data set that the run was fitted to, if it records one; raises InputError if not."""
        if (path := self.record(DATASET).get("path")) is None:
            return None
        try:
            os.path.realpath(path)
            own = self.path / DATA  # of an import, whose folder may have another name now
            moved = not os.path.isdir(path) and Path(path).name == DATA and own.is_dir()
            return own if moved else Path(path)
        except (OSError, TypeError, ValueError) as error:
            remedy = "write the folder of the data set there"
            raise InputError(f"cannot be used ({error})", self.path / DATASET, "path", remedy) from error

    def region(self, began: bool = False) -> Region | None:
        """The region of interest, or that of the first step; raises InputError if it cannot be used."""
        found = self.record(DATASET).get("began" if began else "region")
        return None if found is None else Region.of(found, self.path / DATASET)

    def decisions(self) -> list[dict[str, Any]]:
        """The decisions about components of the method so far; raises InputError if they cannot be read."""
        path = self.path / DECISIONS
        try:
            return list(json.loads(path.read_bytes())) if path.is_file() else []
        except (OSError, ValueError, TypeError) as error:
            raise InputError(f"cannot be read ({error})", path, remedy="restore it") from error

    def checkpoints(self) -> list[Path]:
        """Complete checkpoints, oldest first."""
        return sorted(x for x in (self.path / "checkpoints").glob("*.npz") if x.stem.isdecimal())

    def save_checkpoint(self, iteration: int, state: dict[str, np.ndarray]) -> None:
        """Save a state, then remove all but the newest two: a disk may lose writes. Raises InputError."""
        files.write_bytes(self.path / "checkpoints" / f"{iteration:07d}.npz", checkpoint.encode(state))
        for old in self.checkpoints()[:-2]:
            old.unlink(missing_ok=True)

    def load_checkpoint(self) -> dict[str, np.ndarray] | None:
        """The newest undamaged checkpoint, None if there is none; damaged ones are named on stderr. Raises
        InputError if all are, and for an attribute that is not registered."""
        damaged = []
        for path in reversed(self.checkpoints()):
            try:
                return checkpoint.decode(path.read_bytes())
            except UnknownNameError as error:
                raise load_again(error, self.method().plugins).at(path) from error
            except (OSError, checkpoint.DamagedError) as error:
                what = f"cannot be read: {error.strerror}" if isinstance(error, OSError) else error
                damaged.append(f"{path}: damaged ({what})")
                warn(f"{damaged[-1]}; trying the one before")
        if damaged:
            remedy = f"put a copy back, or remove {self.path / 'checkpoints'} to begin anew"
            raise InputError(f"{damaged[0]}, and no checkpoint before it is whole", remedy=remedy)
        return None

    def rewind(self, iteration: int) -> None:
        """Remove checkpoints and lines of the logs of later iterations, and files of killed processes."""
        self._make_folders()
        for folder in (self.path, self.path / "checkpoints", self.path / "previews"):
            for path in folder.iterdir():  # that killed processes have left
                if files.TEMPORARY.fullmatch(path.name):
                    path.unlink(missing_ok=True)
        for path in self.checkpoints():
            if int(path.stem) > iteration:
                path.unlink()
        for log in self.path.glob("*.jsonl"):
            text = log.read_text(encoding="utf-8", errors="replace")
            kept = [line for line in text.splitlines() if _logged(line) <= iteration]
            files.write_bytes(log, "".join(f"{line}\n" for line in kept).encode())

    def log(self, line: dict[str, Any]) -> None:
        """Append a JSON line with an `iteration` to the log, with null for numbers that are not finite."""
        path = self.path / LOG
        line = {k: None if isinstance(x, float) and not math.isfinite(x) else x for k, x in line.items()}
        try:
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
        except OSError as error:
            raise files.cannot_write(path, error) from error

    def write_json(self, name: str, content: Any) -> None:
        files.write_json(self.path / name, content, indent=2)

    def _make_folders(self) -> None:
        for name in ("checkpoints", "previews"):
            files.make_folder(self.path / name)


def _logged(line: str) -> float:
    """The iteration of a line; infinity for an incomplete one of a killed process."""
    try:
        return float(json.loads(line)["iteration"])
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return math.inf
