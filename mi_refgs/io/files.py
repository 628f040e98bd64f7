"""Files of the package, atomic writes, locks, names from untrusted files, JSON, and size checks."""

import contextlib
import errno
import fcntl
import json
import os
import re
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

from mi_refgs.errors import InputError

TEMPORARY = re.compile(r"\..+\.[0-9a-f]{12}\.tmp(\.[^.]*)?")  # names of the temporary files of `replace_file`
ANY_FILE = 2**24  # bytes of pixels that a header of any file may promise
MAX_EXPANSION = 1100  # bytes of pixels per byte of a larger file: DEFLATE expands by at most 1,032
MAX_PIXELS = 2**28  # largest number of pixels of an image file: twice those of a 16K panorama
LFS = b"version https://git-lfs"  # first bytes of what Git leaves in place of a file that was not fetched
POLL = 0.1  # seconds between two tries to take a lock
_OWN = threading.local()  # `held`: paths of the locks of this thread
NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


def cannot_write(path: Path, error: Exception) -> InputError:
    """The InputError for a `path` that cannot be written, with a remedy that fits the error."""
    reason = getattr(error, "strerror", None) or error
    full = getattr(error, "errno", None) in NO_ROOM
    remedy = "free some space there, or choose another folder" if full else "choose a writable folder"
    return InputError(f"cannot be written ({reason})", path, "output", remedy)


def make_folder(path: Path) -> None:
    """Make a folder and its parents; raises InputError if that fails."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        what, remedy = f"cannot be created ({error.strerror})", "choose a writable folder with -o"
        raise InputError(what, path, "output", remedy) from error


def replace_file(path: str | Path, write: Callable[[Path], object]) -> None:
    """Write a file atomically, also if power fails: `write(temporary)` makes a file beside `path`, whose
    folder is made, and which is then moved there. Raises InputError if that fails."""
    path = Path(path)
    make_folder(path.parent)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.tmp{path.suffix}")
    try:
        write(temporary)
        with temporary.open("r+b") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except (OSError, RuntimeError) as error:  # RuntimeError: what the EXR library and Mitsuba raise
        raise cannot_write(path, error) from error
    finally:
        with contextlib.suppress(OSError):  # moved away, never made, or below a file that is no folder
            temporary.unlink()


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file as `replace_file` does."""
    replace_file(path, lambda temporary: temporary.write_bytes(data))


def write_json(path: str | Path, content: Any, indent: int = 1) -> None:
    """Write a JSON file as `replace_file` does."""
    write_bytes(path, f"{json.dumps(content, indent=indent)}\n".encode())


class BusyError(InputError):
    """Another process or thread has locked the file."""


@contextlib.contextmanager
def locked(path: Path, busy: str, wait: float = 0.0) -> Iterator[None]:
    """Lock the file at `path`, re-entrant per thread, if its file system has locks; the system releases it
    however this process ends. Raises BusyError(`busy`) if it stays locked for `wait` seconds."""
    key = path.parent.resolve() / path.name
    held: set[Path] = _OWN.__dict__.setdefault("held", set())
    if key in held:
        yield
        return
    new = not path.parent.exists()
    make_folder(path.parent)
    until = time.monotonic() + wait
    while (file := _lock_of(path)) is None:
        if time.monotonic() >= until:
            raise BusyError(busy)
        time.sleep(POLL)
    held.add(key)
    try:
        yield
    finally:
        held.remove(key)
        with contextlib.suppress(OSError):  # still locked: nobody else can lock this file
            if not path.stat().st_size:  # a file with content is not ours
                path.unlink()
            if new:
                path.parent.rmdir()  # where nothing was written; fails otherwise
        file.close()


def _lock_of(path: Path) -> IO[str] | None:
    """The locked file; None if it is locked elsewhere."""
    while True:
        try:
            file = path.open("a")
        except OSError as error:
            raise cannot_write(path, error) from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        except BlockingIOError:
            file.close()
            return None
        except FileNotFoundError:  # removed by the other process since it was opened
            pass
        except OSError:  # no locks on this file system
            return file
        file.close()


def resource_dir(name: str) -> Path:
    """Folder "variants" or "scenes": inside an installed package, or beside that of a checkout."""
    package = Path(__file__).resolve().parents[1]
    checkout = [package.parent] if (package.parent / "pyproject.toml").is_file() else []
    for parent in (package, *checkout):
        if (parent / name).is_dir():
            return parent / name
    raise InputError("the folder is missing from this installation", package, name, "install mi_refgs again")


def is_file(path: Path) -> bool:
    """Whether a file exists; False for an impossible name."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def inside(folder: Path, name: object) -> Path | None:
    """The path of a relative name in a folder; None if it leads out of the folder or is no name."""
    parts = os.path.normpath(name) if isinstance(name, str) else os.pardir
    if os.path.isabs(parts) or parts.split(os.sep)[0] in (os.pardir, os.curdir):
        return None
    return folder / parts


def read_any_json(path: Path) -> Any:
    """The value in a JSON file; raises InputError for other files."""
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        what, remedy = f"cannot be read ({error})", "correct it or export it again"
        raise InputError(what, path, "JSON", remedy) from error


def read_json(path: str | Path) -> dict[str, Any]:
    """The object in a JSON file; raises InputError for anything else."""
    path = Path(path)
    content = read_any_json(path)
    if not isinstance(content, dict):
        raise InputError("the outermost value is not an object", path, "JSON", "export the file again")
    return content


def require_file(path: Path) -> None:
    """Raise InputError unless this is a file with its content."""
    if is_file(path):
        try:
            with path.open("rb") as file:
                pointer = file.read(len(LFS)) == LFS
        except OSError as error:
            raise InputError(f"cannot be read ({error.strerror})", path, "file", "check the path") from error
        if pointer:
            what = "a Git LFS pointer in place of the file"
            raise InputError(what, path, "file", "fetch it with `git lfs pull`")
        return
    if os.path.isdir(path):  # unlike Path.is_dir, False for an impossible name
        raise InputError("is a folder", path, "file", "name a file in it")
    raise InputError("missing", path, "file", "check the name, or restore it")


def check_size(path: Path, width: int, height: int, bytes_per_pixel: int) -> None:
    """Raise InputError for a size beyond MAX_PIXELS, and for one that no file of this length can contain."""
    what = f"{width} × {height} pixels are more than"
    if width * height > MAX_PIXELS:
        raise InputError(f"{what} {MAX_PIXELS // 10**6} million", path, "size", "save a smaller copy")
    if width * height * bytes_per_pixel > max(ANY_FILE, MAX_EXPANSION * path.stat().st_size):
        raise InputError(f"{what} the file can hold", path, "size", "export it again")
