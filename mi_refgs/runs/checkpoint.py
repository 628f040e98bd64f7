"""A checkpoint: named arrays in an .npz file that NumPy reads, with a checksum of all its bytes.

The comment of the archive is "sha256 " and the SHA-256 of every byte before the digest: the checksum is
written with the content, and a change of any bit is found. A file without it does not count as a checkpoint.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods.method import APART, AROUND, BACKGROUND, LIGHT
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.kind import LightKind, LightOfFit
from mi_refgs.shade.light.near_field import NearField
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.surfels.table import Surfels


def channels_of(params: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The channels of the object's table by name, or with the prefix AROUND those of the surroundings."""
    if prefix:
        return {name.removeprefix(prefix): x for name, x in params.items() if name.startswith(prefix)}
    return {name: x for name, x in params.items() if name not in APART and not name.startswith(AROUND)}


def light_of(kind: LightKind | None, params: Mapping[str, Any]) -> LightOfFit | None:
    """The light that the object reflects, if there is one; raises InputError for a wrong shape."""
    return None if kind is None or LIGHT not in params else kind.of(params[LIGHT])


def surroundings_of(params: Mapping[str, Any]) -> Surroundings | None:
    """The surroundings, if there are any; raises InputError for wrong shapes."""
    if not (channels := channels_of(params, AROUND)):
        return None
    behind = EnvironmentLight(params[BACKGROUND]) if BACKGROUND in params else None
    return Surroundings(Surfels(channels), behind)


def near_field_of(state: Mapping[str, np.ndarray]) -> NearField | None:
    """Distances of what the environment map of a checkpoint shows, if it was compared with photographs."""
    arrays = part(state, PHOTOGRAPHED)
    return NearField(arrays["centre"], arrays["nearness"]) if arrays else None


PARAMS, OPTIMISER, MESH, PHOTOGRAPHED = "params/", "optimiser/", "mesh/", "photographed/"
"""Prefixes of the names of parameters, of Adam's moments, of the occluder and of the photographed light."""
_MARK = b"sha256 "
_DIGITS = 64


class DamagedError(Exception):
    """The file is no checkpoint of ours, or not all of one; the message says what is wrong with it."""


class UnregisteredError(DamagedError):
    """The file is whole, but has an attribute that this process does not know; the message names it."""


def encode(state: Mapping[str, np.ndarray]) -> bytes:
    """The bytes of a checkpoint."""
    buffer = io.BytesIO()
    np.savez(buffer, **state)  # type: ignore[arg-type]
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.comment = _MARK + b"0" * _DIGITS
    content = buffer.getvalue()[:-_DIGITS]
    return content + hashlib.sha256(content).hexdigest().encode()


def decode(data: bytes) -> dict[str, np.ndarray]:
    """The state in the bytes of a checkpoint; raises DamagedError for what `encode` cannot have written."""
    content, digest = data[:-_DIGITS], data[-_DIGITS:]
    if not content.endswith(_MARK) or hashlib.sha256(content).hexdigest().encode() != digest:
        raise DamagedError("its checksum is wrong or missing")
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            state = {name: archive[name] for name in archive.files}
    except (ValueError, EOFError, KeyError, OSError, MemoryError, zipfile.BadZipFile) as error:
        raise DamagedError(f"no .npz of arrays: {error}") from error
    for prefix in ("", AROUND):  # version 0.1: screen-space gradients in place of errors
        if f"{prefix}gradient_sum" in state:
            state[f"{prefix}error_sum"] = state.pop(f"{prefix}gradient_sum")
            del state[f"{prefix}gradient_count"]
    check(state)
    return state


def read(path: Path) -> dict[str, np.ndarray]:
    """The state in a file; raises DamagedError, also for a file that cannot be read."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DamagedError(f"cannot be read: {error.strerror}") from error
    return decode(data)


def tensors(state: Mapping[str, np.ndarray], prefix: str) -> dict[str, Any]:
    """The tensors of a checkpoint whose names begin with a prefix, by the rest of their names."""
    return {name: upload_tensor(value) for name, value in part(state, prefix).items()}


def part(state: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The arrays of a checkpoint whose names begin with a prefix, by the rest of their names."""
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def check(state: Mapping[str, np.ndarray]) -> None:
    """Raise DamagedError unless every array that a fit goes on from is there, finite and of its shape."""
    params = part(state, PARAMS)
    names = [*channels_of(params), *channels_of(params, AROUND)]
    if unknown := [name for name in names if name not in ATTRIBUTES]:
        raise UnregisteredError(
            f"surfels: {unknown[0]}: the attribute is not registered here; register it as when the run was "
            "fitted, and repeat the command"
        )
    try:
        table = Surfels(channels_of(params))
        geometry = table.primitive.widths
        around = surroundings_of(params)
        if around is not None:
            around.check(table)
    except InputError as error:
        raise DamagedError(str(error)) from error
    scalars = ["iteration", "seconds", "held_until"]
    signed = [f"{PARAMS}{name}" for name in {*geometry, *params}]
    for tensor, values in params.items():
        _check(state, [f"{OPTIMISER}{tensor}/first"], (values.size,), signed=True)
        _check(state, [f"{OPTIMISER}{tensor}/second"], (values.size,))
        scalars += [f"{OPTIMISER}{tensor}/{name}" for name in ("steps", "factor", "usual")]
    _check(state, scalars, ())
    tables = {"": table} | ({} if around is None else {AROUND: around.surfels})
    for prefix, rows in tables.items():
        _check(state, [f"{prefix}error_sum"], (rows.count,))
    _check(state, signed, signed=True)
    if part(state, PHOTOGRAPHED):
        if LIGHT not in params:
            raise DamagedError(f"{PHOTOGRAPHED}weight: there is no light")
        height = len(state.get(f"{PHOTOGRAPHED}radiance", ()))
        _check(state, [f"{PHOTOGRAPHED}centre"], (3,), signed=True)
        _check(state, [f"{PHOTOGRAPHED}radiance"], (height, 2 * height, 3))
        _check(state, [f"{PHOTOGRAPHED}{name}" for name in ("nearness", "weight")], (height, 2 * height))
    if part(state, MESH):
        _check(state, [f"{MESH}voxel"], ())
        _check(state, [f"{MESH}vertices", f"{MESH}faces"], (None, 3), signed=True)
        faces, vertices = state[f"{MESH}faces"], state[f"{MESH}vertices"]
        if faces.dtype.kind != "u" or (faces.size and faces.max() >= len(vertices)):
            raise DamagedError(f"{MESH}faces: names vertices that are not there")
        if f"{MESH}surfels" in state:
            _check(state, [f"{MESH}surfels", f"{MESH}weights"], (None, len(vertices)))
            _check(state, [f"{MESH}normals"], (3, len(vertices)), signed=True)
            surfels = state[f"{MESH}surfels"]
            if surfels.dtype.kind != "u" or np.any(surfels >= table.count):
                raise DamagedError(f"{MESH}surfels: names surfels that are not there")
        if f"{MESH}ambient" in state:
            _check(state, [f"{MESH}ambient"], vertices.shape)


def _check(
    state: Mapping[str, np.ndarray],
    names: Iterable[str],
    shape: tuple[int | None, ...] | None = None,
    signed: bool = False,
) -> None:
    """Numbers, finite, of the shape if one is given (None: any size), and not negative unless `signed`."""
    for name in names:
        values = state.get(name)
        if values is None:
            raise DamagedError(f"{name}: missing")
        fits = shape is None or (
            len(shape) == values.ndim
            and all(size in (None, found) for size, found in zip(shape, values.shape, strict=True))
        )
        if values.dtype.kind not in "fiu" or not fits:
            raise DamagedError(f"{name}: found {values.dtype} of shape {values.shape}")
        if not np.all(np.isfinite(values)) or (not signed and np.any(values < 0)):
            raise DamagedError(f"{name}: has a value that is not finite or out of range")
