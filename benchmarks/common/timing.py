"""Times of warm runs, taken in turns, and memory of a process."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import drjit as dr
import numpy as np

Key = TypeVar("Key", bound=Hashable)

MIN_ROUNDS = 5


def milliseconds(
    calls: Mapping[Key, Callable[[], Any]],
    seconds: float,
    most: int = 25,
    slow: Mapping[Key, tuple[Callable[[], Any], int]] | None = None,
) -> dict[Key, float]:
    """Median wall time of each call, its result evaluated and waited for; first calls are not counted.

    All calls run once in each round, so that a machine that slows down slows all of them: ratios of these
    times stay true. Rounds go on until `seconds` have passed for each call, at least five and at most `most`.
    `slow` calls run in the first rounds only, each as often as it says, and their time does not count."""
    slow = slow or {}
    for call in [*calls.values(), *(call for call, _ in slow.values())]:
        once(call)
    times: dict[Key, list[float]] = {key: [] for key in (*calls, *slow)}
    rounds, spent = 0, 0.0
    while rounds < min(MIN_ROUNDS, most) or (rounds < most and spent < seconds * len(calls)):
        for key, call in calls.items():
            times[key].append(once(call))
            spent += times[key][-1]
        for key, (call, number) in slow.items():
            if rounds < number:
                times[key].append(once(call))
        rounds += 1
    return {key: 1e3 * float(np.median(found)) for key, found in times.items()}


def once(call: Callable[[], Any]) -> float:
    """Seconds of one call, its result evaluated and waited for."""
    dr.sync_thread()
    begin = time.perf_counter()
    dr.eval(call())
    dr.sync_thread()
    return time.perf_counter() - begin


def peak_bytes() -> int:
    """Largest resident memory of this process since it began; requires Linux."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])
