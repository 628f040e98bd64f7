"""Mutants: changes of the package's source, each with the test that must catch it."""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PARTS = ("mi_refgs", "variants", "scenes", "tests", "benchmarks", "pyproject.toml", "README.md", "setup.sh")
"""Files and folders that the tests read."""


class Mutant(NamedTuple):
    """`before`, which occurs once in `file`, becomes `after`; `test` (a pytest node) must then fail."""

    name: str
    file: str  # below the root of the repository
    before: str
    after: str
    test: str


def read_mutants() -> list[Mutant]:
    """Mutants of mutants/*.toml, one file per folder of the package.

    Under the name of each source file: name = [text that occurs there once, replacement, failing test]."""
    return [
        Mutant(name, f"mi_refgs/{file}", before, after, f"tests/{test}")
        for folder in sorted(Path(__file__).with_name("mutants").glob("*.toml"))
        for file, mutants in tomllib.loads(folder.read_text(encoding="utf-8")).items()
        for name, (before, after, test) in mutants.items()
    ]


def copy_repository(folder: Path) -> Path:
    """Copy what the tests read into a new folder, which is returned."""
    folder.mkdir(parents=True)
    for part in PARTS:
        copy = shutil.copytree if (ROOT / part).is_dir() else shutil.copy2
        copy(ROOT / part, folder / part)
    return folder


def mutated(mutant: Mutant, root: Path = ROOT) -> str:
    """Mutated source. Raises ValueError unless the replaced text occurs exactly once in its file."""
    source = (root / mutant.file).read_text(encoding="utf-8")
    if (found := source.count(mutant.before)) != 1:
        raise ValueError(f"{mutant.name}: {mutant.file}: found {found} times: {mutant.before!r}")
    return source.replace(mutant.before, mutant.after)


@contextmanager
def applied(mutant: Mutant, copy: Path) -> Iterator[None]:
    """Apply a mutant to a copy of the repository, and restore the file afterwards."""
    file = copy / mutant.file
    original = file.read_text(encoding="utf-8")
    file.write_text(mutated(mutant, copy), encoding="utf-8")
    try:
        yield
    finally:
        file.write_text(original, encoding="utf-8")
