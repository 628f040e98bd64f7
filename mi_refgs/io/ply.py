"""Header and vertices of a PLY file, compared with its length before memory is allocated."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.kernels.memory import PER_PLY_BYTE, require

MAX_HEADER_LINES = 1000  # a header of surfels has 124 lines at most
MAX_LINE = 4096  # bytes per line of the header
TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
"""NumPy's names of the types, without the byte order."""
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "a"}


@dataclass(frozen=True)
class Element:
    name: str
    count: int  # rows
    fields: list[tuple[str, str]]  # name and TYPES code of the properties that are numbers
    lists: list[tuple[str, str]]  # name and code of the length of the properties that are lists

    def row_bytes(self, text: bool) -> int:
        """Smallest size of a row: every list empty; as text, a digit and a space per property."""
        if text:
            return 2 * (len(self.fields) + len(self.lists))
        return sum(int(code[1]) for _, code in (*self.fields, *self.lists))


@dataclass(frozen=True)
class Header:
    order: str  # "<", ">", or "a" for text
    elements: tuple[Element, ...]
    comments: tuple[str, ...]


def read_header(path: Path, file: BinaryIO, wanted: str = "the surfels.ply or mesh.ply of a run") -> Header:
    """Read the header up to the data. Raises InputError for a file without PLY header (the remedy is to give
    `wanted`) and for a header that promises more rows than the file contains."""
    if file.readline(MAX_LINE).strip() != b"ply":
        raise InputError("not a PLY file", path, "header", f"give {wanted}")
    order, comments = "", []
    elements: list[Element] = []
    for _ in range(MAX_HEADER_LINES):
        line = file.readline(MAX_LINE)
        words = line.decode("ascii", errors="replace").split()
        if not line.endswith(b"\n") and words != ["end_header"]:
            raise InputError("no end_header", path, "header", "the file is truncated, export it again")
        match words:
            case ["format", name, *_]:
                order = ORDERS.get(name, "")
            case ["comment" | "obj_info", *rest]:
                comments.append(" ".join(rest))
            case ["element", name, count] if count.isdigit() and len(count) < 19:
                elements.append(Element(name, int(count), [], []))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1].fields.append((name, TYPES[kind]))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= TYPES.keys():
                elements[-1].lists.append((name, TYPES[length]))
            case ["end_header"]:
                break
            case _:
                text = " ".join(words)[:40]
                raise InputError(f"'{text}' is no line of a PLY header", path, "header", "export it again")
    else:
        raise InputError(f"no end_header in {MAX_HEADER_LINES} lines", path, "header", "export it again")
    if not order or not elements:
        raise InputError("no format or no element", path, "header", "export it again")
    left = os.fstat(file.fileno()).st_size - file.tell()
    for element in elements:
        names = [name for name, _ in (*element.fields, *element.lists)]
        if not names:
            raise InputError(f"{element.name} has no property", path, "header", "export it again")
        if len({*names}) < len(names):
            raise InputError(f"a property of {element.name} occurs twice", path, "header", "export it again")
        left -= element.count * element.row_bytes(order == "a")
        if left < (-1 if order == "a" else 0):  # text may end without a line break
            what, remedy = f"{element.count} rows are more than the file contains", "copy or export it again"
            raise InputError(what, path, element.name, remedy)
    return Header(order, (*elements,), (*comments,))


def read_vertices(path: Path, file: BinaryIO) -> np.ndarray:
    """The `vertex` element as a structured array. Raises InputError as `read_header` does, and for vertices
    that are not the first element or have lists."""
    header = read_header(path, file)
    vertex, text = header.elements[0], header.order == "a"
    if vertex.name != "vertex":
        raise InputError("the vertices must come first", path, vertex.name, "export it as a surfel PLY")
    if vertex.lists:
        name, _ = vertex.lists[0]
        raise InputError("not a number property", path, name, "export the vertices without lists")
    size = vertex.count * (8 if text else 1) * max(vertex.row_bytes(False), 1)
    require(PER_PLY_BYTE * size, f"{path}: vertex: {vertex.count:,} rows", "keep fewer of them")
    if not text:
        dtype = np.dtype([(name, header.order + code) for name, code in vertex.fields])
        return np.frombuffer(file.read(vertex.count * dtype.itemsize), dtype=dtype)
    values = np.empty((vertex.count, len(vertex.fields)))
    for row in range(vertex.count):
        try:
            values[row] = [float(word) for word in file.readline().split()]
        except ValueError as error:
            what = f"row {row} is broken or missing"
            raise InputError(what, path, "vertex", "copy or export the file again") from error
    dtype = np.dtype([(name, "f8") for name, _ in vertex.fields])
    return np.ascontiguousarray(values).view(dtype).reshape(vertex.count)
