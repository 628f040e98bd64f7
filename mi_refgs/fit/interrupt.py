"""Ctrl-C between two steps of a fit, never inside one."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType


@contextlib.contextmanager
def held_interrupts() -> Iterator[Callable[[], bool]]:
    """Hold back the first Ctrl-C and yield a function that says whether there was one; a second one is not
    held.

    A state that is saved in the middle of a step (parameters moved, refinement or the mesh still due) could
    not be resumed to the same result. Outside the main thread, where Python delivers no signals, nothing is
    held.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    pending = False

    def hold(number: int, frame: FrameType | None) -> None:
        nonlocal pending
        if pending:
            raise KeyboardInterrupt
        pending = True

    before = signal.signal(signal.SIGINT, hold)
    try:
        yield lambda: pending
    finally:
        signal.signal(signal.SIGINT, before)
