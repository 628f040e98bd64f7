"""How long a fit takes and how much memory it needs, before its first step; what size of pictures fits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import drjit as dr

from mi_refgs.fitting.cost_model import Speed
from mi_refgs.fitting.runner import read_views, sized
from mi_refgs.fitting.speed import speed_of
from mi_refgs.fitting.targets import bytes_of
from mi_refgs.methods.method import Method
from mi_refgs.methods.presets import PRESETS

WHOLE = 256 * 256
"""Pixels of an image up to which it is read whole, unless the method says otherwise."""
LEAST = 96
"""Pixels of the shorter side that no data set is read smaller than: what is left shows no surface."""
SAFETY = 0.8
"""Share of the promised time that the estimate may take: data sets differ by as much."""
GROWTH, OPEN_GROWTH = 1.0, 0.6
"""Mean time of a step over that of the stand-in, with alpha and without: tables grow, but what is opaque
hides what lies behind it, and without alpha surfels start far larger than they end."""
START = 10.0
"""Seconds for the visual hull, previews, checkpoints and artefacts."""
DECODING = 1.5e-8
"""Seconds for a pixel of a file, once for each picture: JPEG 8e-9, PNG 2e-8."""
WORTH = 1e7
"""Iterations × pixels from which a fit takes minutes, and an estimate is worth its own seconds."""


@dataclass(frozen=True)
class Estimate:
    """What a fit will need."""

    seconds: float
    bytes: float
    width: int
    height: int

    def sentence(self, iterations: int) -> str:
        """For people."""
        return (
            f"estimate: {minutes(self.seconds)} and {self.bytes / 1e9:.1f} GB for {iterations} iterations on "
            f"{self.width} × {self.height} pixels with {dr.thread_count()} threads"
        )


def minutes(seconds: float) -> str:
    """A time for people, not more exact than it is."""
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.1f} min"


def planned(
    method: Method, path: Path, limit: float | None = None, tell: Callable[[str], None] = lambda _: None
) -> tuple[Method, Estimate | None]:
    """The method with the size of images decided, and what its fit will need; None if that is next to none.

    The largest images whose fit takes at most `limit` seconds, or what the preset promises. Images of at most
    WHOLE pixels are not downscaled, nor is a size changed that the method gives. On a busy machine the same
    is decided: a step takes as long as `cost_model` has it. `tell` is called with what was chosen. Raises
    InputError as `read_dataset` does.
    """
    promise = PRESETS[method.preset].minutes if method.preset in PRESETS else None
    limit = 60 * promise if limit is None and promise is not None else limit
    whole = replace(method, data=replace(method.data, downscale=1))
    data = read_views(whole, path, "train", truth=False, decode=False)
    first = data.views[0]
    width, height = first.width, first.height
    given = method.data.downscale is not None
    if not given and limit is None:
        method = sized(method, path, tell)
    factor = method.data.downscale or 1
    method = replace(method, data=replace(method.data, downscale=factor))
    if method.iterations * width * height < WORTH:
        return method, None
    has_alpha = data.has_alpha
    speed = speed_of(method, has_alpha)

    def at(factor: int) -> Estimate:
        return estimate(method, speed, len(data.views), (width, height), factor, has_alpha)

    if given or limit is None:
        return method, at(factor)
    while (
        width * height > WHOLE
        and at(factor).seconds > SAFETY * limit
        and min(width, height) // (factor + 1) >= LEAST
    ):
        factor += 1
    chosen = at(factor)
    if factor > 1:
        tell(
            f"{path}: images of {width} × {height} pixels are read as {chosen.width} × {chosen.height}, so "
            f"that the fit takes {minutes(limit)} at most; --set data.downscale=1 reads them whole "
            f"({minutes(at(1).seconds)}), --minutes M gives it other time"
        )
    if chosen.seconds > limit:
        tell(
            f"{path}: the fit takes {minutes(chosen.seconds)}, more than {minutes(limit)}; "
            f"--set data.downscale={factor + 1} reads smaller images"
        )
    return replace(method, data=replace(method.data, downscale=factor)), chosen


def estimate(
    method: Method, speed: Speed, views: int, size: tuple[int, int], factor: int, has_alpha: bool = True
) -> Estimate:
    """What a fit to so many pictures of `size` (width, height), read `factor` times smaller, will need.

    `has_alpha`: whether they have alpha.
    """
    width, height = size[0] // factor, size[1] // factor
    pixels, begin, steps = width * height, 0, 0.0
    for name, stage in method.stages():
        for block, share in _blocks(method, begin, min(stage.until, method.iterations)):
            steps += share * speed.step(name, pixels // block**2)
        begin = stage.until
    meshes = 0 if method.mesh is None else method.mesh.extract.count(method.iterations)
    files = views * size[0] * size[1] * DECODING
    steps *= GROWTH if has_alpha else OPEN_GROWTH
    seconds = START + files + steps + meshes * (speed.mesh + views * speed.mesh_view)
    return Estimate(seconds, bytes_of(method, views, pixels), width, height)


def _blocks(method: Method, begin: int, end: int) -> list[tuple[int, int]]:
    """Sides of what counts as a pixel in the iterations after `begin` to `end`, and how many have each."""
    ends = sorted({end, *(coarse.until for coarse in method.data.coarse if begin < coarse.until < end)})
    return [
        (method.data.block_at(last), last - first)
        for first, last in zip([begin, *ends], ends, strict=False)
        if last > first
    ]
