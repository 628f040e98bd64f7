"""Surfels and meshes moved, turned and made larger: positions, rotations, sizes, and what is given in world
directions (harmonics, vectors) together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mi_refgs.shade.sh import sh_rotation
from mi_refgs.surfels.attributes import CHANNELS
from mi_refgs.surfels.primitives import primitive_of, widths_of
from mi_refgs.surfels.table import QUATERNION_FLOOR


@dataclass(frozen=True, eq=False)
class Placement:
    """p → rotation (factor (p - pivot)) + pivot + shift; the rotation is proper, the factor positive."""

    pivot: np.ndarray  # (3,) float64, world
    shift: np.ndarray  # (3,) float64, scene units
    rotation: Rotation
    factor: float = 1.0

    def points(self, points: np.ndarray) -> np.ndarray:
        """World points (N, 3), float64."""
        offset = self.factor * (np.asarray(points, np.float64) - self.pivot)
        turned = offset if self.turns_nothing else self.rotation.apply(offset)
        return turned + self.pivot + self.shift

    @property
    def turns_nothing(self) -> bool:
        """Whether directions stay as they are."""
        return bool(self.rotation.magnitude() == 0)

    @property
    def does_nothing(self) -> bool:
        """Whether everything stays where it is."""
        return self.turns_nothing and self.factor == 1 and not self.shift.any()

    def place(self, raw: dict[str, np.ndarray], rows: np.ndarray) -> None:
        """Move the chosen rows (N,) bool of raw channels (N, D), in place; what does not change stays bit for
        bit."""
        if self.does_nothing or not rows.any():
            return
        raw["position"][rows] = self.points(raw["position"][rows])
        if self.factor != 1:
            primitive_of(widths_of(raw)).resize(raw, rows, self.factor)
        if self.turns_nothing:
            return
        for name, table in raw.items():
            declared = CHANNELS[name]
            if declared.activation == "quaternion":
                table[rows] = self._turned(table[rows])
            elif declared.harmonics:
                table[rows] = rotated_harmonics(table[rows], self.rotation)
            elif declared.direction:
                table[rows] = self.rotation.apply(table[rows].astype(np.float64))

    def _turned(self, quaternions: np.ndarray) -> np.ndarray:
        """Raw quaternions (N, 4) (x, y, z, w) of any norm; one of zeros is the identity."""
        values = quaternions.astype(np.float64)
        values[np.abs(values).max(axis=1) < QUATERNION_FLOOR] = (0, 0, 0, 1)
        return (self.rotation * Rotation.from_quat(values)).as_quat()


def rotated_harmonics(raw: np.ndarray, rotation: Rotation) -> np.ndarray:
    """Raw harmonics (N, D), column = 3 coefficient + rgb, of the functions turned by the rotation."""
    rows, width = raw.shape
    matrix = sh_rotation(rotation.as_matrix(), round((width // 3) ** 0.5) - 1)
    coefficients = raw.reshape(rows, width // 3, 3).astype(np.float64)
    return np.einsum("ij,njc->nic", matrix, coefficients).reshape(rows, width)


def rotation_about(axis: np.ndarray, degrees: float) -> Rotation:
    """A turn about an axis (3,), counter-clockwise seen from where it points to."""
    direction = np.asarray(axis, dtype=np.float64)
    return Rotation.from_rotvec(np.radians(degrees) * direction / np.linalg.norm(direction))
