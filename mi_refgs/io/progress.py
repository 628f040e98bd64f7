"""Messages and progress bars on standard error: results alone go to standard output."""

import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

Item = TypeVar("Item")
Tell = Callable[[str], None]  # is called with sentences for the user
_NOTED: set[tuple[Path, str]] = set()


def say(message: str) -> None:
    """Print a message to the user."""
    print(f"refgs: {message}", file=sys.stderr)


def warn(message: str) -> None:
    """Print a warning to the user, above a progress bar if one is displayed."""
    from tqdm import tqdm

    tqdm.write(f"refgs: warning: {message}", file=sys.stderr)


def note(path: Path, what: str) -> None:
    """Warn of how a file is read, once for all files of its folder of which this is to be said."""
    if (path.parent, what) not in _NOTED:
        _NOTED.add((path.parent, what))
        warn(f"{path}: {what}")


def command_line(*words: object) -> str:
    """A `refgs` command as a shell reads it."""
    return shlex.join(["refgs", *map(str, words)])


def progress_bar(total: int, what: str, **options: Any) -> Any:
    """Return a bar of `total` steps, to be updated and closed; `options` are tqdm's."""
    from tqdm import tqdm

    interval = 0.5 if sys.stderr.isatty() else 30.0  # seconds between refreshes: in a terminal, in a file
    return tqdm(total=total, desc=what, file=sys.stderr, dynamic_ncols=True, mininterval=interval, **options)


def with_bar(items: Sequence[Item], what: str, **options: Any) -> Iterator[Item]:
    """Yield the items under a bar that counts them."""
    yield from progress_bar(len(items), what, iterable=items, **options)
