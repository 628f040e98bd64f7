"""A checkpoint: named arrays in an .npz file whose comment is "sha256 " and that of all bytes before it."""

import hashlib
import io
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np

from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods.method import APART, AROUND, BACKGROUND, LIGHT, LIGHT_ROTATION, LIGHT_SCALE
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.kind import FittedLight, LightKind
from mi_refgs.shade.light.placed import PlacedLight
from mi_refgs.surfels.attributes import attribute
from mi_refgs.surfels.table import Surfels


def channels_of(params: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The channels of the object's table by name, or with the prefix AROUND those of the surroundings."""
    if prefix:
        return part(params, prefix)
    return {name: x for name, x in params.items() if name not in APART and not name.startswith(AROUND)}


def light_of(kind: LightKind | None, params: Mapping[str, Any]) -> FittedLight | None:
    """The light that the object reflects, if there is one; raises InputError for a wrong shape."""
    if kind is None or LIGHT not in params:
        return None
    if kind.placement:
        return PlacedLight(params[LIGHT], params.get(LIGHT_ROTATION), params.get(LIGHT_SCALE))
    return kind.of(params[LIGHT])


def surroundings_of(params: Mapping[str, Any]) -> Surroundings | None:
    """The surroundings, if there are any; raises InputError for wrong shapes."""
    if not (channels := channels_of(params, AROUND)):
        return None
    behind = EnvironmentLight(params[BACKGROUND]) if BACKGROUND in params else None
    return Surroundings(Surfels(channels), behind)


PARAMS, OPTIMISER, MESH, PHOTOGRAPHED = "params/", "optimiser/", "mesh/", "photographed/"
"""Prefixes of the names of parameters, of Adam's moments, of the occluder and of the photographed light."""
VERSION = 1  # of the names and shapes of the arrays
_MARK = b"sha256 "
_DIGITS = 64


class DamagedError(Exception):
    """The file is no checkpoint of ours, or not all of one."""


def encode(state: Mapping[str, np.ndarray]) -> bytes:
    """The bytes of a checkpoint."""
    buffer = io.BytesIO()
    np.savez(buffer, version=np.array(VERSION), **state)  # type: ignore[arg-type]
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.comment = _MARK + b"0" * _DIGITS
    content = buffer.getvalue()[:-_DIGITS]
    return content + hashlib.sha256(content).hexdigest().encode()


def decode(data: bytes) -> dict[str, np.ndarray]:
    """The state in the bytes of a checkpoint; raises DamagedError for what `encode` did not write, and
    UnknownNameError for an attribute that is not registered."""
    content, digest = data[:-_DIGITS], data[-_DIGITS:]
    if not content.endswith(_MARK) or hashlib.sha256(content).hexdigest().encode() != digest:
        raise DamagedError("its checksum is wrong or missing")
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        state = {name: archive[name] for name in archive.files}
    if (version := int(state.pop("version"))) != VERSION:
        raise DamagedError(f"it has version {version}, not {VERSION}")
    for name in (*channels_of(params := part(state, PARAMS)), *channels_of(params, AROUND)):
        attribute(name)
    return state


def tensors(state: Mapping[str, np.ndarray], prefix: str) -> dict[str, Any]:
    return {name: upload_tensor(value) for name, value in part(state, prefix).items()}


def part(state: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """The arrays whose names begin with a prefix, by the rest of their names."""
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
