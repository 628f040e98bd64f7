"""Mutation testing: apply each mutant to a copy of the repository, and run the test that must fail.

    python -m benchmarks.mutation                    all, two at a time; exit code 1 if one survives
    python -m benchmarks.mutation --only splat       mutants whose name contains the word
    python -m benchmarks.mutation --list             names, files and tests

First all named tests run without a mutant: they must pass, or a failure would prove nothing."""

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
from benchmarks.mutation import Mutant, applied, copy_repository, read_mutants

WORKERS = 2
TIME_LIMIT = 300  # seconds for a test, compiling its kernels included; a mutant that hangs is caught
PYTEST = ("-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist")


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
