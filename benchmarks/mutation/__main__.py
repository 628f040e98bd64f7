"""Plant one mistake after another in a copy of the repository, and run the test that must catch it.

    python -m benchmarks.mutation                    all, two at a time; exit code 1 if one goes unnoticed
    python -m benchmarks.mutation --only splat       those whose name holds the word
    python -m benchmarks.mutation --list             names, files and tests

First all named tests run without a mistake: they must pass, or failing would prove nothing.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue

from benchmarks.common.report import plain_parser
from benchmarks.mutation.planting import Mistake, catalogue, copy_repository, planted

WORKERS = 2
TIME_LIMIT = 300
"""Seconds for a test, compiling its kernels included. A mistake that makes it hang is caught."""
PYTEST = ("-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist")


def main(arguments: list[str] | None = None) -> int:
    """Run, and print a line a mistake and the counts."""
    parser = plain_parser("mutation", __doc__)
    parser.add_argument("--only", default="", metavar="WORD", help="mistakes whose name holds the word")
    parser.add_argument("--list", action="store_true", help="print the catalogue and stop")
    parser.add_argument("--workers", type=int, default=WORKERS, metavar="N", help="copies tested at once")
    options = parser.parse_args(arguments)
    chosen = [mistake for mistake in catalogue() if options.only in mistake.name]
    if options.list or not chosen:
        for mistake in chosen:
            print(f"{mistake.name:52} {mistake.file:36} {mistake.test}")
        return 0 if chosen else 2
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="mutation_") as folder:
        copies: SimpleQueue[Path] = SimpleQueue()
        for k in range(options.workers):
            copies.put(copy_repository(Path(folder) / str(k)))

        def run(mistake: Mistake) -> tuple[str, float]:
            copy = copies.get()
            begin = time.perf_counter()
            try:
                with planted(mistake, copy):
                    return outcome([mistake.test], copy), time.perf_counter() - begin
            finally:
                copies.put(copy)

        tests = sorted({mistake.test for mistake in chosen})
        copy = copies.get()
        if (found := outcome(tests, copy, show=True)) != "unnoticed":
            print(f"the tests without a mistake: {found}; mend them first")
            return 1
        copies.put(copy)
        with ThreadPoolExecutor(options.workers) as pool:
            outcomes: Counter[str] = Counter()
            for mistake, (found, seconds) in zip(chosen, pool.map(run, chosen), strict=True):
                outcomes[found] += 1
                print(f"{found:10} {seconds:4.0f} s  {mistake.name:52} {mistake.test}", flush=True)
    counts = ", ".join(f"{number} {found}" for found, number in sorted(outcomes.items()))
    print(f"{len(chosen)} mistakes: {counts}; {(time.perf_counter() - start) / 60:.1f} minutes")
    return 1 if outcomes["unnoticed"] + outcomes["broken"] else 0


def outcome(tests: list[str], copy: Path, show: bool = False) -> str:
    """What the tests make of the copy: failed, crashed, hung, broken or unnoticed; `show` prints it, too."""
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
    return "crashed" if done.returncode < 0 else {0: "unnoticed", 1: "failed"}.get(done.returncode, "broken")


if __name__ == "__main__":
    sys.exit(main())
