"""Choice of a libLLVM that Dr.Jit can use, before Dr.Jit loads one by itself.

On import, Dr.Jit opens the file named by DRJIT_LIBLLVM_PATH, else `libLLVM.so`, else the highest version in
the system's library folder. LLVM 15 and 16 load, but abort the process with "LLVM ERROR" at the first kernel
that takes a minimum, because they cannot compile `llvm.minimum` on x86-64. Therefore `select` names the
newest usable library in DRJIT_LIBLLVM_PATH, and `problem` checks the library that Dr.Jit loaded.

Only the standard library is imported at the top: the set-up script runs `python -P mi_refgs/llvm.py`, which
prints the library or the problem and exits with 0 or 1, before anything is installed.
"""

from __future__ import annotations

import ctypes
import os
import platform
import re
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

MINIMUM_MAJOR = 17
"""Oldest LLVM whose x86-64 back end compiles llvm.minimum and maximum (llvm-project issues 53353, 67301)."""

ENVIRONMENT_VARIABLE = "DRJIT_LIBLLVM_PATH"

_SUDO = "sudo " if sys.platform == "linux" and os.geteuid() != 0 else ""

REMEDY = "brew install llvm" if sys.platform == "darwin" else f"{_SUDO}apt-get install libllvm19"
"""The one command that installs a usable library."""

_INSTALL_ATOMIC = f"{_SUDO}apt-get install libatomic1"


def search_folders() -> list[Path]:
    """Return folders that may contain a libLLVM for this machine's architecture, in no particular order."""
    patterns = [
        f"/usr/lib/{platform.machine()}-linux-gnu",  # Debian; other *-linux-gnu are foreign architectures
        "/usr/lib64",
        "/usr/lib64/llvm*/lib64",  # Fedora's older releases beside the newest
        "/usr/lib",
        "/usr/lib/llvm-*/lib",
        "/usr/local/lib",
        "/opt/homebrew/opt/llvm*/lib",
        "/usr/local/opt/llvm*/lib",
    ]
    found = [folder for pattern in patterns for folder in sorted(Path("/").glob(pattern.lstrip("/")))]
    prefixes = [os.environ.get("CONDA_PREFIX"), sys.prefix]
    return found + [Path(prefix) / "lib" for prefix in prefixes if prefix]


def named_version(path: Path) -> tuple[int, ...] | None:
    """Return the version in a library's file name, such as (19, 1) for `libLLVM.so.19.1`, or None.

    Symbolic links are resolved first; Homebrew states the version in the name of the folder.
    """
    resolved = Path(os.path.realpath(path))
    for candidate in (resolved, path):
        match = re.match(r"libLLVM(?:-|\.so\.|\.)(\d+(?:\.\d+)*)", candidate.name)
        if match is None:
            match = re.search(r"/llvm(?:[-@/]|)(\d+(?:\.\d+)*)/", str(candidate))
        if match is not None:
            return tuple(int(part) for part in match[1].split("."))
    return None


def loaded_version(path: Path) -> tuple[int, ...] | None:
    """Return the version that a library reports; None if it cannot be loaded or is older than 16."""
    try:
        get_version = ctypes.CDLL(str(path)).LLVMGetVersion
    except (OSError, AttributeError):
        return None
    parts = [ctypes.c_uint() for _ in range(3)]
    get_version(*(ctypes.byref(part) for part in parts))
    return tuple(part.value for part in parts)


def find_library(folders: Iterable[Path] | None = None) -> Path | None:
    """Return the newest loadable libLLVM ≥ `MINIMUM_MAJOR` in `folders` (default: the system's), or None."""
    candidates: dict[Path, tuple[int, ...]] = {}
    for folder in search_folders() if folders is None else folders:
        for path in [*folder.glob("libLLVM*.so*"), *folder.glob("libLLVM*.dylib")]:
            version = named_version(path)
            if version is not None and version[0] >= MINIMUM_MAJOR:
                candidates.setdefault(Path(os.path.realpath(path)), version)
    for path in sorted(candidates, key=lambda path: candidates[path], reverse=True):
        loaded = loaded_version(path)
        if loaded is not None and loaded[0] >= MINIMUM_MAJOR:
            return path
    return None


def select() -> None:
    """Set DRJIT_LIBLLVM_PATH, unless the user set it or Dr.Jit is already loaded."""
    if "drjit" in sys.modules or os.environ.get(ENVIRONMENT_VARIABLE):
        return
    library = find_library()
    if library is not None:
        os.environ[ENVIRONMENT_VARIABLE] = str(library)


@dataclass(frozen=True)
class Problem:
    """Reason why the LLVM of this process cannot be used, and the remedy."""

    what: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.what}: {self.remedy}"


def problem() -> Problem | None:
    """Return the problem of the LLVM that Dr.Jit loaded, or None. Imports Dr.Jit, runs no kernel.

    Raises ImportError if Dr.Jit cannot be loaded.
    """
    try:
        import drjit as dr
    except NameError as error:  # Dr.Jit 1.5 trips over its own message when a system library is missing
        raise ImportError(
            f"Dr.Jit cannot be loaded ({error.__context__}): run `{_INSTALL_ATOMIC}`"
        ) from error

    version = dr.detail.llvm_version() if dr.has_backend(dr.JitBackend.LLVM) else None
    if version is not None and version[0] >= MINIMUM_MAJOR:
        return None
    return diagnose(version, os.environ.get(ENVIRONMENT_VARIABLE))


def diagnose(version: tuple[int, ...] | None, chosen: str | None) -> Problem:
    """Describe an unusable LLVM of `version` (None: not loaded) in the file `chosen` by the user, if any."""
    usable = find_library()
    needed = f"LLVM {MINIMUM_MAJOR} or newer is needed"
    if chosen:
        version = version or named_version(Path(chosen))
        if version is not None and version[0] < MINIMUM_MAJOR:
            what = f"is LLVM {version[0]}"
        elif os.sep in chosen and not Path(chosen).exists():
            what = "does not exist"
        else:
            what = "cannot be loaded"
        unset = f"unset {ENVIRONMENT_VARIABLE}"
        return Problem(
            f"{ENVIRONMENT_VARIABLE}={chosen} {what}, but {needed}",
            unset if usable else f"{REMEDY} && {unset}",
        )
    loaded = "found no usable libLLVM" if version is None else f"loaded LLVM {version[0]}"
    what = f"Dr.Jit {loaded}, but {needed}"
    if usable is None:
        return Problem(what, REMEDY)
    return Problem(what, f"import mi_refgs before mitsuba and drjit, or set {ENVIRONMENT_VARIABLE}={usable}")


def _main() -> int:
    """Print the library or the problem; returns the exit code."""
    chosen = os.environ.get(ENVIRONMENT_VARIABLE)
    library = Path(chosen) if chosen else find_library()
    version = loaded_version(library) if library is not None else None
    usable = version is not None and version[0] >= MINIMUM_MAJOR
    print(library if usable else diagnose(version, chosen))
    return 0 if usable else 1


if __name__ == "__main__":
    sys.exit(_main())
