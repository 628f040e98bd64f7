"""Peak memory of images and gradients against size, samples and surfels, measured and predicted.

    python -m benchmarks.memory         in a few minutes

Each cell is a process of its own; cells that are predicted to need more than LIMIT are left out. Writes
memory.json; `python -m benchmarks.pages` makes the table of docs/memory.md.
"""

from __future__ import annotations

import contextlib
import itertools
import subprocess
import sys
from typing import Any

from benchmarks.common.report import make_parser, write_measured
from benchmarks.common.timing import in_fresh_process
from benchmarks.memory import cell
from mi_refgs.kernels import memory

SIZES, SAMPLES, SURFELS = (256, 512, 1024, 2048), (1, 4, 16, 64), (10_000, 100_000, 1_000_000)
LIMIT = 12e9
"""Bytes beyond which a cell is not measured."""
SECONDS = 300
"""After which a cell is given up."""


def cells() -> list[tuple[str, int, int, int]]:
    """Kind, pixels along each side, samples per pixel and surfels: two of 1 sample, 512², 10,000 surfels."""
    return [
        (kind, size, samples, surfels)
        for kind, size, samples, surfels in itertools.product(cell.KINDS, SIZES, SAMPLES, SURFELS)
        if (samples == 1) + (size == 512) + (surfels == 10_000) >= 2
    ]


def measured(kind: str, size: int, samples: int, surfels: int) -> dict[str, Any]:
    """Peak resident bytes and seconds of the cell's process; None for one that is left out or ends early."""
    needed = memory.of_image(size**2, samples, surfels, cell.CHANNELS[kind], kind == "gradient")
    row: dict[str, Any] = {"kind": kind, "size": size, "samples": samples, "surfels": surfels}
    row |= {"predicted": needed, "measured": None, "seconds": None}
    if needed > LIMIT:
        return row
    with contextlib.suppress(subprocess.SubprocessError):
        row |= in_fresh_process("benchmarks.memory.cell", kind, size, samples, surfels, seconds=SECONDS)
    return row


def main(arguments: list[str] | None = None) -> int:
    """Measure; returns the exit code, 2 for bad input."""
    parser = make_parser("memory", __doc__)
    options = parser.parse_args(arguments)

    def run() -> dict[str, Any]:
        rows = []
        for one in cells():
            rows.append(measured(*one))
            if not options.quiet:
                print(rows[-1], file=sys.stderr, flush=True)
        return {"rows": rows}

    return write_measured("memory", options, run)


if __name__ == "__main__":
    sys.exit(main())
