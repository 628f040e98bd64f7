"""Reads EXR files in a process of its own, which a broken file may end; a script that `exr` runs. A line of
standard input is JSON of a path and whether its pixels are wanted; out come pickled parts, or a message."""

import json
import os
import pickle
import signal
import sys
from typing import Any

import numpy as np
import OpenEXR

SECONDS = 300  # for one file, after which this process ends
LAYOUTS = {OpenEXR.ENVMAP_CUBE: "cube", OpenEXR.ENVMAP_LATLONG: "lat-long"}


def fields(part: Any, header: dict[str, Any], pixels: bool) -> dict[str, Any]:
    """Fields of `exr.Part`, of built-in types."""
    flat = header["type"] in (OpenEXR.scanlineimage, OpenEXR.tiledimage)
    channels: dict[str, Any] = dict.fromkeys(channel.name for channel in header["channels"])
    for name in channels if pixels and flat else ():
        array = part.channels[name].pixels
        channels[name] = array.dtype.str, array.shape, array.tobytes()
    found = {key: np.ravel(header[f"{key}Window"]).tolist() for key in ("data", "display")}
    found |= {key: header.get(key) for key in ("name", "chromaticities")}
    return found | {"flat": flat, "channels": channels, "layout": LAYOUTS.get(header.get("envmap"))}


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # OpenEXR prints warnings to standard output
    for line in sys.stdin:
        signal.alarm(SECONDS)
        path, pixels = json.loads(line)
        try:
            with OpenEXR.File(path, separate_channels=True, header_only=not pixels) as file:
                answer: Any = [fields(part, part.header, pixels) for part in file.parts]
        except Exception as error:  # RuntimeError, TypeError or types of its own
            answer = str(error)
        pickle.dump(answer, answers)
        answers.flush()
        signal.alarm(0)
