"""Primitives, what is splatted: each file has a subclass of `Primitive`, chosen by attributes and their
widths (surfels have a `scale` of two columns, 3D Gaussians one of three), and its `register`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from mi_refgs.constants import ALPHA_MIN
from mi_refgs.errors import InputError
from mi_refgs.kernels.rows import joined
from mi_refgs.registry import Registry
from mi_refgs.types import Bool, Float, Int32, Point2f, Vector2f, Vector3f

Surfels = Any  # surfels.table.Surfels, which imports this module
Camera = Any  # splat.camera.Camera, which does too


@dataclass(frozen=True)
class Footprints:
    """N footprints: differentiable columns, and the detached pixel rectangles outside which they are 0."""

    columns: list[Float]  # primitive.columns × (N,)
    first: tuple[Int32, Int32]  # (N,): first covered pixel column and row
    last: tuple[Int32, Int32]  # (N,): last covered column and row, below `first` if there is none
    primitive: Primitive
    fine: bool = False  # whether normals vary over them: errors of the order show

    def followed_by(self, other: Footprints) -> Footprints:
        """These footprints, then others, under AD; raises InputError as `evaluating_both` does."""
        primitive = evaluating_both(self.primitive, other.primitive)
        rows = []
        for part in (self, other):
            same = part.primitive is primitive
            rows.append(part.columns if same else part.primitive.rows_as[primitive.name](part.columns))
        (left, top), (right, bottom) = (
            tuple(dr.concat([a, b]) for a, b in zip(mine, theirs, strict=True))
            for mine, theirs in ((self.first, other.first), (self.last, other.last))
        )
        return Footprints(joined(*rows), (left, top), (right, bottom), primitive, self.fine or other.fine)


@dataclass(frozen=True)
class FootprintSample:
    """One footprint at one pixel; a primitive adds the intermediate values that its derivatives reuse."""

    alpha: Float  # opacity, at most ALPHA_MAX
    z: Float  # camera-z depth, scene units
    valid: Bool  # whether it contributes: α ≥ ALPHA_MIN, and beyond the near plane


class Adjoint(Protocol):
    """Adjoint of `Primitive.evaluate`: sums over the pixels of one lane, from which `columns` follow."""

    def add(self, sample: Any, δalpha: Float, δz: Float) -> None:
        """Add a pixel, for adjoints of its α and z."""

    def columns(self, row: list[Float]) -> list[Float]:
        """Adjoint of the row's columns."""


class Primitive(ABC):
    """A primitive to splat. A row has its columns of one footprint, then features."""

    name: str  # in method files
    widths: Mapping[str, int]  # attributes that it requires, and their columns; with position and opacity
    optional: tuple[str, ...] = ()  # further geometry that it may have
    columns: int  # of a row
    sizes: tuple[str, ...]  # attributes that are logarithms of standard deviations
    # By the name of another primitive whose rows express its footprints: its columns as such rows, under AD.
    rows_as: Mapping[str, Callable[[list[Float]], list[Float]]] = MappingProxyType({})
    adjoint: Callable[[], Adjoint]  # of `evaluate`, empty
    first_order: bool = False  # splatted by the derivative of the projection at its centre

    @abstractmethod
    def project(self, surfels: Surfels, camera: Camera) -> Footprints:
        """Footprints of all surfels; rectangles have no derivative, culled surfels cover no pixel."""

    @abstractmethod
    def evaluate(self, row: list[Float], pixel: Point2f, near: Float) -> FootprintSample:
        """Evaluate rows at pixel centres."""

    @abstractmethod
    def normal(self, surfels: Surfels) -> Vector3f:
        """Unit normals in the world, not yet turned towards a camera."""

    def require_own(self, names: Collection[str]) -> None:
        """Raise InputError for geometry among names of attributes that only another primitive may have."""
        for other in PRIMITIVES.values():
            if found := [name for name in other.optional if name in names and name not in self.optional]:
                what = f"a {self.name} has none"
                raise InputError(what, "surfels", found[0], f"leave it out; every {other.name} may have it")

    def turns(self, surfels: Surfels, normal: Vector3f) -> dict[str, Vector3f]:
        """What `normal`, that of `normal` or its opposite, gains per standard deviation u and v of a sample;
        empty: it is the same on all of a primitive."""
        return {}

    @abstractmethod
    def overlaps(self, row: list[Float], low: Point2f, high: Point2f) -> Bool:
        """Whether footprints may reach ALPHA_MIN inside a rectangle from `low` to `high`, pixels."""

    @abstractmethod
    def depth_near(self, row: list[Float], pixel: Point2f) -> Float:
        """Depth near given points, the centres of tiles: the sort key."""

    @abstractmethod
    def start(self, spacing: np.ndarray, rotation: np.ndarray) -> dict[str, np.ndarray]:
        """Raw attributes beside position and opacity, for points whose neighbours are `spacing` (N,) away,
        and unit quaternions `rotation` (N, 4), (x, y, z, w), whose third axis is the surface normal."""

    @abstractmethod
    def extent(self, raw: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Orthonormal world axes (N, A, 3) of its Gaussian, and standard deviations (N, A) along them."""

    def like(self, axes: np.ndarray, deviations: np.ndarray) -> dict[str, np.ndarray]:
        """What `start` returns, for the `extent` of another primitive, A = 2 or 3: as large, round."""
        rotation, s = sorted_frame(axes, deviations)
        return self.start(np.sqrt(s[:, 0] * s[:, 1]), rotation)

    def resize(self, raw: dict[str, np.ndarray], rows: np.ndarray, factor: float) -> None:
        """Multiply the standard deviations of some primitives by a factor, in place."""
        for name in self.sizes:
            raw[name][rows] += np.float32(np.log(factor))

    def turn(self, raw: dict[str, np.ndarray], rows: slice, axis: np.ndarray, offset: np.ndarray) -> None:
        """Turn primitives, in place, to what parents are at `offset` (n,) deviations along `axis` (n,)."""
        return

    def shrink(self, raw: dict[str, np.ndarray], rows: slice, axis: np.ndarray, factor: float) -> None:
        """Multiply the standard deviation along an axis (n,) per primitive by a factor, in place."""
        for name in self.sizes:
            along = np.minimum(axis, raw[name].shape[1] - 1)
            raw[name][rows] += np.log(factor) * (np.arange(raw[name].shape[1]) == along[:, None])


@dataclass(frozen=True)
class OrientedSample(FootprintSample):
    """With the intermediate values that derivatives reuse."""

    gaussian: Float  # exp(-ρ/2)
    clamped: Bool  # α_max was reached: no derivative
    delta: Vector2f  # pixel offset from the centre
    u: Float  # standard deviations from it, along two axes
    v: Float


class Oriented(Primitive):
    """A primitive with a `rotation`, and a `scale` along the first two of its axes, or all three."""

    sizes = ("scale",)

    def start(self, spacing: np.ndarray, rotation: np.ndarray) -> dict[str, np.ndarray]:
        """Round in these axes, with the neighbours' distance as standard deviation. [3DGS, §5.1]"""
        return {"rotation": rotation, "scale": np.repeat(np.log(spacing)[:, None], self.widths["scale"], 1)}

    def like(self, axes: np.ndarray, deviations: np.ndarray) -> dict[str, np.ndarray]:
        """With the same axes: a disc in the plane of the two longest, or a Gaussian, thin if it is flat."""
        rotation, s = sorted_frame(axes, deviations)
        return {"rotation": rotation, "scale": np.log(s[:, : self.widths["scale"]])}

    def extent(self, raw: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The axes of `scale`, and the standard deviations along them."""
        return rotation_axes(raw["rotation"])[:, : self.widths["scale"]], np.exp(raw["scale"])


def _check(primitive: Primitive) -> None:
    for other in PRIMITIVES.values():
        mine, others = primitive.widths.items(), other.widths.items()
        if mine <= others or others <= mine:
            what = f"primitive '{primitive.name}': '{other.name}' has its attributes"
            raise InputError(what, remedy="give it an attribute, or a number of columns, of its own")


PRIMITIVES: Registry[Primitive] = Registry("primitive", _check, of=Primitive)
register = PRIMITIVES.register
"""Add a primitive; raises InputError if another one has its name or its attributes."""


def nearest_primitive(raw: Mapping[str, Any]) -> tuple[Primitive, list[str]]:
    """The primitive of which raw attributes (N, D) lack the fewest, and the names of those."""

    def lacking(primitive: Primitive) -> list[str]:
        return [n for n, width in primitive.widths.items() if n not in raw or raw[n].shape[1] != width]

    found = min(PRIMITIVES.values(), key=lambda primitive: len(lacking(primitive)))
    return found, lacking(found)


def primitive_of(raw: Mapping[str, Any]) -> Primitive:
    """The primitive whose attributes are among raw ones (N, D); raises InputError that names missing ones."""
    nearest, missing = nearest_primitive(raw)
    if not missing:
        nearest.require_own(raw)
        return nearest
    name = missing[0]
    if name in raw:
        found = f"{raw[name].shape[1]} columns, a {nearest.name} has {nearest.widths[name]}"
        raise InputError(found, "surfels", name, "fix the array's shape")
    raise InputError("the attribute is missing", "surfels", name, f"add it, every {nearest.name} needs it")


def evaluating_both(first: Primitive, second: Primitive) -> Primitive:
    """The one of two primitives that evaluates the rows of both; raises InputError if neither does."""
    for one, other in ((first, second), (second, first)):
        if one is other or one.name in other.rows_as:
            return one
    what = f"'{second.name}' is not splatted together with '{first.name}'"
    remedy = "give both the same primitive, or surfel and gaussian (surroundings.primitive of a method)"
    raise InputError(what, "surroundings", "scale", remedy)


def projected(surfels: Surfels, camera: Camera) -> tuple[Bool, Float, Float, Vector2f]:
    """Whether centres lie beyond the near plane, their depth z (else 1), 1 / z, and (x, y) / z."""
    p = camera.to_camera(surfels.position())
    ahead = dr.detach((p.z > camera.near) & (p.z > 0))
    z = dr.select(ahead, p.z, 1)
    nearness = dr.rcp(z)
    return ahead, z, nearness, mi.Vector2f(p.x, p.y) * nearness


def cutoff_radius_squared(opacity: Float) -> Float:
    """r² = 2 ln(o/α_min): the ρ at which α falls to ALPHA_MIN."""
    return 2 * dr.log(dr.maximum(opacity, ALPHA_MIN) / ALPHA_MIN)


def dot2(x: Float, y: Float, delta: Vector2f) -> Float:
    """(x, y) · δ."""
    return dr.fma(x, delta.x, y * delta.y)


def rectangle(
    centre: Vector2f, low: Vector2f, high: Vector2f, visible: Bool, camera: Camera
) -> tuple[tuple[Int32, Int32], tuple[Int32, Int32]]:
    """First and last pixel column and row from centre + `low` to centre + `high`; none if not `visible`."""
    first, last = [], []
    for axis, size in enumerate((camera.width, camera.height)):
        # Clamped as floats first: a rectangle far outside must not overflow an integer.
        begin = dr.ceil(dr.clip(centre[axis] + low[axis], -1, size + 1) - 0.5)
        end = dr.floor(dr.clip(centre[axis] + high[axis], -1, size + 1) - 0.5)
        first.append(dr.select(visible, mi.Int32(dr.maximum(begin, 0)), 1))
        last.append(dr.select(visible, mi.Int32(dr.minimum(end, size - 1)), 0))
    return (first[0], first[1]), (last[0], last[1])


def rotation_axes(rotation: np.ndarray) -> np.ndarray:
    """Rotated axes (N, 3, 3), one per row, of quaternions (N, 4) (x, y, z, w) of any norm."""
    identity = np.array([0, 0, 0, 1], rotation.dtype)
    length = np.linalg.norm(rotation, axis=1, keepdims=True)
    x, y, z, w = np.where(length > 0, rotation / np.where(length > 0, length, 1), identity).T
    first = [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)]
    second = [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)]
    third = [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)]
    return np.stack([np.stack(axis, axis=1) for axis in (first, second, third)], axis=1)


THICKNESS = 0.1  # third standard deviation of a flat primitive as a Gaussian, over the smaller of its two


def sorted_frame(axes: np.ndarray, deviations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quaternions (N, 4) of 2 or 3 axes (N, A, 3), longest first; deviations (N, 3), a third THICKNESS."""
    order = np.argsort(-deviations, axis=1, kind="stable")
    axes = np.take_along_axis(axes, order[:, :, None], axis=1)
    s = np.take_along_axis(deviations, order, axis=1)
    if s.shape[1] == 2:
        s = np.concatenate([s, THICKNESS * s[:, 1:]], axis=1)
    first, second = axes[:, 0], axes[:, 1]
    frame = np.stack([first, second, np.cross(first, second)], axis=2).reshape(-1, 3, 3)
    return Rotation.from_matrix(frame).as_quat().reshape(-1, 4), s
