"""Surfels and 3D Gaussians in PLY files, with the names and raw encodings of 2DGS and 3DGS (docs/formats.md).

Normals are zeros, as both write them, and ignored when read. Spherical harmonics are colour-major: the
constant coefficients of r, g, b, then all others of r, of g, of b. The column order of a surfel model is 3
coefficient + rgb.
"""

from __future__ import annotations

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
    try:
        with path.open("rb") as file:
            vertices = read_vertices(path, file)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", path, "file", "check the path") from error
    return decode_ply(path, {name: vertices[name] for name in vertices.dtype.names or ()})


def decode_ply(path: Path, columns: Mapping[str, np.ndarray]) -> Surfels:
    """Surfels from columns (N,) of a PLY file by name; `path` and errors as in `read_ply`."""
    names, arrays = (*columns,), {}
    for name, attribute in ATTRIBUTES.items():
        if attribute.harmonics:
            prefix = attribute.properties[0]
            if any(found.startswith(f"{prefix}_") for found in names):
                degree = _sh_degree(path, names, prefix)
                arrays[name] = _columns(path, columns, _sh_properties(prefix, degree))
        elif there := [i for i, found in enumerate(attribute.properties) if found in names]:
            width = min(width for width in attribute.widths if width > max(there))
            arrays[name] = _columns(path, columns, attribute.properties[:width])
    primitive, missing = nearest_primitive(arrays)
    for name in missing:  # raises InputError that names the property
        _columns(path, columns, ATTRIBUTES[name].properties[: primitive.widths[name]])
    return Surfels.from_numpy(arrays)


def _columns(path: Path, columns: Mapping[str, np.ndarray], properties: tuple[str, ...]) -> np.ndarray:
    """The named properties as an (N, D) float32 array, all present and finite."""
    table = np.empty((len(next(iter(columns.values()))), len(properties)), dtype=np.float32)
    for column, name in enumerate(properties):
        if name not in columns:
            remedy = f"export the file again with all of {', '.join(sorted(properties))}"
            raise InputError("the property is missing", path, name, remedy)
        with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite
            table[:, column] = columns[name]
        bad = int(np.count_nonzero(~np.isfinite(table[:, column])))
        if bad:
            remedy = "remove those surfels or export it again"
            raise InputError(f"{bad} values are NaN or infinite", path, name, remedy)
    return table


def _sh_degree(path: Path, names: tuple[str, ...], prefix: str) -> int:
    rest = sum(name.startswith(f"{prefix}_rest_") for name in names)
    degrees = {sh_columns(degree) - 3: degree for degree in range(MAX_SH_DEGREE + 1)}
    if rest not in degrees:
        use = f"use 0, 9, 24 or 45 (degrees 0 to {MAX_SH_DEGREE})"
        raise InputError(f"{rest} properties", path, f"{prefix}_rest_*", use)
    return degrees[rest]


def _sh_properties(prefix: str, degree: int) -> tuple[str, ...]:
    """Property names in the column order 3 coefficient + rgb."""
    others = (degree + 1) ** 2 - 1
    rest = tuple(f"{prefix}_rest_{rgb * others + k}" for k in range(others) for rgb in range(3))
    return (*(f"{prefix}_dc_{rgb}" for rgb in range(3)), *rest)


def write_ply(path: str | Path, surfels: Surfels) -> None:
    """Write surfels as binary float32 PLY, atomically and exactly. Raises InputError if that fails, or if a
    value is not finite."""
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
