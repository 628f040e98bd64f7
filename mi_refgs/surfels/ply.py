"""Surfels and 3D Gaussians in PLY files, with the names and raw encodings of 2DGS and 3DGS (docs/formats.md).

Normals are zeros, as both write them, ignored when read. Spherical harmonics are colour-major: the constant
coefficients of r, g, b, then all others of r, of g, of b. Columns of a surfel model: 3 coefficient + rgb.
"""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.io.files import write_bytes
from mi_refgs.io.ply import read_vertices
from mi_refgs.surfels.attributes import ATTRIBUTES, MAX_SH_DEGREE, sh_columns
from mi_refgs.surfels.primitives.primitive import nearest_primitive
from mi_refgs.surfels.table import Surfels


def read_ply(path: str | Path) -> Surfels:
    """Read surfels from a binary or ASCII PLY file; unknown properties are ignored. Raises InputError that
    names file, property and remedy if that fails, or a property is missing or not finite."""
    path = Path(path)
    vertices = read_vertices(path)
    raw = raw_attributes(path, {name: vertices[name] for name in vertices.dtype.names or ()})
    for name, table in raw.items():
        if bad := np.count_nonzero(~np.isfinite(table)):
            remedy = "remove those surfels or export it again"
            raise InputError(f"{bad} values are NaN or infinite", path, name, remedy)
    return Surfels.from_numpy(raw)


def raw_attributes(
    path: Path, columns: Mapping[str, np.ndarray], most: int = MAX_SH_DEGREE
) -> dict[str, np.ndarray]:
    """Raw attributes (N, D) float32 from the columns (N,) of a PLY file by name; `most`: largest degree of
    spherical harmonics. Raises InputError where properties are missing."""

    def table(properties: tuple[str, ...]) -> np.ndarray:
        if missing := [name for name in properties if name not in columns]:
            remedy = f"export the file again with all of {', '.join(sorted(properties))}"
            raise InputError("the property is missing", path, missing[0], remedy)
        with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite
            return np.stack([np.asarray(columns[name], np.float32) for name in properties], axis=1)

    raw = {}
    for name, attribute in ATTRIBUTES.items():
        if attribute.harmonics:
            prefix = attribute.properties[0]
            rest = sum(found.startswith(f"{prefix}_rest_") for found in columns)
            degree = math.isqrt(rest // 3 + 1) - 1
            if rest != sh_columns(degree) - 3 or degree > most:
                use = f"use 0, 9, 24 or 45 (degrees 0 to {MAX_SH_DEGREE})"
                raise InputError(f"{rest} properties", path, f"{prefix}_rest_*", use)
            if rest or any(found.startswith(f"{prefix}_dc_") for found in columns):
                raw[name] = table(_sh_properties(prefix, degree))
        elif there := [i for i, found in enumerate(attribute.properties) if found in columns]:
            width = min(width for width in attribute.widths if width > max(there))
            raw[name] = table(attribute.properties[:width])
    primitive, missing = nearest_primitive(raw)
    for name in missing:  # raises InputError that names the property
        table(ATTRIBUTES[name].properties[: primitive.widths[name]])
    return raw


def _sh_properties(prefix: str, degree: int) -> tuple[str, ...]:
    """Property names in the column order 3 coefficient + rgb."""
    others = (degree + 1) ** 2 - 1
    rest = tuple(f"{prefix}_rest_{rgb * others + k}" for k in range(others) for rgb in range(3))
    return (*(f"{prefix}_dc_{rgb}" for rgb in range(3)), *rest)


def write_ply(path: str | Path, surfels: Surfels) -> None:
    """Write finite surfels as binary float32 PLY, atomically and exactly. Raises InputError if that fails."""
    surfels.validate()
    tables = surfels.to_numpy()
    columns: dict[str, np.ndarray] = {}
    names = ["x", "y", "z", "nx", "ny", "nz"]
    first = ["position", "radiance_sh", "opacity", "scale", "rotation"]  # 2DGS's order, ours, SH last
    others = (name for name in ATTRIBUTES if name not in first)
    for attribute in [*first, *sorted(others, key=lambda name: ATTRIBUTES[name].harmonics)]:
        if attribute in tables:
            properties = ATTRIBUTES[attribute].properties
            if ATTRIBUTES[attribute].harmonics:
                properties = _sh_properties(properties[0], surfels.sh_degree(attribute))
            # A surfel has two of the three declared scales.
            found = dict(zip(properties, tables[attribute].T, strict=False))
            columns |= found
            names += sorted((name for name in found if name not in names), key=lambda name: (len(name), name))
    rows = np.zeros(surfels.count, dtype=[(name, "<f4") for name in names])
    for name, column in columns.items():
        rows[name] = column
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {surfels.count}"]
    header += [*(f"property float {name}" for name in names), "end_header\n"]
    write_bytes(path, "\n".join(header).encode("ascii") + rows.tobytes())
