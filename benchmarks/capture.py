"""How true the cameras of `refgs capture` are: its data set beside one of the same images with true
cameras.

    python -m benchmarks.capture CAPTURED TRUE

Both are folders that `refgs train` reads; views are paired by the names of their images. Positions are in
per cent of the extent (the largest distance of a true camera from their mean), after the similarity that fits
them best.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.common.report import plain_parser, table
from mi_refgs.capture.frame import pose_errors
from mi_refgs.data.dataset import read_dataset
from mi_refgs.data.view import View
from mi_refgs.errors import InputError


def all_views(folder: Path) -> list[View]:
    """The views of both splits."""
    return [v for split in ("train", "test") for v in read_dataset(folder, split, truth=False).views]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = plain_parser("capture", __doc__)
    parser.add_argument("captured", type=Path)
    parser.add_argument("truth", type=Path)
    args = parser.parse_args(arguments)
    try:
        captured, truth = all_views(args.captured), all_views(args.truth)
        errors = pose_errors(captured, truth)
    except (InputError, KeyError) as error:
        print(f"benchmarks.capture: {error}", file=sys.stderr)
        return 2
    found = {"rotation, degrees": errors.rotation, "position, % of the extent": 100 * errors.position}
    found["focal length, %"] = 100 * abs(errors.focal)
    rows = [[name, f"{np.median(x):.3f}", f"{x.max():.3f}"] for name, x in found.items()]
    print(
        f"{len(captured)} of {len(truth)} images placed",
        table(["error", "median", "largest"], rows),
        sep="\n\n",
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
