"""How a mistake gets into a copy of the repository."""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PARTS = ("mi_refgs", "variants", "scenes", "tests", "benchmarks", "pyproject.toml", "README.md", "setup.sh")
"""What the tests read."""


@dataclass(frozen=True)
class Mistake:
    """`before`, which stands once in `file`, becomes `after`; `test` (a pytest node) must then fail."""

    name: str
    file: str  # below the root of the repository
    before: str
    after: str
    test: str


def catalogue() -> list[Mistake]:
    """The mutants of mutants/*.toml: a file per folder of the package.

    Under the name of each source file: name = [text that occurs there once, replacement, the failing test].
    """
    return [
        Mistake(name, f"mi_refgs/{file}", before, after, f"tests/{test}")
        for room in sorted(Path(__file__).with_name("mutants").glob("*.toml"))
        for file, mistakes in tomllib.loads(room.read_text(encoding="utf-8")).items()
        for name, (before, after, test) in mistakes.items()
    ]


def copy_repository(folder: Path) -> Path:
    """Copy what the tests read into a new folder, which is returned."""
    folder.mkdir(parents=True)
    for part in PARTS:
        source = ROOT / part
        if source.is_dir():
            shutil.copytree(source, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(source, folder / part)
    return folder


def mutated(mistake: Mistake, root: Path = ROOT) -> str:
    """Source with the mistake; raises ValueError unless what it replaces stands in its file exactly once."""
    source = (root / mistake.file).read_text(encoding="utf-8")
    if (found := source.count(mistake.before)) != 1:
        raise ValueError(f"{mistake.name}: {mistake.file}: found {found} times: {mistake.before!r}")
    return source.replace(mistake.before, mistake.after)


@contextmanager
def planted(mistake: Mistake, copy: Path) -> Iterator[None]:
    """The mistake stands in a copy of the repository meanwhile."""
    file = copy / mistake.file
    original = file.read_text(encoding="utf-8")
    file.write_text(mutated(mistake, copy), encoding="utf-8")
    try:
        yield
    finally:
        file.write_text(original, encoding="utf-8")
