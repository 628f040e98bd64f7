"""EXR files as NumPy arrays, read in a process of their own (`exr_process`), and written atomically."""

import atexit
import itertools
import json
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from subprocess import DEVNULL, PIPE
from typing import Any

import numpy as np

from mi_refgs.errors import InputError, counted
from mi_refgs.io.files import check_size, replace_file, require_file
from mi_refgs.io.progress import note

EXR_MAGIC = b"\x76\x2f\x31\x01"  # first bytes of every EXR file
SRGB = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)  # x, y of R, G, B, white (BT.709)
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear R, G, B (ITU-R BT.709)
_lock = threading.Lock()
_processes: dict[int, subprocess.Popen[bytes]] = {}
"""The process that reads files, by the id of the one that has started it: forks do not share it."""


@dataclass(frozen=True)
class Part:
    """A part of an EXR file. Windows are left, top, right, bottom: the first and last column and row."""

    flat: bool  # not of deep pixels
    channels: Mapping[str, Any]  # type, shape and bytes by name, or None if only the header was read
    data: tuple[int, int, int, int]  # window of the pixels that are stored
    display: tuple[int, int, int, int]  # window of the image
    name: str | None
    layout: str | None  # of an environment, "cube" or "lat-long", if the header says it
    chromaticities: tuple[float, ...] | None

    @property
    def size(self) -> tuple[int, int]:
        return self.display[2] - self.display[0] + 1, self.display[3] - self.display[1] + 1

    def plane(self, name: str) -> np.ndarray:
        """A channel (H, W) as it is stored, in the display window with 0 around it; the samples of a coarser
        one, as of chroma, are repeated."""
        (left, top, right, bottom), (x, y, _, _), (width, height) = self.data, self.display, self.size
        kind, shape, data = self.channels[name]
        stored = np.frombuffer(data, kind).reshape(shape)
        for axis, wanted in enumerate((bottom - top + 1, right - left + 1)):
            if shape[axis] < wanted:
                stored = stored.repeat(-(-wanted // shape[axis]), axis).take(range(wanted), axis)
        shown = stored[max(y - top, 0) : y + height - top, max(x - left, 0) : x + width - left]
        plane = np.zeros((height, width), stored.dtype)
        plane[max(top - y, 0) :, max(left - x, 0) :][: shown.shape[0], : shown.shape[1]] = shown
        return plane


def _ask(path: Path, pixels: bool) -> list[Part]:
    """The parts of a file; raises InputError, also if the process that reads it ends."""
    field, remedy = "pixels" if pixels else "header", "export it again"
    with _lock:
        process = _processes.get(os.getpid())
        if process is None or process.poll() is not None:
            script = [sys.executable, "-P", str(Path(__file__).with_name("exr_process.py"))]
            places = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
            process = subprocess.Popen(
                script, stdin=PIPE, stdout=PIPE, stderr=DEVNULL, env=places, start_new_session=True
            )
            _processes[os.getpid()] = process
        assert process.stdin and process.stdout
        try:
            process.stdin.write(json.dumps([str(path.absolute()), pixels]).encode() + b"\n")
            process.stdin.flush()
            answer = pickle.load(process.stdout)
        except BaseException as error:  # also Ctrl-C: its answer must not be that of the next file
            status = _end()
            if not isinstance(error, Exception):
                raise
            what = f"reading it ended the process of the EXR library (status {status})"
            raise InputError(what, path, field, remedy) from error
    if isinstance(answer, str):
        raise InputError(f"not a readable EXR file ({answer})", path, field, remedy)
    return [Part(**fields) for fields in answer]


@atexit.register
def _end() -> int:
    """End the process that reads files; returns its status."""
    if process := _processes.pop(os.getpid(), None):
        process.kill()
        process.communicate()
    return process.returncode if process else 0


def _read(path: Path, vectors: bool = False, pixels: bool = True) -> tuple[Part, list[str]]:
    """The first flat part of a file with colour, else with any image, and its channels; raises InputError."""
    require_file(path)
    parts = _ask(path, pixels=False)
    flat = [(index, part, _names(part.channels, vectors)) for index, part in enumerate(parts) if part.flat]
    if not flat:
        raise InputError("deep pixels" if parts else "no parts", path, "header", "flatten the image")
    index, part, names = max(flat, key=lambda found: min(len(found[2]), 3))  # colour, else grey
    left, top, right, bottom = part.data
    if (np.minimum(part.data[2:], part.display[2:]) < np.maximum(part.data[:2], part.display[:2])).any():
        raise InputError("no pixel is in the display window", path, "dataWindow", "export it again")
    check_size(path, right - left + 1, bottom - top + 1, 2 * len(part.channels))  # bytes of half floats
    check_size(path, *part.size, 1)
    if not names:
        remedy = f"export R, G, B (and A), {'X, Y, Z, ' if vectors else ''}or one channel (and A)"
        raise InputError(f"found {', '.join(sorted(part.channels))}", path, "channels", remedy)
    coloured = len(names) > 2 and not names[0].endswith("X")
    if coloured and not np.allclose(part.chromaticities or SRGB, SRGB, atol=1e-3):
        raise InputError("not those of sRGB", path, "chromaticities", "convert the image to linear sRGB")
    if len(parts) > 1:
        note(path, f"{len(parts)} parts, of which '{part.name}' is read")
    if layer := names[0].rpartition(".")[0]:
        note(path, f"{len(part.channels)} channels, of which those of the layer '{layer}' are read")
    if part.data != part.display:
        note(path, f"pixels {part.data} are placed in the display window {part.display}, with 0 around them")
    if pixels:
        parts = _ask(path, pixels=True)
        if index >= len(parts) or parts[index].channels.keys() != part.channels.keys():
            raise InputError("not a readable EXR file (broken pixels)", path, "pixels", "export it again")
    return parts[index], names


def _names(channels: Collection[str], vectors: bool) -> list[str]:
    """The channels of an image, in order: of those without a layer, else of the first layer with Combined in
    its name (Blender's), else of the first one; [] if there are none."""
    layers: dict[str, set[str]] = {}
    for name in channels:
        layer, _, channel = name.rpartition(".")
        layers.setdefault(layer, set()).add(channel)
    order = sorted(layers, key=lambda layer: (layer != "", "Combined" not in layer, layer))
    colour = ["R G B A", "R G B", "X Y Z", "Y RY BY"] if vectors else ["R G B A", "R G B", "Y RY BY"]
    for kinds in (colour, ["Y A", "Y"]):
        for layer, kind in itertools.product(order, kinds):
            wanted, found = kind.split(), layers[layer]
            if found.issuperset(wanted) and (kinds is colour or len(found) == len(wanted)):
                return [f"{layer}.{channel}" if layer else channel for channel in wanted]
    return list(channels) if len(channels) == 1 else []


def _image(path: Path, names: list[str], planes: list[np.ndarray]) -> np.ndarray:
    """Channels (H, W) as an image (H, W, C) float32, luminance and chroma as R, G, B; raises InputError
    unless all are finite."""
    image = np.stack(planes, axis=-1).astype(np.float32)
    if not (finite := np.isfinite(image)).all():
        bad = np.argwhere(~finite)
        what = f"{len(bad)} NaN or infinite values, the first at row {bad[0, 0]}, column {bad[0, 1]}"
        raise InputError(what, path, f"channel {names[bad[0, 2]]}", "render the image again")
    if names[-1].endswith("BY"):
        y, red, blue = image[..., 0], (image[..., 1] + 1) * image[..., 0], (image[..., 2] + 1) * image[..., 0]
        image = np.stack([red, (y - LUMINANCE[0] * red - LUMINANCE[2] * blue) / LUMINANCE[1], blue], axis=-1)
    return image


def read_exr_image(path: str | Path, vectors: bool = False) -> np.ndarray:
    """EXR file as float32 (H, W, C): RGBA, RGB, YA or one channel; with `vectors` also XYZ. Raises InputError
    without such channels, unless all are finite, and for primaries other than sRGB's."""
    part, names = _read(Path(path), vectors)
    return _image(Path(path), names, [part.plane(name) for name in names])


def read_exr_light(path: Path) -> tuple[np.ndarray, str | None]:
    """Colour (H, W, 3) float32 of a light, and `Part.layout`; raises InputError as `read_exr_image`. Infinity
    becomes the largest half float in half floats, which overflow, else the largest value."""
    part, names = _read(path)
    planes = [part.plane(name) for name in names]
    if (infinite := np.isposinf(planes)).any():
        half = planes[0].dtype == np.float16
        largest = np.finfo(np.float16).max if half else np.max(planes, where=~infinite, initial=0)
        planes, count = [*np.where(infinite, largest, planes)], int(infinite.any(axis=0).sum())
        kind = "half float" if half else "value"
        note(path, f"{counted(count, 'infinite texel')} set to {largest:g}, the largest {kind}")
    image = _image(path, names, planes)
    return (image[..., :3] if len(names) > 2 else image[..., [0, 0, 0]]), part.layout


def exr_header(path: Path) -> tuple[int, int, bool]:
    """Width and height of the display window, and whether colour has alpha; raises as `read_exr_image`."""
    part, names = _read(path, pixels=False)
    return *part.size, len(names) == 4


def write_exr(path: str | Path, image: np.ndarray, names: str | None = None, half: bool = False) -> None:
    """Write an (H, W, C) or (H, W) array as ZIP-compressed EXR, float32 or float16, atomically. `names` has
    one letter per channel, by default Y, RGB or RGBA. Raises InputError as `replace_file` does."""
    planes = np.atleast_3d(image)
    names = names or {1: "Y", 3: "RGB", 4: "RGBA"}[planes.shape[-1]]
    dtype = np.float16 if half else np.float32
    write_exr_layers(path, {name: planes[..., i].astype(dtype) for i, name in enumerate(names)})


def write_exr_layers(path: str | Path, layers: Mapping[str, np.ndarray]) -> None:
    """Write (H, W) arrays of float32 or float16 by name of channel, as `write_exr` does."""
    import OpenEXR

    channels = {name: np.ascontiguousarray(plane) for name, plane in layers.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    replace_file(path, lambda temporary: OpenEXR.File(header, channels).write(str(temporary)))
