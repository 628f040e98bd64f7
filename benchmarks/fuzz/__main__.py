"""Mutated files for every reader, in processes that may crash, and a table of what came of them.

    python -m benchmarks.fuzz [--files 1000] [--seed 0] [--reader ply …] [--show INDEX] [--json FILE]

A failure is printed with the reader, the seed and the index that make its file again: `--show` writes that
file to standard output. The exit code is 1 if there was one.
"""

from __future__ import annotations

import collections
import json
import select
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.common.report import plain_parser
from benchmarks.fuzz import SECONDS
from benchmarks.fuzz.readers import READERS
from benchmarks.fuzz.worker import mutated

START_SECONDS = 300
"""Until the first line of a process: importing and compiling, on a machine that does other things too."""
PATIENCE = 3 * SECONDS
"""After which a process that said nothing hangs where no alarm reaches it."""
GOOD = ("right", "refused")


def run_reader(name: str, seed: int, files: int) -> list[dict[str, Any]]:
    """The outcome of every file; a process that ended or hangs is followed by another at the next file."""
    found: list[dict[str, Any]] = []
    while len(found) < files:
        arguments = map(str, (name, seed, len(found), files))
        command = [sys.executable, "-m", "benchmarks.fuzz.worker", *arguments]
        with tempfile.TemporaryFile() as errors:
            # Unbuffered: `select` sees the pipe, not what Python has read ahead.
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, bufsize=0)
            with process:
                assert process.stdout is not None
                patience = START_SECONDS
                while select.select([process.stdout], [], [], patience)[0]:
                    line = process.stdout.readline()
                    if not line:
                        break
                    found.append(json.loads(line))
                    patience = PATIENCE
                else:
                    process.kill()
            errors.seek(0)
            said = errors.read().decode(errors="replace")[-500:]
        if len(found) < files:
            what = f"ended with code {process.returncode}, or was ended as it did not answer: {said}"
            found.append({"index": len(found), "result": "crash", "what": what, "seconds": 0, "mebibytes": 0})
    return found


def row(name: str, found: list[dict[str, Any]]) -> str:
    """A line of the table."""
    results = collections.Counter(item["result"] for item in found)
    bad = len(found) - results["right"] - results["refused"]
    slowest, most = (max(item[key] for item in found) for key in ("seconds", "mebibytes"))
    return (
        f"{name:<12}{len(found):>7}{results['right']:>8}{results['refused']:>9}{bad:>10}"
        f"{slowest:>10.2f} s{most:>8.0f} MiB"
    )


def main() -> int:
    """Run, and print."""
    parser = plain_parser("fuzz", __doc__)
    parser.add_argument("--files", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--reader", nargs="+", choices=READERS, default=list(READERS), metavar="NAME")
    parser.add_argument("--show", type=int, metavar="INDEX", help="write one file of the first reader")
    parser.add_argument("--kinds", type=int, default=0, metavar="N", help="print the N commonest refusals")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every outcome")
    options = parser.parse_args()
    if options.show is not None:
        with tempfile.TemporaryDirectory() as place:
            import mitsuba as mi

            mi.set_variant("llvm_ad_rgb")
            reader = READERS[options.reader[0]]
            samples = reader.samples(Path(place))
            sys.stdout.buffer.write(mutated(reader, samples, options.seed, options.show))
        return 0
    print(f"seed {options.seed}")
    print(
        f"{'reader':<12}{'files':>7}{'right':>8}{'refused':>9}{'failures':>10}{'slowest':>12}{'memory':>12}"
    )
    everything, failures = {}, 0
    for name in options.reader:
        found = everything[name] = run_reader(name, options.seed, options.files)
        print(row(name, found), flush=True)
        kinds = collections.Counter(item.get("what") for item in found if item["result"] == "refused")
        for kind, count in kinds.most_common(options.kinds):
            print(f"    {count:>5}  {kind}")
        for item in found:
            if item["result"] not in GOOD:
                failures += 1
                print(f"    --seed {options.seed} --reader {name} --show {item['index']}: {json.dumps(item)}")
    if options.json:
        options.json.write_text(json.dumps(everything))
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
