"""Read arrays from untrusted pickle files: nothing in the file is called, and only plain numbers result.

A pickle is a program. Its instructions are compared with a list first; the few names of NumPy that it may
use become records of the calls; and the arrays are made of these records after our own checks. A value is
hashed, compared or shown only after its type is known: tuples that share their parts take exponential time.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.errors import InputError

MAX_BYTES = 2**16  # longest file; a camera has a few hundred bytes
MAX_ITEMS = 1000  # largest number of arrays in a list
NAMES = {
    **{(f"numpy.{core}.multiarray", "_reconstruct"): "array" for core in ("core", "_core")},
    ("numpy", "ndarray"): "type",
    ("numpy", "dtype"): "dtype",
    ("_codecs", "encode"): "bytes",  # how protocols 0 to 2 write bytes
}
CODES = {"f4", "f8", "i4", "i8"}  # types of the numbers in an array
INSTRUCTIONS = {
    *"PROTO FRAME STOP MARK POP POP_MARK DUP NONE NEWTRUE NEWFALSE MEMOIZE PUT BINPUT LONG_BINPUT".split(),
    *"GET BINGET LONG_BINGET INT BININT BININT1 BININT2 LONG LONG1 FLOAT BINFLOAT STRING BINSTRING".split(),
    *"SHORT_BINSTRING BINBYTES SHORT_BINBYTES UNICODE BINUNICODE SHORT_BINUNICODE LIST EMPTY_LIST".split(),
    *"APPEND APPENDS TUPLE EMPTY_TUPLE TUPLE1 TUPLE2 TUPLE3 GLOBAL STACK_GLOBAL REDUCE BUILD".split(),
}


class Record:
    """A name in a pickle, the arguments of its call, and the state that is set."""

    __slots__ = ("arguments", "kind", "state")

    def __init__(self, kind: str, arguments: tuple[Any, ...] = ()) -> None:
        self.kind, self.arguments, self.state = kind, arguments, None

    def __call__(self, *arguments: Any) -> Record:
        return Record(self.kind, arguments)

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        kind = NAMES.get((module, name))
        if kind is None:
            raise pickle.UnpicklingError(f"it contains {module[:40]}.{name[:40]}, which is no array")
        return Record(kind)


def read_arrays(path: Path) -> list[np.ndarray]:
    """Read a pickled list of arrays as float64.

    Raises InputError for a file that is missing, broken, or contains anything else.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise ValueError("it is too long")
        for instruction, argument, _ in pickletools.genops(io.BytesIO(data)):
            if instruction.name not in INSTRUCTIONS:
                raise ValueError(f"it has the instruction {instruction.name}")
            if instruction.name.endswith("PUT") and not (argument or 0) <= len(data):
                raise ValueError("it has more memo entries than bytes")  # each would take memory
        found = _Unpickler(io.BytesIO(data), encoding="latin1").load()
        if not isinstance(found, list | tuple) or len(found) > MAX_ITEMS:
            raise ValueError("it is no list")
        return [_array(item) for item in found]
    except Exception as error:  # what a broken pickle raises has no common type
        raise InputError(
            f"{path}: pickle: no list of arrays ({str(error)[:100]}); copy the file again, or do not trust it"
        ) from error


def _array(item: Any) -> np.ndarray:
    if not isinstance(item, Record) or item.kind != "array" or not isinstance(item.state, tuple):
        raise ValueError("it contains something else")
    _, shape, dtype, by_columns, values = item.state
    code, order = dtype.arguments[0], dtype.state[1]
    if isinstance(values, Record):
        values = values.arguments[0].encode("latin1")
    # Types are compared before values: see the docstring of this file.
    plain = isinstance(code, str) and isinstance(order, str) and isinstance(values, bytes)
    if not plain or code not in CODES or order not in ("<", ">"):
        raise ValueError("it contains no plain numbers")
    sides = isinstance(shape, tuple) and all(type(side) is int and 0 <= side <= MAX_BYTES for side in shape)
    if not sides or len(shape) > 2 or math.prod(shape) * int(code[1]) != len(values):
        raise ValueError("an array's shape is not that of its numbers")
    array = np.frombuffer(values, dtype=order + code).astype(np.float64)
    return array.reshape(shape, order="F" if by_columns else "C")
