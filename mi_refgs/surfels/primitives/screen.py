"""What the footprints of all primitives have in common on the screen."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import ALPHA_MIN


def reach(opacity: Any) -> Any:
    """r² = 2 ln(o/α_min): the ρ at which α falls to ALPHA_MIN."""
    return 2 * dr.log(dr.maximum(opacity, ALPHA_MIN) / ALPHA_MIN)


def rectangle(
    centre: Any, low: Any, high: Any, visible: Any, camera: Any
) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """First and last pixel column and row (mi.Int32) from `low` to `high` (mi.Vector2f, pixels) of a centre.

    The last is below the first where nothing is covered, as where it is not `visible`. `camera` is a
    `splat.camera.Camera`.
    """
    first, last = [], []
    for axis, size in enumerate((camera.width, camera.height)):
        # Clamped as floats first: a rectangle far outside must not overflow an integer.
        begin = dr.ceil(dr.clip(centre[axis] + low[axis], -1, size + 1) - 0.5)
        end = dr.floor(dr.clip(centre[axis] + high[axis], -1, size + 1) - 0.5)
        first.append(dr.select(visible, mi.Int32(dr.maximum(begin, 0)), 1))
        last.append(dr.select(visible, mi.Int32(dr.minimum(end, size - 1)), 0))
    return (first[0], first[1]), (last[0], last[1])


def linear(x: Any, y: Any, delta: Any) -> Any:
    """The linear form (x, y) · δ."""
    return dr.fma(x, delta.x, y * delta.y)
