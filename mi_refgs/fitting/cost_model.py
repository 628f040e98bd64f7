"""Cache of the speed of methods on this machine.

One JSON file per kind of method, in the user's cache folder; its name depends on the machine, the number of
threads and the version. A file that cannot be read is ignored. The image size of a fit follows from these
files only, so it does not depend on the present load of the machine.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mi_refgs.errors import InputError
from mi_refgs.io.files import locked, read_json, write_json

SIZES = 96, 224
"""Sides in pixels of the images that speeds are measured on: a step on the second takes twice as long."""
FOLDER_VARIABLE = "MI_REFGS_CACHE"  # environment variable with the folder of these files
PATIENCE = 120.0  # seconds to wait for another process that measures the same


@dataclass(frozen=True)
class Speed:
    """Seconds of a step of each stage at each of SIZES, and of the extraction of a mesh at the first."""

    stages: dict[str, list[float]]
    mesh: float  # of its volume
    mesh_view: float  # of each view

    def step(self, stage: str, pixels: int) -> float:
        """Seconds of a step with an image of so many pixels: linear, at least half of the smaller
        measurement."""
        small, large = self.stages[stage]
        low, high = (side * side for side in SIZES)
        slope = max(large - small, 0) / (high - low)
        return float(max(small + slope * (pixels - low), 0.5 * small))


def folder() -> Path:
    """The folder: $MI_REFGS_CACHE, or mi_refgs in $XDG_CACHE_HOME or ~/.cache."""
    if named := os.environ.get(FOLDER_VARIABLE):
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mi_refgs"


def kept(subject: dict[str, Any], measure: Callable[[], Speed]) -> Speed:
    """Read the speed of `subject`, a machine and a method, from its file; otherwise measure and write it."""
    key = hashlib.sha256(json.dumps(subject, sort_keys=True).encode()).hexdigest()[:24]
    path = folder() / f"speed-{key}.json"
    if (speed := _read(path, subject)) is not None:
        return speed
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(InputError):
            busy = f"{path}: another process measures it; wait until it ends"
            stack.enter_context(locked(path.with_suffix(".lock"), busy, PATIENCE))
        if (speed := _read(path, subject)) is not None:  # by the process that had the lock
            return speed
        speed = measure()
        with contextlib.suppress(InputError):
            write_json(path, {"subject": subject, "speed": asdict(speed)})
    return speed


def _read(path: Path, subject: dict[str, Any]) -> Speed | None:
    """The speed in a file; None if it is missing, damaged, or of another subject."""
    try:
        content = read_json(path)
        if content["subject"] != subject:
            return None
        speed = Speed(**content["speed"])
        numbers = [*(x for pair in speed.stages.values() for x in (min(pair), max(pair))), 1.0]
        usable = all(len(pair) == len(SIZES) for pair in speed.stages.values()) and min(numbers) > 0
        return speed if usable and math.isfinite(sum(numbers) + speed.mesh + speed.mesh_view) else None
    except (InputError, KeyError, TypeError, ValueError, AttributeError):
        return None


def summary() -> list[str]:
    """Sentences about the cached speeds: one per number of threads, and how to measure them again."""
    threads: Counter[Any] = Counter()
    for path in sorted(folder().glob("speed-*.json")):
        with contextlib.suppress(InputError, KeyError, TypeError):
            threads[read_json(path)["subject"]["threads"]] += 1
    found = [f"{count} measured with {n} thread{'s' * (n != 1)}" for n, count in threads.items()]
    return [*found, f"in {folder()}, which may be removed to measure them anew"] if found else []
