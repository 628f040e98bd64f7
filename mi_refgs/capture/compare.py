"""How far the cameras of a capture are from true ones, after the similarity that fits their positions
best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mi_refgs.capture.frame import Similarity
from mi_refgs.data.view import View


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of the views that both data sets have."""

    count: int
    rotation: np.ndarray  # (V,) degrees
    position: np.ndarray  # (V,) as part of the extent: the largest distance of a true camera from their mean
    focal: np.ndarray  # (V,) of the focal length, relative


def best_similarity(points: np.ndarray, wanted: np.ndarray) -> Similarity:
    """The similarity that takes points (N, 3) to the wanted ones with the least squares. [Umeyama 1991]"""
    mean, wanted_mean = points.mean(axis=0), wanted.mean(axis=0)
    covariance = (wanted - wanted_mean).T @ (points - mean) / len(points)
    u, singular, vt = np.linalg.svd(covariance)
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ mirror @ vt
    scale = float(np.trace(np.diag(singular) @ mirror) / ((points - mean) ** 2).sum(axis=1).mean())
    return Similarity(scale, rotation, wanted_mean - scale * rotation @ mean)


def pose_errors(views: Sequence[View], truth: Sequence[View]) -> PoseErrors:
    """Errors of the views whose names occur in `truth`; raises KeyError where fewer than three do."""
    true = {view.name: view for view in truth}
    pairs = [(view, true[view.name]) for view in views if view.name in true]
    if len(pairs) < 3:
        raise KeyError("fewer than three views have a name that the truth has, too")
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
