"""The look for values that cannot be used: NaN, infinite, or too large to square.

No Mitsuba class is defined here, so that this module need not be reloaded when the variant changes.
"""

from __future__ import annotations

import math
import time
import warnings

from mi_refgs.constants import RAW_LIMIT
from mi_refgs.shade.envmap import EnvironmentLight
from mi_refgs.surfels.table import Surfels

CHECK_SECONDS = 1.0
"""Least time between two looks for values that cannot be used: each waits for the device."""


class UnusableValues:
    """Warns, once, of surfels that are left out and of texels that are black: at first, and after changes."""

    def __init__(self, surfels: Surfels, light: EnvironmentLight | None) -> None:
        self.changed = False  # since the last look
        self._next = -math.inf  # seconds of the monotonic clock
        self._look(surfels, light)

    def look(self, surfels: Surfels, light: EnvironmentLight | None) -> None:
        """Look again if something changed, and the last such look is CHECK_SECONDS ago."""
        now = time.monotonic()
        if self.changed and now >= self._next:
            self.changed, self._next = False, now + CHECK_SECONDS
            self._look(surfels, light)

    def _look(self, surfels: Surfels, light: EnvironmentLight | None) -> None:
        unusable = surfels.unusable()
        found = [f"{len(rows)} surfels in {name} (first: {rows[0]})" for name, rows in unusable.items()]
        black = light.unusable() if light is not None else 0
        found += [f"{black} values of light"] if black else []
        if found:
            self._next = math.inf
            warnings.warn(
                f"refgs: values are NaN, infinite or beyond {RAW_LIMIT:g}: {', '.join(found)}; these surfels "
                "are left out, and such light is black",
                RuntimeWarning,
                stacklevel=3,
            )
