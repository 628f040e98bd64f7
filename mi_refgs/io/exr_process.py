"""Reads EXR files in a process of its own, which a broken file may end; a script that `exr` runs. For each
line of standard input, JSON of the arguments of `parts`, it writes a pickle: the result or a message."""

from __future__ import annotations

import json
import os
import pickle
import signal
import sys
from typing import Any

import OpenEXR

SECONDS = 300  # for one file, after which this process ends
LAYOUTS = {OpenEXR.ENVMAP_CUBE: "cube", OpenEXR.ENVMAP_LATLONG: "lat-long"}


def parts(path: str, pixels: bool) -> list[dict[str, Any]]:
    """Fields of `exr.Part`, of built-in types."""
    with OpenEXR.File(path, separate_channels=True, header_only=not pixels) as file:
        return [_fields(part, part.header, pixels) for part in file.parts]


def _fields(part: Any, header: dict[str, Any], pixels: bool) -> dict[str, Any]:
    flat = header["type"] in (OpenEXR.scanlineimage, OpenEXR.tiledimage)
    channels: dict[str, Any] = dict.fromkeys(channel.name for channel in header["channels"])
    for name in channels if pixels and flat else ():
        array = part.channels[name].pixels
        channels[name] = array.dtype.str, array.shape, array.tobytes()
    windows = ([int(x) for corner in header[f"{name}Window"] for x in corner] for name in ("data", "display"))
    names = header.get("name", ""), LAYOUTS.get(header.get("envmap")), header.get("chromaticities")
    keys = ("flat", "channels", "data", "display", "name", "layout", "chromaticities")
    return dict(zip(keys, (flat, channels, *windows, *names), strict=True))


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # OpenEXR prints warnings to standard output
    for line in sys.stdin:
        signal.alarm(SECONDS)
        try:
            answer: Any = parts(*json.loads(line))
        except Exception as error:  # RuntimeError, TypeError or types of its own
            answer = str(error)
        pickle.dump(answer, answers)
        answers.flush()
