"""The look for values that cannot be used: NaN, infinite, or too large to square.

No Mitsuba class is defined here, so that this module need not be reloaded when the variant changes.
"""

from __future__ import annotations

import math
import time
import warnings

from mi_refgs.constants import RAW_LIMIT
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.surfels.table import Surfels

CHECK_SECONDS = 1.0
"""Least time between two looks for values that cannot be used: each waits for the device."""


Values = tuple[dict[str, Surfels], dict[str, EnvironmentLight]]
"""Tables and lat-long maps by what the warning calls them."""


class UnusableValues:
    """Warns, once, of surfels that are left out and of texels that are black: at first, and after changes."""

    def __init__(self, values: Values) -> None:
        self.changed = False  # since the last look
        self._next = -math.inf  # seconds of the monotonic clock
        self._look(values)

    def look(self, values: Values) -> None:
        """Look again if something changed, and the last such look is CHECK_SECONDS ago."""
        now = time.monotonic()
        if self.changed and now >= self._next:
            self.changed, self._next = False, now + CHECK_SECONDS
            self._look(values)

    def _look(self, values: Values) -> None:
        tables, maps = values
        found = [
            f"{len(rows)} {kind} in {name} (first: {rows[0]})"
            for kind, table in tables.items()
            for name, rows in table.unusable().items()
        ]
        found += [f"{black} values of {name}" for name, light in maps.items() if (black := light.unusable())]
        if found:
            self._next = math.inf
            warnings.warn(
                f"refgs: values are NaN, infinite or beyond {RAW_LIMIT:g}: {', '.join(found)}; these surfels "
                "are left out, and such light is black",
                RuntimeWarning,
                stacklevel=3,
            )
