"""Fused distances by the float64 reference, with the thresholds of the program."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from mi_refgs.occlusion import tsdf
from mi_refgs.reference import occlusion as ref


def fused_points(
    points: Iterable[np.ndarray],
    depths: list[np.ndarray],
    poses: list[np.ndarray],
    focal: float,
    voxel: float,
    **options: Any,
) -> np.ndarray:
    """`ref.fuse_point` of each world point (3,): (N,). Depth maps are square, of one focal length, pixels."""
    cameras = [(pose, focal, len(depth)) for pose, depth in zip(poses, depths, strict=True)]
    options |= {"truncation_voxels": tsdf.TRUNCATION_VOXELS, "unseen_vote": tsdf.UNSEEN_VOTE}
    return np.array([ref.fuse_point(point, depths, cameras, voxel, **options) for point in points])
