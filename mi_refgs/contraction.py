"""A sphere of interest, and the contraction of all of space around it into a ball of twice its radius.

World positions in scene units. A grid or a random draw in contracted space covers near and far at once.
[Mip-NeRF 360, Barron et al. 2022, eq. 10]
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.errors import InputError


@dataclass(frozen=True)
class Region:
    """A sphere."""

    centre: tuple[float, float, float]  # world
    radius: float  # scene units, positive

    @staticmethod
    def of(content: Any, source: Path | str) -> Region:
        """The region {"centre": [x, y, z], "radius": r} of a JSON file or an option, `source`.

        Raises InputError for anything else, and for numbers that no scene has.
        """
        centre = content.get("centre") if isinstance(content, dict) else None
        numbers = [*centre, content.get("radius")] if isinstance(centre, list) else []
        usable = all(type(number) in (int, float) and abs(number) <= MAX_NUMBER for number in numbers)
        if len(numbers) != 4 or not usable or not numbers[3] >= 1 / MAX_NUMBER:
            raise InputError(
                f"{source}: centre, radius: not three numbers and a positive one; correct or remove them"
            )
        x, y, z, radius = map(float, numbers)
        return Region((x, y, z), radius)

    def moved(self, offset: np.ndarray) -> Region:
        """The region with its centre moved by an offset (3,)."""
        x, y, z = (float(c) for c in np.array(self.centre) + offset)
        return Region((x, y, z), self.radius)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which of the points (N, 3) lie inside: (N,) bool."""
        return np.linalg.norm(points - np.array(self.centre), axis=-1) <= self.radius

    def contract(self, points: np.ndarray) -> np.ndarray:
        """World points (N, 3) in the ball of radius 2: offset / radius inside, (2 − 1/|o|) o/|o| beyond."""
        offset = (np.asarray(points, dtype=np.float64) - np.array(self.centre)) / self.radius
        length = np.linalg.norm(offset, axis=-1, keepdims=True)
        safe = np.maximum(length, 1.0)
        return np.where(length > 1, (2 - 1 / safe) * offset / safe, offset)

    def expand(self, contracted: np.ndarray) -> np.ndarray:
        """The inverse of `contract` for points (N, 3) of length below 2."""
        contracted = np.asarray(contracted, dtype=np.float64)
        length = np.linalg.norm(contracted, axis=-1, keepdims=True)
        safe = np.maximum(length, 1.0)
        offset = np.where(length > 1, contracted / (safe * (2 - safe)), contracted)
        return np.array(self.centre) + self.radius * offset
