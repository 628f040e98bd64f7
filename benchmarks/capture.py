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
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.common.report import plain_parser, table
from mi_refgs.capture.frame import Similarity
from mi_refgs.data.dataset import read_dataset
from mi_refgs.data.view import View
from mi_refgs.errors import InputError


def all_views(folder: Path) -> list[View]:
    """The views of both splits."""
    return [v for split in ("train", "test") for v in read_dataset(folder, split, truth=False).views]


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Camera errors of the views that both data sets have, after the best similarity."""

    count: int
    rotation: np.ndarray  # (V,) degrees
    position: np.ndarray  # (V,) over the extent: the largest distance of a true camera from their mean
    focal: np.ndarray  # (V,) of the focal length, relative


def best_similarity(points: np.ndarray, wanted: np.ndarray) -> Similarity:
    """The least-squares similarity from points (N, 3) to the wanted ones. [Umeyama 1991]"""
    mean, wanted_mean = points.mean(axis=0), wanted.mean(axis=0)
    covariance = (wanted - wanted_mean).T @ (points - mean) / len(points)
    u, singular, vt = np.linalg.svd(covariance)
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ mirror @ vt
    scale = float(np.trace(np.diag(singular) @ mirror) / ((points - mean) ** 2).sum(axis=1).mean())
    return Similarity(scale, rotation, wanted_mean - scale * rotation @ mean)


def pose_errors(views: Sequence[View], truth: Sequence[View]) -> PoseErrors:
    """Errors of the views whose names occur in `truth`; raises KeyError if fewer than three do."""
    true = {view.name: view for view in truth}
    pairs = [(view, true[view.name]) for view in views if view.name in true]
    if len(pairs) < 3:
        raise KeyError("fewer than three views have a name of a ground-truth view")
    found, wanted = (np.array([pair[i].to_world for pair in pairs]) for i in (0, 1))
    similarity = best_similarity(found[:, :3, 3], wanted[:, :3, 3])
    extent = np.linalg.norm(wanted[:, :3, 3] - wanted[:, :3, 3].mean(axis=0), axis=1).max()
    position = np.linalg.norm(similarity.apply(found[:, :3, 3]) - wanted[:, :3, 3], axis=1) / extent
    turned = similarity.rotation @ found[:, :3, :3]
    # The angle by the chord |A − B| = 2 √2 sin(angle / 2): exact for small ones, too.
    chord = np.linalg.norm(turned - wanted[:, :3, :3], axis=(1, 2)) / np.sqrt(8)
    rotation = 2 * np.degrees(np.arcsin(np.clip(chord, 0, 1)))
    focal = np.array([a.fx * b.width / (b.fx * a.width) - 1 for a, b in pairs])
    return PoseErrors(len(pairs), rotation, position, focal)


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
