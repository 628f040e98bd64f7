"""Mutation testing: apply each mutant to a copy of the repository, and run the test that must fail.

    python -m benchmarks.mutation                    all, two at a time; exit code 1 if one survives
    python -m benchmarks.mutation --only splat       mutants whose name contains the word
    python -m benchmarks.mutation --list             names, files and tests

First all named tests run without a mutant: they must pass, or a failure would prove nothing."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

from benchmarks.common.report import plain_parser

ROOT = Path(__file__).parents[2]
PARTS = "mi_refgs variants scenes tests benchmarks docs pyproject.toml README.md setup.sh".split()
"""Files and folders that the tests read."""
WORKERS = 2
TIME_LIMIT = 300  # seconds for a test, compiling its kernels included; a mutant that hangs is caught
PYTEST = ("-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist")


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


def main(arguments: list[str] | None = None) -> int:
    """Run the mutants; print one line per mutant, and the counts."""
    parser = plain_parser("mutation", __doc__)
    parser.add_argument("--only", default="", metavar="WORD", help="mutants whose name contains the word")
    parser.add_argument("--list", action="store_true", help="print the mutants and stop")
    parser.add_argument("--workers", type=int, default=WORKERS, metavar="N", help="copies tested at once")
    options = parser.parse_args(arguments)
    chosen = [mutant for mutant in read_mutants() if options.only in mutant.name]
    if options.list or not chosen:
        for mutant in chosen:
            print(f"{mutant.name:52} {mutant.file:36} {mutant.test}")
        return 0 if chosen else 2
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="mutation_") as folder:
        copies: SimpleQueue[Path] = SimpleQueue()
        for k in range(options.workers):
            copies.put(copy_repository(Path(folder) / str(k)))

        def run(mutant: Mutant) -> tuple[str, float]:
            copy = copies.get()
            begin = time.perf_counter()
            try:
                with applied(mutant, copy):
                    return outcome([mutant.test], copy), time.perf_counter() - begin
            finally:
                copies.put(copy)

        tests = sorted({mutant.test for mutant in chosen})
        copy = copies.get()
        if (found := outcome(tests, copy, show=True)) != "survived":
            print(f"the tests without a mutant: {found}; fix them first")
            return 1
        copies.put(copy)
        with ThreadPoolExecutor(options.workers) as pool:
            outcomes: Counter[str] = Counter()
            for mutant, (found, seconds) in zip(chosen, pool.map(run, chosen), strict=True):
                outcomes[found] += 1
                print(f"{found:10} {seconds:4.0f} s  {mutant.name:52} {mutant.test}", flush=True)
    counts = ", ".join(f"{number} {found}" for found, number in sorted(outcomes.items()))
    print(f"{len(chosen)} mutants: {counts}; {(time.perf_counter() - start) / 60:.1f} minutes")
    return 1 if outcomes["survived"] + outcomes["broken"] else 0


def outcome(tests: list[str], copy: Path, show: bool = False) -> str:
    """Run the tests in the copy: failed, crashed, hung, broken or survived; `show` prints their output."""
    try:
        done = subprocess.run(
            [sys.executable, "-m", "pytest", *PYTEST, *tests],
            cwd=copy,
            env=os.environ | {"PYTHONPATH": str(copy)},
            capture_output=True,
            timeout=TIME_LIMIT * len(tests),
            check=False,
        )
    except subprocess.TimeoutExpired:
        return "hung"
    if show and done.returncode:
        print(done.stdout.decode())
    # Other codes of pytest say that no test ran, which proves nothing.
    return "crashed" if done.returncode < 0 else {0: "survived", 1: "failed"}.get(done.returncode, "broken")


if __name__ == "__main__":
    sys.exit(main())
