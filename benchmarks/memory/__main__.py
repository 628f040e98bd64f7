"""Peak memory of images and gradients against size, samples and surfels, measured and predicted.

    python -m benchmarks.memory         the page docs/memory.md from a third of the cells, in a few minutes
    python -m benchmarks.memory --all   from all of them

Each cell is a process of its own. Those that are predicted to need more than LIMIT are left out, and said so.
Writes memory.md and memory.json; without -o, the page to docs/ and the JSON to
benchmarks/results/.
"""

from __future__ import annotations

import contextlib
import itertools
import subprocess
import sys
from typing import Any

from benchmarks.common.report import make_parser, table, write_reports
from benchmarks.common.timing import in_fresh_process
from benchmarks.memory import cell
from mi_refgs.kernels import memory

SIZES, SAMPLES, SURFELS = (256, 512, 1024, 2048), (1, 4, 16, 64), (10_000, 100_000, 1_000_000)
LIMIT = 12e9
"""Bytes beyond which a cell is not measured."""
SECONDS = 300
"""After which a cell is given up."""


def cells(every: bool) -> list[tuple[str, int, int, int]]:
    """Kind, pixels along each side, samples per pixel and surfels; few unless `every`."""
    found = itertools.product(cell.KINDS, SIZES, SAMPLES, SURFELS)
    if every:
        return list(found)
    # Two of: one sample, 512², 10,000 surfels.
    return [
        (kind, size, samples, surfels)
        for kind, size, samples, surfels in found
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


def page(result: dict[str, Any]) -> dict[str, Any]:
    """By name in page.md."""
    known = [row for row in result["rows"] if row["measured"] is not None]
    ratios = [row["predicted"] / row["measured"] for row in known]
    lines = [
        [
            row["kind"],
            f"{row['size']}²",
            row["samples"],
            f"{row['surfels']:,}",
            f"{row['measured'] / 1e9:.2f}" if row["measured"] else "not measured",
            f"{row['predicted'] / 1e9:.2f}",
        ]
        for row in result["rows"]
    ]
    head = ["", "pixels", "samples per pixel", "surfels", "measured, GB", "predicted, GB"]
    most = max(known, key=lambda row: row["measured"])
    return {
        "table": table(head, lines),
        "cells": len(known),
        "least": f"{min(ratios):.1f}",
        "largest": f"{max(ratios):.1f}",
        "most": f"{most['measured'] / 1e9:.1f} GB ({most['kind']}) for {most['size']}² pixels with "
        f"{most['samples']} samples per pixel and {most['surfels']:,} surfels",
        "limit": f"{LIMIT / 1e9:.0f}",
        "pass_samples": f"{memory.PASS_SAMPLES / 1e6:.1f} million",
        "derivative_samples": f"{memory.DERIVATIVE_SAMPLES / 1e6:.1f} million",
        "base": f"{memory.BASE / 1e9:.1f}",
        "per_pixel": f"{memory.PER_PIXEL / 1e3:.1f}",
        "per_surfel": f"{memory.PER_SURFEL / 1e3:.1f}",
    }


def main(arguments: list[str] | None = None) -> int:
    """Measure, and write the reports; the exit code, 2 for bad input."""
    parser = make_parser("memory", __doc__)
    parser.add_argument("--all", action="store_true", help="every cell")
    options = parser.parse_args(arguments)

    def run() -> dict[str, Any]:
        rows = []
        for one in cells(options.all):
            rows.append(measured(*one))
            if not options.quiet:
                print(rows[-1], file=sys.stderr, flush=True)
        return {"rows": rows}

    return write_reports("memory", options, run, lambda *_: None, page)


if __name__ == "__main__":
    sys.exit(main())
