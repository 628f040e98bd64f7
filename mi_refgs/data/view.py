"""One picture of a data set with its camera, in NumPy."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.io.images import box_downscale, linear_from_srgb, srgb_from_linear

if TYPE_CHECKING:
    from mi_refgs.data.picture_files import FileCamera
    from mi_refgs.splat.camera import Camera

ALPHA_FLOOR = 1e-3
"""Alpha by which colour is divided at least: fainter pixels have no colour of their own in 8 bits."""


class Pixels(Protocol):
    """Colour and alpha of a picture that is decoded when it is asked for."""

    has_alpha: bool
    """Whether it has alpha."""

    def planes(self) -> tuple[np.ndarray, np.ndarray | None]:
        """What `View.image` and `View.alpha` are; raises InputError for a file that cannot be read."""


@dataclass(frozen=True, eq=False)
class View:
    """One picture and its camera."""

    name: str
    width: int  # pixels
    height: int  # pixels
    fx: float  # focal length, pixels, positive
    fy: float
    cx: float  # principal point, pixels from the left edge; the centre is width / 2
    cy: float
    to_world: np.ndarray  # (4, 4) float64, rigid, from Mitsuba's camera frame: +z forward, +x left, +y up
    image: np.ndarray  # (H, W, 3) float32 target, composited onto the background; given as `Pixels` or array
    alpha: np.ndarray | None  # (H, W) float32; likewise
    normal: np.ndarray | None  # (H, W, 3) float32, world space, 0 off the object
    depth: np.ndarray | None  # (H, W) float32 along the viewing axis, 0 off the object
    is_linear_radiance: bool  # whether `image` is linear radiance (EXR) or sRGB-encoded (PNG)
    materials: dict[str, np.ndarray] = field(default_factory=dict)
    """Of albedo, roughness, metallic those that are known: (H, W, C + 1) float32, the last the share of the
    pixel for which the others stand; all 0 where it is 0."""
    exposure: float | None = None  # log(time · ISO / f-number²), where EXIF data say so
    near: float = 0.0  # depth of the near plane, scene units; `read_dataset` derives it from all cameras
    file: FileCamera | None = None  # that the picture was read from

    def load(self) -> View:
        """The same view with its picture in memory: `image` and `alpha` are arrays, decoded at once.

        Raises InputError for a file that cannot be read. Of a view of a file that is not loaded, these two
        attributes decode it each time, and raise likewise.
        """
        given = self.__dict__["image"]
        if isinstance(given, np.ndarray):
            return self
        image, alpha = given.planes()
        own = self.__dict__["alpha"]
        return self.changed(image=image, alpha=alpha if own is given else own)

    def camera(self) -> Camera:
        """The splatter's camera; in Mitsuba's frame both of its focal lengths are negative."""
        from mi_refgs.splat.camera import Camera

        focal = (-self.fx, -self.fy)
        return Camera.from_pose(self.width, self.height, *focal, self.cx, self.cy, self.to_world, self.near)

    def covered(self) -> np.ndarray:
        """What part of each pixel the object covers, (H, W): alpha.

        Without it 1 where something true is recorded of a surface, and of all pixels where nothing is.
        """
        if self.alpha is not None:
            return self.alpha
        if self.normal is not None:
            return np.any(self.normal != 0, axis=-1).astype(np.float32)
        if self.depth is not None:
            return (self.depth > 0).astype(np.float32)
        return np.ones((self.height, self.width), np.float32)

    @property
    def displayed(self) -> np.ndarray:
        """The picture (H, W, 3) that the view is fitted to or compared with, display-encoded."""
        return srgb_from_linear(self.image) if self.is_linear_radiance else self.image

    @property
    def has_alpha(self) -> bool:
        """Whether the picture has alpha; decodes nothing, as `alpha` may."""
        given = self.__dict__["alpha"]
        return given is not None and (isinstance(given, np.ndarray) or given.has_alpha)

    def changed(self, **fields: Any) -> View:
        """The same view with other fields; decodes nothing, as `dataclasses.replace` would."""
        made = copy.copy(self)
        for name, value in fields.items():
            object.__setattr__(made, name, value)
        return made

    def averaged(self, block: int) -> View:
        """The same view with each square of `block` × `block` pixels as one, and without true maps.

        Pixels at the right and the bottom that fill no square are left out. Raises InputError for a picture
        of less than one square.
        """
        if min(self.width, self.height) < block:
            raise InputError(
                f"{self.name}: data.coarse: {self.width} × {self.height} pixels are less than a block of "
                f"{block}²; give a smaller one"
            )
        loaded = self.load()
        image, alpha = loaded.image, loaded.alpha
        alpha = None if alpha is None else box_downscale(alpha[..., None], block)[..., 0]
        return replace(
            self,
            width=self.width // block,
            height=self.height // block,
            fx=self.fx / block,
            fy=self.fy / block,
            cx=self.cx / block,
            cy=self.cy / block,
            image=box_downscale(image, block),
            alpha=alpha,
            normal=None,
            depth=None,
            materials={},
        )

    def colour(self, background: np.ndarray) -> np.ndarray:
        """Linear colour (H, W, 3) of the object alone, not premultiplied; `background` (3,) as in `image`."""
        loaded = self.load()
        alpha = np.float32(1) if loaded.alpha is None else loaded.alpha[..., None]
        colour = np.clip((loaded.image - (1 - alpha) * background) / np.maximum(alpha, ALPHA_FLOOR), 0, None)
        return colour if self.is_linear_radiance else linear_from_srgb(np.clip(colour, 0, 1))

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Array indices (row, column), integer at pixel centres, of world points (N, 3); and if seen."""
        local = (points - self.to_world[:3, 3]) @ self.to_world[:3, :3]
        depth = np.where(local[:, 2] > 0, local[:, 2], np.inf)
        column = -self.fx * local[:, 0] / depth + self.cx - 0.5
        row = -self.fy * local[:, 1] / depth + self.cy - 0.5
        seen = (
            (local[:, 2] > 0)
            & (abs(column - (self.width - 1) / 2) <= self.width / 2)
            & (abs(row - (self.height - 1) / 2) <= self.height / 2)
        )
        return row, column, seen


class _Decoded:
    """`View.image` or `View.alpha`: an array as it was given, or decoded of `Pixels`."""

    def __init__(self, name: str, plane: int) -> None:
        self.name, self.plane = name, plane

    def __get__(self, view: View | None, owner: type) -> Any:
        if view is None:
            return self
        given = view.__dict__[self.name]
        return given if given is None or isinstance(given, np.ndarray) else given.planes()[self.plane]

    def __set__(self, view: View, value: np.ndarray | Pixels | None) -> None:
        view.__dict__[self.name] = value


for _plane, _name in enumerate(("image", "alpha")):
    setattr(View, _name, _Decoded(_name, _plane))
