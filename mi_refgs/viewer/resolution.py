"""Sizes of displayed images, and when they are due: coarse during motion, fine at rest, then supersampled. A
kernel is compiled per size. So there are few: levels whose areas double, in a few aspect ratios."""

import math

SIDES = (141, 200, 283, 400, 566, 800, 1131, 1600)  # levels: of the square of the same area, pixels
COARSEST, FINEST = SIDES[0], SIDES[6]  # levels, unless the user chooses a finer one: 1.28 million pixels
SHAPES = (0.625, 1.0, 1.6, 2.5)  # width over height; between two of them pixels are oblong by up to 1.26
MULTIPLE = 4  # width and height are multiples of this, the smallest tile

STILL_AFTER, SMOOTH_AFTER = 0.15, 0.4  # seconds without a change until an image is drawn large, supersampled
GRID = 4
SAMPLES = GRID * GRID  # of a supersampled image: a raster of GRID × GRID per pixel, as in `render.samples`
SLOW, FAST = 1 / 22, 1 / 60  # seconds per image in motion from which the next is a level coarser, or finer

NOTHING, COARSE, LARGE = 0, 1, 2  # images of the present state: none, a coarse one, a large one of 1 sample
DONE = COARSE + SAMPLES
SHOWN_AT = frozenset({COARSE, LARGE, COARSE + SAMPLES // 4, DONE})  # when images are encoded and sent


def shape_of(width: int, height: int) -> float:
    """Return the one of SHAPES that is nearest to a window's aspect ratio."""
    wanted = math.log(max(width, 1) / max(height, 1))
    return min(SHAPES, key=lambda shape: abs(math.log(shape) - wanted))


def size_of(side: int, shape: float) -> tuple[int, int]:
    """Return width and height in pixels of a resolution level."""
    scale = math.sqrt(shape)
    width, height = (MULTIPLE * max(round(x / MULTIPLE), 1) for x in (side * scale, side / scale))
    return width, height


def still_side(width: int, height: int, largest: int = FINEST) -> int:
    """Return the level of the area nearest to a window's, for images at rest."""
    area = max(width * height, 1)
    return min(min(SIDES, key=lambda side: abs(math.log(side * side / area))), largest)


def moving_side(side: int, seconds: float, largest: int) -> int:
    """Return the level of the next image during motion, after one of level `side` that took so long."""
    level = SIDES.index(side) - (seconds > SLOW) + (seconds < FAST)
    return SIDES[min(max(level, 0), SIDES.index(largest))]


def due(progress: int, since: float) -> float:
    """Return the seconds until the next image is due, `since` seconds after the last change; inf for none."""
    if progress in (NOTHING, DONE):
        return 0.0 if progress == NOTHING else math.inf
    return max((STILL_AFTER if progress == COARSE else SMOOTH_AFTER) - since, 0.0)


def offset_of(sample: int) -> tuple[float, float]:
    """Return a sample's offset from the pixel centre, pixels; each four in turn lie in all quarters."""
    (row, column), quarter = divmod(sample // 4, GRID // 2), sample % 4
    x, y = column + GRID // 2 * (0, 1, 1, 0)[quarter], row + GRID // 2 * (0, 1, 0, 1)[quarter]
    return (x + 0.5) / GRID - 0.5, (y + 0.5) / GRID - 0.5
