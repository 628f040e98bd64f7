"""What a page can draw: one protocol of scenes, which the loop asks for pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from mi_refgs.splat.camera import Camera
from mi_refgs.viewer.develop import PICTURE, Look
from mi_refgs.viewer.pose import Pose


@dataclass(frozen=True, eq=False)
class Sample:
    """One sample of every pixel of a picture."""

    pose: Pose
    width: int
    height: int
    look: Look
    offset: tuple[float, float] = (0.0, 0.0)  # of the sample from the pixel's centre, pixels
    index: int = 0  # of the sample
    settled: bool = False  # whether nothing has moved for a while, so that it may cost more
    exact: Camera | None = None  # in place of the pose, with its pixels
    depth: bool = False  # whether depth is wanted, too

    @property
    def asked(self) -> frozenset[str]:
        """What `render` is to make beside the picture."""
        shown = {self.look.what} - {PICTURE, "alpha"}
        return frozenset(shown | ({"depth"} if self.depth else set()))

    def camera(self) -> Camera:
        """The renderer's camera."""
        return self.exact or self.pose.camera(self.width, self.height, self.offset)


@dataclass(frozen=True, eq=False)
class Sampled:
    """What a scene gives for a sample."""

    planes: list[Any]  # see `develop.planes_of`
    depth: Any = None  # mi.Float: along the camera's z axis, 0 where nothing is seen; None where unknown


class Drawable(Protocol):
    """A scene as a page shows it. All but the constants is called on one thread, that of the loop."""

    @property
    def variables(self) -> tuple[str, ...]:
        """`develop.PICTURE` and the types of `plugins.aovs` that it has."""

    @property
    def backdrops(self) -> tuple[str, ...]:
        """See `develop.backdrops_of`."""

    centre: np.ndarray
    """World point (3,) that cameras turn around."""
    radius: float
    """Of the object around it, scene units."""
    square_pixels: bool
    """Whether its pixels must be square, whatever sizes that gives."""

    def draw(self, sample: Sample) -> Sampled:
        """One sample of every pixel."""

    def fine(self, pose: Pose, width: int, height: int, look: Look) -> list[Any]:
        """The planes of a picture to keep, of square pixels."""
