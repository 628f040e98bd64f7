"""Header and vertices of a PLY file, compared with its length before memory is allocated."""

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.io.files import require_file
from mi_refgs.kernels.memory import PER_PLY_BYTE, require

MAX_HEADER_LINES = 1000  # a header of surfels has 124 lines at most
MAX_LINE = 4096  # bytes per line of the header
TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
TYPES |= {"float": "f4", "double": "f8"}
TYPES |= {np.dtype(code).name: code for code in TYPES.values()}  # int8, …; without the byte order
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "a"}
OTHERS = {b"PK": "PyTorch's or a zip file", b"glTF": "a glTF file", b"<": "a web page"}  # by first bytes


@dataclass(frozen=True)
class Element:
    name: str
    count: int  # rows
    properties: list[tuple[str, str, str]]  # name, TYPES code, and of a list the code of its length, else ""

    @property
    def fields(self) -> list[tuple[str, str]]:
        """Name and code of the properties that are numbers."""
        return [(name, code) for name, code, length in self.properties if not length]

    def row_bytes(self, text: bool) -> int:
        """Smallest size of a row: every list empty; as text, a digit and a space per property."""
        return sum(2 if text else int((length or code)[1]) for _, code, length in self.properties)


@dataclass(frozen=True)
class Header:
    order: str  # "<", ">", or "a" for text
    elements: tuple[Element, ...]
    comments: tuple[str, ...]


def read_header(path: Path, file: BinaryIO, wanted: str = "the surfels.ply or mesh.ply of a run") -> Header:
    """Read the header up to the data. Raises InputError for a file without PLY header (the remedy is to give
    `wanted`) and for a header that promises more rows than the file contains."""

    def refuse(what: str) -> InputError:
        return InputError(what, path, "header", "the file is truncated or broken, export it again")

    first = file.readline(MAX_LINE)
    if first.strip() != b"ply":
        require_file(path)
        kind = next((f" but {name}" for magic, name in OTHERS.items() if first.startswith(magic)), "")
        raise InputError(f"not a PLY file{kind}", path, "header", f"give {wanted}")
    order, comments = "", []
    elements: list[Element] = []
    for _ in range(MAX_HEADER_LINES):
        line = file.readline(MAX_LINE)
        words = line.decode("ascii", errors="replace").split()
        if not line.endswith(b"\n") and words != ["end_header"]:
            raise refuse("no end_header")
        match words:
            case ["format", name, *_]:
                order = ORDERS.get(name, "")
            case ["comment" | "obj_info", *rest]:
                comments.append(" ".join(rest))
            case ["element", name, count] if count.isdigit() and len(count) < 19:
                elements.append(Element(name, int(count), []))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1].properties.append((name, TYPES[kind], ""))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= TYPES.keys():
                elements[-1].properties.append((name, TYPES[kind], TYPES[length]))
            case ["end_header"]:
                break
            case _:
                raise refuse(f"'{' '.join(words)[:40]}' is no line of a PLY header")
    else:
        raise refuse(f"no end_header in {MAX_HEADER_LINES} lines")
    if not order or not elements:
        raise refuse("no format or no element")
    left = os.fstat(file.fileno()).st_size - file.tell()
    for element in elements:
        names = {name for name, _, _ in element.properties}
        if not names:
            raise refuse(f"{element.name} has no property")
        if len(names) < len(element.properties):
            raise refuse(f"a property of {element.name} occurs twice")
        left -= element.count * element.row_bytes(order == "a")
        if left < (-1 if order == "a" else 0):  # text may end without a line break
            what, remedy = f"{element.count} rows are more than the file contains", "copy or export it again"
            raise InputError(what, path, element.name, remedy)
    return Header(order, (*elements,), (*comments,))


def read_vertices(path: Path) -> np.ndarray:
    """The numbers of the `vertex` element as a structured array (N,). Raises InputError as `read_header`."""
    require_file(path)
    with path.open("rb") as file:
        return read_rows(path, file, read_header(path, file))


def read_rows(path: Path, file: BinaryIO, header: Header) -> np.ndarray:
    """The same, after the header of the file has been read; lists and other elements are skipped."""
    text = header.order == "a"
    for element in header.elements:
        if element.name == "vertex":
            size = element.count * (8 if text else 1) * max(element.row_bytes(False), 1)
            require(PER_PLY_BYTE * size, f"{path}: vertex: {element.count:,} rows", "keep fewer of them")
        if text or len(element.fields) < len(element.properties):
            rows = _parsed(path, file, element, header.order)
        else:
            dtype = np.dtype([(name, header.order + code) for name, code in element.fields])
            rows = np.frombuffer(file.read(element.count * dtype.itemsize), dtype=dtype)
        if element.name == "vertex":
            return rows
    raise InputError("the element is missing", path, "vertex", "export it as a surfel PLY")


def _parsed(path: Path, file: BinaryIO, element: Element, order: str) -> np.ndarray:
    """Rows of an element that is text or has lists, whose numbers are float64."""
    rows = np.empty(element.count, dtype=[(name, "f8") for name, _ in element.fields])
    words: Iterator[bytes] = iter(())

    def take(code: str) -> float:
        if order == "a":
            return float(next(words))
        return struct.unpack(order + np.dtype(code).char, file.read(int(code[1])))[0]

    for row in range(element.count):
        try:
            words = iter(file.readline().split() if order == "a" else ())
            numbers = []
            for _, code, length in element.properties:
                if length:
                    [take(code) for _ in range(int(take(length)))]
                else:
                    numbers.append(take(code))
            if any(words):
                raise ValueError("more numbers than properties")
            rows[row] = (*numbers,)
        except (ValueError, OverflowError, StopIteration, struct.error) as error:
            what = f"row {row} is broken or missing"
            raise InputError(what, path, element.name, "copy or export the file again") from error
    return rows
