"""Messages for people, on standard error: results alone go to standard output."""

from __future__ import annotations

import sys


def say(message: str) -> None:
    """Tell what is going on."""
    print(f"refgs: {message}", file=sys.stderr)


def warn(message: str) -> None:
    """Tell about something unusual, above a progress bar if one is shown."""
    from tqdm import tqdm

    tqdm.write(f"refgs: warning: {message}", file=sys.stderr)
