"""How large a picture is drawn, and when: small while something moves, large once it is still, then smooth.

Every size that a page can ask for is one of a few, since a kernel is compiled for each: a rung of a ladder
whose areas double, in one of a few shapes. A window of another shape gets pixels that are not square.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

SIDES = (141, 200, 283, 400, 566, 800, 1131, 1600)
"""Rungs of the ladder: side in pixels of the square of the same area."""
COARSEST, FINEST = SIDES[0], SIDES[6]
"""The smallest picture, and the largest that is drawn unless the user asks for more: 1.28 million pixels."""
SHAPES = (0.625, 1.0, 1.6, 2.5)
"""Width over height of a picture. Between two of them pixels are oblong by up to 1.26."""
MULTIPLE = 4
"""Width and height are multiples of this, the smallest tile."""

STILL_AFTER = 0.15
"""Seconds without a change after which a picture is drawn large: more than the pauses of a slow hand."""
SMOOTH_AFTER = 0.4
"""Seconds without a change after which its pixels are averaged over samples."""
GRID = 4
"""The samples of a smooth picture are a GRID × GRID raster in each pixel, as `render.samples` has it."""
SAMPLES = GRID * GRID

SLOW, FAST = 1 / 22, 1 / 60
"""Seconds that a picture takes while something moves: above the first the next one is smaller, below the
second larger. An area of twice the size takes less than twice the time, so it does not swing between two."""

NOTHING, COARSE, LARGE = 0, 1, 2
"""What is shown: nothing of the present state, a small picture, a large one; then LARGE + samples."""
DONE = LARGE + SAMPLES
SHOWN_AT = frozenset({LARGE + SAMPLES // 4, DONE})
"""Sums of samples that are shown; each is a picture to encode and to send."""


def shape_of(width: int, height: int) -> float:
    """The one of SHAPES that is nearest to a window of so many pixels."""
    wanted = math.log(max(width, 1) / max(height, 1))
    return min(SHAPES, key=lambda shape: abs(math.log(shape) - wanted))


def size_of(side: int, shape: float) -> tuple[int, int]:
    """Width and height in pixels of a rung."""
    scale = math.sqrt(shape)
    width, height = (MULTIPLE * max(round(x / MULTIPLE), 1) for x in (side * scale, side / scale))
    return width, height


def still_side(width: int, height: int, largest: int = FINEST) -> int:
    """The rung for a window of so many pixels while nothing moves: the one of the nearest area."""
    area = max(width * height, 1)
    nearest = min(SIDES, key=lambda side: abs(math.log(side * side / area)))
    return min(nearest, largest)


def moving_side(side: int, seconds: float, largest: int) -> int:
    """The rung for the next picture while something moves, after one of `side` that took so long."""
    rung = SIDES.index(side)
    if seconds > SLOW:
        rung -= 1
    elif seconds < FAST:
        rung += 1
    return SIDES[min(max(rung, 0), SIDES.index(largest))]


def due(shown: int, since: float) -> float:
    """Seconds until the next picture is to be drawn, `since` seconds after the last change; inf for none."""
    if shown == NOTHING:
        return 0.0
    if shown >= DONE:
        return math.inf
    return max((STILL_AFTER if shown == COARSE else SMOOTH_AFTER) - since, 0.0)


def offsets() -> Sequence[tuple[float, float]]:
    """Places of the samples in a pixel, from its centre, in pixels; each four in turn lie in all quarters."""
    places = [((i + 0.5) / GRID - 0.5) for i in range(GRID)]
    half = GRID // 2
    quarter = [(x, y) for y in range(half) for x in range(half)]
    return [
        (places[x + half * right], places[y + half * down])
        for x, y in quarter
        for right, down in ((0, 0), (1, 1), (1, 0), (0, 1))
    ]
