"""The surfel model: named raw attributes of N surfels, and their activated values.

Letters: N surfels, D columns of an attribute, q quaternion (x, y, z, w), t_u t_v n columns of its matrix.
A surfel is the point p(u, v) = position + s_u u t_u + s_v v t_v, n = t_u × t_v. [2DGS, Huang 2024, §4.1]

Named rules for degenerate values (each keeps values and gradients finite for every finite input):
  zero quaternion   every |component| < QUATERNION_FLOOR: the identity rotation, with gradient 0
  scale limit       the log scale is clamped to ±LOG_SCALE_LIMIT, with gradient 0 beyond
  logit limit       logits are clamped to ±LOGIT_LIMIT (sigmoid 0 or 1 in float32), with gradient 0 beyond
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.constants import RAW_LIMIT
from mi_refgs.errors import InputError
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.kernels.rows import columns_of
from mi_refgs.surfels.attributes import ATTRIBUTES, attribute
from mi_refgs.surfels.primitives.primitive import Primitive, primitive_of
from mi_refgs.types import Bool, Float, Point3f, Quaternion4f, TensorXf, UInt32, Vector3f

QUATERNION_FLOOR = 1e-12  # largest |component| of a quaternion that counts as zero
QUATERNION_LARGE = 1e37  # above it the reciprocal is subnormal, which processors may flush to zero
LOG_SCALE_LIMIT = 40.0  # e^±40 = 4e-18 … 2e17 scene units: float32 contains them and their squares
LOGIT_LIMIT = 40.0  # 1 / (1 + e^-40) is 1 in float32, and e^40 squared, as in the derivative, is finite


def sigmoid(x: Float) -> Float:
    """Logistic sigmoid of a Dr.Jit array, finite with a finite gradient for every finite x (logit limit)."""
    if dr.width(x) == 0:  # Dr.Jit refuses arithmetic between an empty array and a literal
        return x
    return dr.rcp(1.0 + dr.exp(-dr.clip(x, -LOGIT_LIMIT, LOGIT_LIMIT)))


def _exp(x: Float) -> Float:
    return dr.exp(dr.clip(x, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)) if dr.width(x) else x


class Surfels:
    """N surfels or other primitives: raw attributes by name, those in use, which decide the `primitive`.
    Accessors return activated Dr.Jit arrays (N,); gradients flow to the raw tensors in both modes."""

    raw: dict[str, TensorXf]  # (N, D) each, often leaves of the AD graph

    def __init__(self, raw: Mapping[str, TensorXf], screened: bool = False) -> None:
        """Adopt raw tensors (N, D); raises InputError for unknown names or wrong shapes. `screened`: opacity
        is 0 where a value is not `usable`, at 3 % of a training step."""
        for name in raw:
            attribute(name)
        self.raw = {name: raw[name] for name in ATTRIBUTES if name in raw}
        self.screened = screened
        for name, tensor in self.raw.items():
            shape, widths = tuple(tensor.shape), attribute(name).widths
            if len(shape) != 2 or shape[0] != self.count:
                found = f"shape {shape}, expected ({self.count}, D)"
                raise InputError(found, "surfels", name, "one row per surfel")
            if shape[1] not in widths:
                choices = " or ".join(map(str, widths))
                raise InputError(f"{shape[1]} columns, expected {choices}", "surfels", name, "fix the array")

    @staticmethod
    def from_numpy(arrays: Mapping[str, np.ndarray]) -> Surfels:
        """Surfels of raw float arrays of shape (N, D), or (N,) for an attribute of one column."""
        tables = {name: np.asarray(values, dtype=np.float32) for name, values in arrays.items()}
        tables = {name: table[:, None] if table.ndim == 1 else table for name, table in tables.items()}
        return Surfels({name: upload_tensor(table) for name, table in tables.items()})

    def to_numpy(self) -> dict[str, np.ndarray]:
        """Raw attributes as float32 arrays (N, D): copies, since Dr.Jit's own view shares the memory."""
        return {name: np.array(tensor.numpy()).reshape(tensor.shape) for name, tensor in self.raw.items()}

    @property
    def count(self) -> int:
        """Number of surfels N."""
        return int(next(iter(self.raw.values())).shape[0]) if self.raw else 0

    def has(self, name: str) -> bool:
        return name in self.raw

    def sh_degree(self, name: str = "radiance_sh") -> int:
        """Spherical-harmonic degree of `radiance_sh` or `indirect_sh`, from its number of columns."""
        return math.isqrt(int(self.raw[name].shape[1]) // 3) - 1

    @property
    def primitive(self) -> Primitive:
        """The primitive; raises InputError if attributes of it are missing."""
        return primitive_of(self.raw)

    def validate(self) -> None:
        """Raise InputError if an attribute is missing, or a value not finite."""
        primitive_of(self.raw)  # raises
        for name, tensor in self.raw.items():
            bad = int(dr.count(~dr.isfinite(dr.detach(tensor.array)))[0]) if self.count else 0
            if bad:
                raise InputError(f"{bad} values are NaN or infinite", "surfels", name, "remove those surfels")

    def usable(self) -> Bool:  # (N,)
        """Whether each surfel has finite raw values, below RAW_LIMIT where the activation is unbounded."""
        detached, rows = self.detach(), mi.Bool(True)
        for name in self.raw:
            rows &= dr.all(dr.abs(mi.ArrayXf(detached.columns(name))) < _limit(name))
        return rows

    def unusable(self) -> dict[str, np.ndarray]:
        """Indices of surfels that are not `usable`, by attribute; waits for the device."""
        if not self.count or dr.all(self.usable()):
            return {}
        rows = {n: np.flatnonzero(~(np.abs(x) < _limit(n)).all(axis=1)) for n, x in self.to_numpy().items()}
        return {name: found for name, found in rows.items() if len(found)}

    def cleaned(self) -> Surfels:
        """The same surfels under AD, with zeros for all values of those that are not `usable`."""
        usable, raw = self.usable(), {}
        for name, tensor in self.raw.items():
            row = dr.arange(mi.UInt32, dr.width(tensor.array)) // int(tensor.shape[1])
            values = dr.select(dr.gather(mi.Bool, usable, row), tensor.array, 0)
            raw[name] = mi.TensorXf(values, shape=tuple(tensor.shape))
        return Surfels(raw)

    def columns(self, name: str) -> list[Float]:
        """Raw columns (N,) of an attribute, under AD."""
        tensor = self.raw[name]
        rows, width = (int(size) for size in tensor.shape)
        return columns_of(tensor.array, width) if rows else [mi.Float() for _ in range(width)]

    def value(self, name: str) -> Any:
        """Activated mi.Float of one column, mi.Color3f of three, else a vector (SH: list of mi.Color3f)."""
        columns = self.columns(name)
        activate = {"sigmoid": sigmoid, "exp": _exp}.get(attribute(name).activation)
        columns = columns if activate is None else [activate(column) for column in columns]
        if attribute(name).harmonics:
            return [mi.Color3f(*columns[start : start + 3]) for start in range(0, len(columns), 3)]
        return vector_of(columns)

    def values(self, names: Collection[str]) -> dict[str, Any]:
        """Activated values of the attributes among `names`, by name; those that are absent are left out."""
        return {name: self.value(name) for name in self.raw if name in names}

    def position(self) -> Point3f:
        """World positions, scene units."""
        return mi.Point3f(*self.columns("position"))

    def rotation(self) -> Quaternion4f:
        """Unit quaternions; a zero quaternion reads as the identity, with gradient 0."""
        if self.count == 0:
            return dr.zeros(mi.Quaternion4f, 0)
        x, y, z, w = self.columns("rotation")
        largest = dr.detach(dr.maximum(dr.maximum(dr.abs(x), dr.abs(y)), dr.maximum(dr.abs(z), dr.abs(w))))
        valid = largest >= QUATERNION_FLOOR
        # Dividing by the largest component first keeps |q|² in range; normalising undoes it.
        shrink = dr.rcp(dr.select(valid, dr.minimum(largest, QUATERNION_LARGE), 1.0))
        x, y, z = (dr.select(valid, part * shrink, 0.0) for part in (x, y, z))
        w = dr.select(valid, w * shrink, 1.0)
        inverse_norm = dr.rsqrt(x * x + y * y + z * z + w * w)
        return mi.Quaternion4f(x * inverse_norm, y * inverse_norm, z * inverse_norm, w * inverse_norm)

    def scale(self) -> Any:
        """Standard deviations along the first two axes of `frame` (mi.Vector2f), or all (mi.Vector3f)."""
        columns = self.columns("scale")
        kind = mi.Vector2f if len(columns) == 2 else mi.Vector3f
        return kind(*(_exp(column) for column in columns)) if self.count else dr.zeros(kind, 0)

    def opacity(self) -> Float:
        """Opacities in [0, 1]; if `screened`, 0 with gradient 0 where the surfel is not `usable`."""
        opacity = sigmoid(self.columns("opacity")[0])
        if not self.screened or self.count == 0:
            return opacity
        usable = self.usable()
        dr.schedule(usable)  # with the footprints; the adjoint would read all attributes again
        return dr.select(usable, opacity, 0)

    def frame(self) -> tuple[Vector3f, Vector3f, Vector3f]:
        """World tangents and normal (t_u, t_v, n), the columns of the rotation matrix."""
        if self.count == 0:
            return dr.zeros(mi.Vector3f, 0), dr.zeros(mi.Vector3f, 0), dr.zeros(mi.Vector3f, 0)
        x, y, z, w = self.rotation()

        # Squares of all four on the diagonal, no 1: rounding of |q| then changes no direction.
        def entry(a: Float, b: Float, c: Float, d: Float) -> Float:
            return dr.fma(a, b, c * d)

        t_u = entry(w, w, x, x) - entry(y, y, z, z), 2 * entry(x, y, z, w), 2 * entry(x, z, -y, w)
        t_v = 2 * entry(x, y, -z, w), entry(w, w, y, y) - entry(x, x, z, z), 2 * entry(y, z, x, w)
        n = 2 * entry(x, z, y, w), 2 * entry(y, z, -x, w), entry(w, w, z, z) - entry(x, x, y, y)
        return mi.Vector3f(*t_u), mi.Vector3f(*t_v), mi.Vector3f(*n)

    def gather(self, parent: UInt32) -> Surfels:
        """Copies, detached: surfel i of the result is surfel parent[i] (mi.UInt32)."""
        raw = {name: gather_rows(tensor, parent) for name, tensor in self.raw.items()}
        return Surfels(raw, self.screened)

    def detach(self) -> Surfels:
        return Surfels({name: dr.detach(tensor) for name, tensor in self.raw.items()}, self.screened)

    def never_empty(self) -> Surfels:
        """These surfels, or one that covers no pixel where there are none: Dr.Jit refuses empty arrays."""
        if self.count:
            return self
        values = {name: -LOGIT_LIMIT if name == "opacity" else 0 for name in self.raw}
        shapes = {name: (1, int(tensor.shape[1])) for name, tensor in self.raw.items()}
        return Surfels({name: dr.full(mi.TensorXf, values[name], shapes[name]) for name in values})

    def enable_grad(self) -> None:
        """Make every raw tensor a leaf of the AD graph."""
        dr.enable_grad(list(self.raw.values()))


def vector_of(columns: Sequence[Float]) -> Any:
    """One column as it is, three as a colour, others as a vector."""
    kinds = {2: mi.Vector2f, 3: mi.Color3f, 4: mi.Vector4f}
    return columns[0] if len(columns) == 1 else kinds.get(len(columns), mi.ArrayXf)(*columns)


def _limit(name: str) -> float:
    return math.inf if attribute(name).bounded else RAW_LIMIT


def gather_rows(tensor: TensorXf, parent: UInt32) -> TensorXf:
    """Rows parent (mi.UInt32, width M) of an (N, D) tensor as a detached, evaluated (M, D) tensor."""
    rows, width = len(parent), int(tensor.shape[1])
    if rows == 0:
        return dr.zeros(mi.TensorXf, (0, width))
    entry = dr.arange(mi.UInt32, rows * width)
    source = dr.gather(mi.UInt32, mi.UInt32(parent), entry // width) * width + entry % width
    values = dr.gather(mi.Float, dr.detach(tensor.array), source)
    dr.eval(values)
    return mi.TensorXf(values, shape=(rows, width))
