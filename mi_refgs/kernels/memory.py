"""Memory that a computation needs and that is available; upper bounds."""

import math
from pathlib import Path

import psutil

from mi_refgs.errors import InputError

PASS_SAMPLES = 1 << 22  # per pass: pixels times samples per pixel; smaller ones project surfels more often
DERIVATIVE_SAMPLES = 1 << 21  # per pass with derivatives, which need more memory each
# Bytes:
BASE = 0.4e9  # of a process with its kernels
PER_SAMPLE, PER_DERIVATIVE_SAMPLE, PER_CHANNEL = 60, 260, 5  # of a pass, and of each of its channels
PER_VALUE, PER_STACKED_VALUE = 10, 28  # per pixel and channel of an image of one pass, of stacked passes
PER_SHOWN_SURFEL, PER_DERIVATIVE_SURFEL = 700, 1000  # of an image: attributes, rows, tile lists, gradients
PER_PIXEL, PER_SURFEL = 3e3, 2.5e3  # of a training step; surfels with moments and gradients
PER_TEXEL = 400  # of a texture while it is baked
PER_PATH = 100  # of Mitsuba's path tracer
PER_PLY_BYTE = 4  # of the vertices of a PLY file: read, checked, and as arrays

CGROUPS, PROC = Path("/sys/fs/cgroup"), Path("/proc")


def require_image(
    size: tuple[int, int], samples: int, surfels: int, channels: int, derivatives: bool = False
) -> None:
    """Raise InputError if an image of this size, of so many samples per pixel, would not fit into memory."""
    pixels = size[0] * size[1]
    most, each, per_surfel = PASS_SAMPLES, PER_SAMPLE, PER_SHOWN_SURFEL
    if derivatives:
        most, each, per_surfel = DERIVATIVE_SAMPLES, PER_DERIVATIVE_SAMPLE, PER_DERIVATIVE_SURFEL
    together = min(pixels * samples, most)
    per_value = PER_VALUE if together == pixels * samples else PER_STACKED_VALUE
    image = per_value * channels * pixels
    needed = BASE + image + (each + PER_CHANNEL * channels) * together + per_surfel * surfels
    what = f"image: {size[0]} × {size[1]} pixels of {surfels:,} surfels"
    require(needed, what, "ask for fewer pixels or AOVs")


def of_fit(pixels: int, surfels: int, images: float) -> float:
    """Bytes of a fit with so many pixels per step, surfels at most, and bytes of images in memory."""
    return BASE + images + PER_PIXEL * pixels + PER_SURFEL * surfels


def require(needed: float, what: str, remedy: str) -> None:
    """Raise InputError, with `what` and `remedy`, if a process that needs so many bytes would not fit."""
    there = available() + resident()
    if needed > there:
        numbers = f"needs {needed / 1e9:.2g} GB of memory, {there / 1e9:.2g} GB are available"
        raise InputError(numbers, what, remedy=remedy)


def available() -> float:
    """Bytes that this process may still allocate, by the machine and its control groups."""
    return min(psutil.virtual_memory().available, *_groups(), math.inf)


def resident() -> float:
    """Bytes that this process has allocated."""
    return float(psutil.Process().memory_info().rss)


def _groups() -> list[float]:
    """Bytes that the control groups (version 2) of this process leave."""
    try:
        lines = (PROC / "self/cgroup").read_text().splitlines()
    except OSError:
        return []
    places = [CGROUPS / line.removeprefix("0::/") for line in lines if line.startswith("0::")]
    groups = (group for place in places for group in (place, *place.parents))
    return [_left(group) for group in groups if group.is_relative_to(CGROUPS)]


def _left(group: Path) -> float:
    try:
        limit = float((group / "memory.max").read_text().strip().replace("max", "inf"))
        stat = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        cache = sum(float(stat.get(name, 0)) for name in ("active_file", "inactive_file"))
        return max(limit - float((group / "memory.current").read_text()) + cache, 0)
    except (OSError, ValueError):
        return math.inf
