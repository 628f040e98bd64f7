"""Cells of the frontier: one fit each, and the files that store their results.

The file of a cell contains all that its result depends on: the resolved method, and hashes of the data set,
the code and the machine. A result is used again only if all of that is the same.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.common.report import Row
from benchmarks.common.view import ROOT
from mi_refgs import methods
from mi_refgs.errors import InputError
from mi_refgs.io.files import TEMPORARY, make_folder, read_json, write_json
from mi_refgs.kernels import device
from mi_refgs.methods.build import plain
from mi_refgs.methods.method import Method
from mi_refgs.runs.views import sized

SCORES = ("psnr", "ssim", "normal_mae_deg")
"""Means over the validation views; None where there is no ground truth."""
RESULTS = (
    *("cpu_seconds", "wall_seconds", "peak_bytes", "surfels", *SCORES),
    *("width", "height", "full_width", "full_height", "views", "validation_views"),
)
"""Numbers of a fit: times, memory and scores; pixels of its images and of validation images; views."""


REHEARSAL = "100:1000"
"""Iterations and surfels of the fit that compiles kernels before a cell is timed. *chair* at 200² has 148
kernels: 100 iterations leave one of them to the cell, 60 iterations 22, which are 3 to 6 s of CPU time.
"""


@dataclass(frozen=True)
class Cell:
    """Settings of one fit, in values that can be sent to another process."""

    data: str  # folder, absolute
    method: str  # name of a shipped method, or absolute path of a .toml
    preset: str  # name of a shipped preset, or ITERATIONS:SURFELS
    downscale: int | None  # pixels of a file per pixel, along a side; None: as the preset has it
    samples: int | None  # per pixel in every stage; None: as the method has it
    seed: int
    threads: int | None  # None: every core

    def resolved(self) -> Method:
        """Return the method with all settings; raises InputError as `methods.load` and `sized` do."""
        settings = [f"seed={self.seed}"]
        if self.downscale is not None:
            settings.append(f"data.downscale={self.downscale}")
        method = methods.load(self.method, self.preset, settings)
        if self.samples is not None:
            settings += [f"stage.{name}.samples={self.samples}" for name, _ in method.stages()]
            method = methods.load(self.method, self.preset, settings)
        return sized(method, Path(self.data))

    def rehearsal(self) -> Cell:
        """Return the short fit that compiles the kernels of this one, which Dr.Jit keeps on disk.

        Kernels depend on the data, the method, the size of images and the samples.
        """
        method = self.resolved()
        samples = {stage.samples for _, stage in method.stages()}
        same = samples.pop() if len(samples) == 1 else self.samples
        return replace(self, preset=REHEARSAL, downscale=method.data.downscale, samples=same, seed=0)

    @property
    def is_preset(self) -> bool:
        """Whether the cell is a shipped preset."""
        return self.preset in methods.PRESETS

    @property
    def title(self) -> str:
        """Data set, method and settings as text."""
        size = "" if self.downscale is None else f" 1/{self.downscale}"
        samples = "" if self.samples is None else f" samples {self.samples}"
        names = f"{Path(self.data).name} {Path(self.method).stem}"
        return f"{names} {self.preset}{size}{samples} seed {self.seed}"

    def described(self) -> Row:
        """Return the columns of the result's row that are settings."""
        method = self.resolved()
        return {
            "data": Path(self.data).name,
            "method": Path(self.method).stem,
            "preset": self.preset if self.is_preset else None,
            "iterations": method.iterations,
            "max_surfels": method.surfels.max_count,
            "downscale": method.data.downscale,
            "samples": max(stage.samples for _, stage in method.stages()),
            "seed": self.seed,
        }


@dataclass(frozen=True)
class Axes:
    """Values whose combinations are cells."""

    data: Sequence[Path]
    methods: Sequence[str]
    presets: Sequence[str]
    iterations: Sequence[int]
    surfels: Sequence[int]
    downscale: Sequence[int]
    samples: Sequence[int]
    seeds: Sequence[int]

    def cells(self, threads: int | None) -> list[Cell]:
        """Return the combinations; seeds vary slowest, so that every setting is measured once early.

        Raises InputError for a value that is given twice, and for two data sets or methods of one name.
        """
        for option, values in vars(self).items():
            names = [value.name if isinstance(value, Path) else Path(str(value)).stem for value in values]
            if len(set(names)) < len(names):
                raise InputError(f"{option}: {' '.join(names)}: a name is given twice; give each once")
        grid = itertools.product(self.iterations, self.surfels, self.downscale, self.samples)
        settings: list[tuple[str, int | None, int | None]] = [
            *((f"{iterations}:{surfels}", size, samples) for iterations, surfels, size, samples in grid),
            *((preset, None, None) for preset in self.presets),
        ]
        return [
            Cell(str(path.resolve()), _absolute(method), *setting, seed, threads)
            for seed, path, method, setting in itertools.product(
                self.seeds, self.data, self.methods, settings
            )
        ]


def _absolute(method: str) -> str:
    return str(Path(method).resolve()) if method.endswith(".toml") else method


class Store:
    """The folder of the cells' files."""

    def __init__(self, folder: Path) -> None:
        make_folder(folder)
        self.folder = folder
        self.code = code_digest()
        self._digests: dict[str, str] = {}

    def identity(self, cell: Cell) -> dict[str, Any]:
        """Return all that the result of a cell depends on; the seed is a setting of the method."""
        if cell.data not in self._digests:
            self._digests[cell.data] = folder_digest(Path(cell.data))
        method = plain(replace(cell.resolved(), file="", assignments=()))
        data = {"name": Path(cell.data).name, "sha256": self._digests[cell.data]}
        return {"method": method, "data": data, "code": self.code, "machine": device.machine()}

    def path(self, cell: Cell) -> Path:
        """Return the file of a cell."""
        key = hashlib.sha256(json.dumps(self.identity(cell), sort_keys=True).encode()).hexdigest()[:16]
        return self.folder / f"{re.sub(r'[^0-9A-Za-z.]+', '_', cell.title)}_{key}.json"

    def read(self, cell: Cell) -> Row | None:
        """Return the stored row of a cell; None if there is none, or its file is damaged."""
        try:
            content = read_json(self.path(cell))
        except InputError:
            return None
        row = content.get("row")
        same = content.get("identity") == self.identity(cell)
        return row if same and isinstance(row, dict) and {*RESULTS} <= row.keys() else None

    def write(self, cell: Cell, row: Row) -> None:
        """Store a row, atomically; raises InputError if the code has changed since the store was opened."""
        if code_digest() != self.code:
            raise InputError(f"{ROOT}: code: it has changed while cells were measured; run the same again")
        write_json(self.path(cell), {"identity": self.identity(cell), "row": row})

    def unused(self, cells: Iterable[Cell]) -> int:
        """Return the number of files of other settings, data, code or machines."""
        used = {self.path(cell) for cell in cells}
        return len([path for path in self.folder.glob("*.json") if path not in used])


def folder_digest(folder: Path) -> str:
    """Return the SHA-256 of names and contents of all visible files below a folder."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        name = path.relative_to(folder)
        if not TEMPORARY.fullmatch(path.name) and not any(part.startswith(".") for part in name.parts):
            with path.open("rb") as file:
                digest.update(f"{name}\0{hashlib.file_digest(file, 'sha256').hexdigest()}\0".encode())
    return digest.hexdigest()


def code_digest() -> str:
    """Return the SHA-256 of the package and of `fit`; settings are in the identity of each cell."""
    digest = hashlib.sha256()
    for path in (*sorted((ROOT / "mi_refgs").rglob("*.py")), Path(__file__).with_name("fit.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()
