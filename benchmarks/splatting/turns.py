"""Times of calls that take very different time, in turns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from benchmarks.common.timing import once


def turns(calls: Mapping[str, tuple[Callable[[], Any], int]], seconds: float) -> dict[str, float]:
    """Median milliseconds of each call, its result evaluated and waited for; first calls are not counted.

    Each call comes with the most times that it is run. All run once in a round, until each has been run often
    enough; calls with the largest number stop after three rounds too, if they have taken `seconds` by then.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    most = max(number for _, number in calls.values())
    for call, _ in calls.values():
        once(call)
    for i in range(most):
        for name, (call, number) in calls.items():
            spent = sum(times[name])
            if i < number and (i < 3 or number < most or spent < seconds):
                times[name].append(once(call))
    return {name: 1e3 * float(np.median(found)) for name, found in times.items()}
