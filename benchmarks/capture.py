"""How true the cameras of `refgs capture` are: its data set beside one of the same images with true
cameras.

    python -m benchmarks.capture CAPTURED TRUE

Both are folders that `refgs train` reads; views are paired by the names of their images. Positions are in
per cent of the extent (the largest distance of a true camera from their mean), after the similarity that fits
them best.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mi_refgs.capture.frame import PoseErrors, pose_errors
from mi_refgs.data.dataset import read_dataset
from mi_refgs.data.view import View
from mi_refgs.errors import InputError


def all_views(folder: Path) -> list[View]:
    """The views of both splits."""
    return [v for split in ("train", "test") for v in read_dataset(folder, split, truth=False).views]


def table(errors: PoseErrors, placed: int, wanted: int) -> str:
    """The errors as a table in Markdown."""
    rows = [("rotation, degrees", errors.rotation), ("position, % of the extent", 100 * errors.position)]
    rows.append(("focal length, %", 100 * abs(errors.focal)))
    lines = [f"{placed} of {wanted} images placed", "", "| error | median | largest |", "|---|---|---|"]
    lines += [f"| {name} | {np.median(values):.3f} | {values.max():.3f} |" for name, values in rows]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captured", type=Path)
    parser.add_argument("truth", type=Path)
    args = parser.parse_args(arguments)
    try:
        captured, truth = all_views(args.captured), all_views(args.truth)
        print(table(pose_errors(captured, truth), len(captured), len(truth)))
    except (InputError, KeyError) as error:
        print(f"benchmarks.capture: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
