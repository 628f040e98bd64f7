"""Ctrl-C and SIGTERM between two steps of a fit, never inside one."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType


class TerminatedError(KeyboardInterrupt):
    """SIGTERM, as `kill` and batch systems send it; ends what Ctrl-C ends."""


@contextlib.contextmanager
def held_interrupts() -> Iterator[Callable[[], None]]:
    """Delay the first Ctrl-C or SIGTERM, which the main thread alone gets, to the end of a step, and yield a
    function that raises it; neither a second one, nor one that is ignored or handled outside Python."""
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    pending: list[KeyboardInterrupt] = []

    def release() -> None:
        if pending:
            raise pending[0]

    def hold(number: int, frame: FrameType | None) -> None:
        release()
        pending.append(TerminatedError() if number == signal.SIGTERM else KeyboardInterrupt())

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    before = {number: handler for number, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    for number in before:
        signal.signal(number, hold)
    try:
        yield release
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
