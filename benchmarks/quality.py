"""Time to quality: PSNR on test views against seconds of training, and the seconds to a given PSNR.

    refgs compare DATA … --methods ref_gaussian base_2dgs --preset quick -o after
    python -m benchmarks.quality after before --at 28 33 -o quality.png

Reads folders that `refgs compare` made, one by each version of the code that is compared. Curves hold the
PSNR of some test views in the course of a fit, measured off the clock; the last column is the mean of all
test views after the fit. The clock leaves out reading images and the start's surfels.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.common import figures
from benchmarks.common.report import plain_parser, table
from mi_refgs.compare.jobs import RUNS
from mi_refgs.compare.worker import CURVE, CURVE_KEYS
from mi_refgs.evaluation.evaluate import read_metrics
from mi_refgs.runs.run import Run, read_log

LEVELS = (28.0, 33.0)
"""PSNR to reach, dB, where none is given."""


@dataclass(frozen=True)
class Fit:
    """One fit of a comparison."""

    folder: str  # of the comparison
    data: str
    method: str
    seed: str
    seconds: np.ndarray  # of training
    psnr: np.ndarray  # dB, of some test views
    final: float  # dB, of all; NaN if it was not measured

    def reached(self, level: float) -> float | None:
        """Seconds until the PSNR first is `level`, linear between two measurements; None if it never is."""
        above = np.flatnonzero(self.psnr >= level)
        if not len(above):
            return None
        near = slice(max(above[0] - 1, 0), above[0] + 1)
        return float(np.interp(level, self.psnr[near], self.seconds[near]))


def fits(folder: Path) -> list[Fit]:
    """The fits of a comparison that have a curve, by data set, method and seed."""
    found = []
    for run in sorted((folder / RUNS).glob("*/*/*")):
        if curve := read_log(run / CURVE, CURVE_KEYS):
            seconds, psnr = np.array([(point["seconds"], point["psnr"]) for point in curve]).T
            final = float((read_metrics(Run(run)) or {}).get("psnr", np.nan))
            data, method, seed = run.parts[-3:]
            found.append(Fit(folder.name, data, method, seed, seconds, psnr, final))
    return found


def seconds_table(found: list[Fit], levels: list[float]) -> str:
    """Seconds to each level, in Markdown."""
    head = ["data", "method", "seed", "folder", *(f"{level:g} dB" for level in levels), "s", "dB"]
    rows = []
    for fit in found:
        times = [fit.reached(level) for level in levels]
        cells = ["–" if seconds is None else f"{seconds:.0f}" for seconds in times]
        last = [f"{fit.seconds[-1]:.0f}", f"{fit.final:.2f}"]
        rows.append([fit.data, fit.method, fit.seed, fit.folder, *cells, *last])
    return table(head, rows)


def plot(found: list[Fit], path: Path) -> None:
    """One panel a data set, one line a fit."""
    scenes = sorted({fit.data for fit in found})
    figure, axes = figures.new(1, len(scenes), 3.2, 2.8)
    looks = sorted({(fit.folder, fit.method) for fit in found})
    for ax, scene in zip(axes.flat, scenes, strict=True):
        for fit in found:
            if fit.data == scene:
                look = looks.index((fit.folder, fit.method))
                ax.plot(fit.seconds, fit.psnr, marker=".", color=f"C{look % 10}")
        ax.set(title=scene, xlabel="training (s)")
        ax.grid(alpha=0.3)
    axes.flat[0].set_ylabel("PSNR (dB)")
    lines = [axes.flat[0].plot([], [], color=f"C{i % 10}")[0] for i in range(len(looks))]
    figure.legend(lines, [" ".join(look) for look in looks], loc="outside lower center", ncols=4, fontsize=8)
    figures.save(figure, path)


def main(arguments: list[str] | None = None) -> int:
    """Print the table, and plot."""
    parser = plain_parser("quality", __doc__)
    parser.add_argument("folders", type=Path, nargs="+", help="of `refgs compare`")
    parser.add_argument("--at", type=float, nargs="+", default=list(LEVELS), help="PSNR to reach, dB")
    parser.add_argument("-o", "--output", type=Path, help="plot to write, PNG")
    args = parser.parse_args(arguments)
    found = [fit for folder in args.folders for fit in fits(folder)]
    if not found:
        parser.error("these folders hold no curve; run `refgs compare` with -o")
    print(seconds_table(found, args.at))
    if args.output is not None:
        plot(found, args.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
