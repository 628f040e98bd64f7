"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import uuid
from collections.abc import Callable
from pathlib import Path

from mi_refgs.errors import InputError


def replace_file(path: str | Path, write: Callable[[Path], object]) -> None:
    """Let `write(temporary)` make a file beside `path`, then move it there: readers see the old or the new.

    The temporary name has the suffix of `path`. A killed process may leave one behind, hidden by its dot.
    Raises InputError if the folder is missing or the file cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.tmp{path.suffix}")
    try:
        write(temporary)
        os.replace(temporary, path)
    except (OSError, RuntimeError) as error:  # RuntimeError: what the EXR library and Mitsuba raise
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: output: cannot be written ({reason}); choose a writable folder") from error
    finally:
        with contextlib.suppress(OSError):  # moved away, never made, or below a file that is no folder
            temporary.unlink()


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file, whole or not at all; raises InputError as `replace_file` does."""
    replace_file(path, lambda temporary: temporary.write_bytes(data))
