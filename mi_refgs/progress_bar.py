"""A progress bar on standard error."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

Item = TypeVar("Item")

TERMINAL_INTERVAL, LOG_INTERVAL = 0.5, 30.0
"""Seconds between refreshes, in a terminal and in a file."""


def progress_bar(total: int, what: str, **options: Any) -> Any:
    """A bar of so many steps, to be updated and closed; `options` are tqdm's."""
    from tqdm import tqdm

    interval = TERMINAL_INTERVAL if sys.stderr.isatty() else LOG_INTERVAL
    return tqdm(total=total, desc=what, file=sys.stderr, dynamic_ncols=True, mininterval=interval, **options)


def with_bar(items: Sequence[Item], what: str, **options: Any) -> Iterator[Item]:
    """The items of a loop, below a bar that counts them."""
    with progress_bar(len(items), what, **options) as shown:
        for item in items:
            yield item
            shown.update()
