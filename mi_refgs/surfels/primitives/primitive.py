"""What is splatted, behind one interface: a primitive has channels of its own and a footprint on the screen.

A table says itself which primitive it is of, by its channels and their widths: a `scale` of two columns makes
surfels, one of three makes 3D Gaussians. A new primitive is one file with a subclass of `Primitive`, and its
`register`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from mi_refgs.errors import InputError


@dataclass(frozen=True)
class Footprints:
    """N footprints: differentiable columns, and the detached pixel rectangles outside which they vanish."""

    columns: list[Any]  # primitive.columns × mi.Float (N,)
    first: tuple[Any, Any]  # mi.Int32 (N,): first covered pixel column and row
    last: tuple[Any, Any]  # mi.Int32 (N,): last covered column and row, below `first` if there is none
    primitive: Primitive


class Sample(Protocol):
    """One footprint at one pixel; a primitive adds the intermediate values that its derivatives reuse."""

    @property
    def alpha(self) -> Any:
        """Opacity there (mi.Float), at most ALPHA_MAX."""

    @property
    def z(self) -> Any:
        """Camera-z depth of the sample (mi.Float), scene units."""

    @property
    def valid(self) -> Any:
        """Whether it contributes (mi.Bool): α ≥ ALPHA_MIN, and beyond the near plane."""


class Adjoint(Protocol):
    """Adjoint of `Primitive.evaluate`, summed over the pixels of one lane before it becomes the columns'."""

    def add(self, sample: Any, δalpha: Any, δz: Any) -> None:
        """Take in a pixel, by the adjoints of its α and z."""

    def columns(self, row: Any) -> list[Any]:
        """Adjoint of the row's columns."""


class Primitive(ABC):
    """One kind of thing to splat. Rows are its columns of one footprint, then features.

    The argument `surfels` is a `surfels.table.Surfels`, `camera` a `splat.camera.Camera`, and `raw` maps
    channels to NumPy arrays (N, D) of raw values.
    """

    name: str
    """What methods call it."""
    widths: Mapping[str, int]
    """Its channels, without which nothing can be splatted, and their raw columns; `position` and `opacity`
    are among them."""
    columns: int
    """Columns of a row."""
    sizes: tuple[str, ...]
    """Its channels that are logarithms of standard deviations."""

    # ---------------- footprints, under AD ----------------

    @abstractmethod
    def project(self, surfels: Any, camera: Any, shift: Any = None) -> Footprints:
        """Footprints of all rows of a table in a camera.

        `shift` is an optional mi.Point2f (N,) in pixels added to the centres: zero-valued, it receives the
        gradient with respect to a screen translation, which densification reads. The rectangles carry no
        derivative. Culled rows cover no pixel, and get zero gradient.
        """

    @abstractmethod
    def evaluate(self, row: Any, pixel: Any, near: Any) -> Sample:
        """Evaluate rows at pixel centres (mi.Point2f)."""

    @abstractmethod
    def adjoint(self) -> Adjoint:
        """An empty adjoint of `evaluate`."""

    @abstractmethod
    def evaluate_forward(self, row: Any, sample: Any, drow: Any) -> tuple[Any, Any]:
        """Tangent of `evaluate`: tangents of the columns to those of α and z."""

    @abstractmethod
    def normal(self, surfels: Any) -> Any:
        """Unit normals (mi.Vector3f, world), not yet turned towards a camera."""

    # ---------------- tile lists, without derivatives ----------------

    @abstractmethod
    def overlaps(self, row: list[Any], low: Any, high: Any) -> Any:
        """Whether footprints may reach ALPHA_MIN inside a rectangle (mi.Point2f `low` to `high`, pixels)."""

    @abstractmethod
    def depth_near(self, row: list[Any], pixel: Any) -> Any:
        """Depth of rows near given points (mi.Point2f, pixels), the centres of tiles: the sort key."""

    # ---------------- edits of the table, NumPy ----------------

    @abstractmethod
    def start(self, spacing: np.ndarray, rotation: np.ndarray) -> dict[str, np.ndarray]:
        """Raw channels beside position and opacity of one thing a point.

        `spacing` (N,) is the distance of neighbours, `rotation` (N, 4) a unit quaternion (x, y, z, w) whose
        third axis is the normal of the surface there.
        """

    @abstractmethod
    def extent(self, raw: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Orthonormal world axes (N, A, 3) along which its Gaussian extends, and standard deviations (N, A).

        The children of what is split lie at normal deviates of these.
        """

    def resize(self, raw: dict[str, np.ndarray], rows: Any, factor: float) -> None:
        """Multiply the standard deviations of some rows by a factor, in place."""
        for name in self.sizes:
            raw[name][rows] += np.float32(np.log(factor))


PRIMITIVES: dict[str, Primitive] = {}
"""Every primitive by name."""


def register(primitive: Primitive) -> None:
    """Make a primitive known; raises InputError if its name or its channels are another's."""
    for other in PRIMITIVES.values():
        mine, others = {*primitive.widths.items()}, {*other.widths.items()}
        if other.name == primitive.name or mine <= others or others <= mine:
            raise InputError(
                f"primitive '{primitive.name}': '{other.name}' has its name or its channels; "
                "give it a name, and a channel or a width, of its own"
            )
    PRIMITIVES[primitive.name] = primitive


def unregister(name: str) -> None:
    """Forget a registered primitive."""
    del PRIMITIVES[name]


def primitive_named(name: str) -> Primitive:
    """The primitive of this name; raises InputError if there is none."""
    if name not in PRIMITIVES:
        raise InputError(f"primitive: '{name}' is unknown; use one of {', '.join(PRIMITIVES)}")
    return PRIMITIVES[name]


def nearest_primitive(widths: Mapping[str, int]) -> tuple[Primitive, list[str]]:
    """The primitive that lacks the fewest of its channels, and which; `widths` are numbers of raw columns."""

    def lacking(primitive: Primitive) -> list[str]:
        return [name for name, width in primitive.widths.items() if widths.get(name) != width]

    found = min(PRIMITIVES.values(), key=lambda primitive: len(lacking(primitive)))
    return found, lacking(found)


def primitive_of(widths: Mapping[str, int]) -> Primitive:
    """The primitive whose channels are there, with their numbers of raw columns.

    Raises InputError naming what is missing for the primitive that comes nearest.
    """
    nearest, missing = nearest_primitive(widths)
    if not missing:
        return nearest
    name = missing[0]
    if name in widths:
        raise InputError(
            f"surfels: {name}: {widths[name]} columns, a {nearest.name} has {nearest.widths[name]}; "
            "fix the array's shape"
        )
    raise InputError(f"surfels: {name}: the channel is missing; add it, nothing can be splatted without it")


def widths_of(raw: Mapping[str, Any]) -> dict[str, int]:
    """Number of raw columns of each channel of arrays (N, D)."""
    return {name: int(values.shape[1]) for name, values in raw.items()}


def rotation_axes(rotation: np.ndarray) -> np.ndarray:
    """Images (N, 3, 3) of the three axes, one a row, under quaternions (N, 4) (x, y, z, w) of any norm."""
    identity = np.array([0, 0, 0, 1], rotation.dtype)
    length = np.linalg.norm(rotation, axis=1, keepdims=True)
    x, y, z, w = np.where(length > 0, rotation / np.where(length > 0, length, 1), identity).T
    first = [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)]
    second = [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)]
    third = [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)]
    return np.stack([np.stack(axis, axis=1) for axis in (first, second, third)], axis=1)
