"""Choice of a libLLVM that Dr.Jit can use, before Dr.Jit loads one by itself.

LLVM 15 and 16 abort the process at the first kernel that takes a minimum. Only the standard library is
imported at the top: the set-up script runs `python -P mi_refgs/llvm.py` before anything is installed."""

import ctypes
import os
import platform
import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

MINIMUM_MAJOR = 17  # oldest with llvm.minimum on x86-64 (llvm-project issues 53353, 67301)

ENVIRONMENT_VARIABLE = "DRJIT_LIBLLVM_PATH"
_SUDO = "sudo " if sys.platform == "linux" and os.geteuid() != 0 else ""
REMEDY = "brew install llvm" if sys.platform == "darwin" else f"{_SUDO}apt-get install libllvm19"
FOLDERS = (
    f"usr/lib/{platform.machine()}-linux-gnu",  # Debian; other *-linux-gnu are foreign architectures
    "usr/lib64",
    "usr/lib64/llvm*/lib64",  # Fedora's older releases beside the newest
    "usr/lib",
    "usr/lib/llvm-*/lib",
    "usr/local/lib",
    "opt/homebrew/opt/llvm*/lib",
    "usr/local/opt/llvm*/lib",
)


class Problem(NamedTuple):
    """Reason why the LLVM of this process cannot be used, and the remedy."""

    what: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.what}: {self.remedy}"


def named_version(path: Path) -> tuple[int, ...] | None:
    """Return the version in a library's name, such as (19, 1) for `libLLVM.so.19.1`, or in its folder's."""
    for candidate in (Path(os.path.realpath(path)), path):
        match = re.match(r"libLLVM(?:-|\.so\.|\.)(\d+(?:\.\d+)*)", candidate.name)
        match = match or re.search(r"/llvm(?:[-@/]|)(\d+(?:\.\d+)*)/", str(candidate))  # Homebrew
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


def _usable(version: tuple[int, ...] | None) -> bool:
    return version is not None and version[0] >= MINIMUM_MAJOR


def find_library(folders: Iterable[Path] | None = None) -> Path | None:
    """Return the newest loadable libLLVM ≥ `MINIMUM_MAJOR` in `folders` (default: the system's), or None."""
    if folders is None:
        prefixes = [Path(p) for p in (os.environ.get("CONDA_PREFIX"), sys.prefix) if p]
        folders = [*(folder for pattern in FOLDERS for folder in Path("/").glob(pattern))]
        folders += [prefix / "lib" for prefix in prefixes]
    names = "libLLVM*.so*", "libLLVM*.dylib"
    found = [path for folder in folders for name in names for path in folder.glob(name)]
    versions = {Path(os.path.realpath(path)): named_version(path) for path in found}
    candidates = {path: version for path, version in versions.items() if version and _usable(version)}
    newest_first = sorted(candidates, key=lambda path: candidates[path], reverse=True)
    return next((path for path in newest_first if _usable(loaded_version(path))), None)


def select() -> None:
    """Set DRJIT_LIBLLVM_PATH, unless the user set it or Dr.Jit is already loaded."""
    if "drjit" not in sys.modules and not os.environ.get(ENVIRONMENT_VARIABLE) and (found := find_library()):
        os.environ[ENVIRONMENT_VARIABLE] = str(found)


def problem() -> Problem | None:
    """Return the problem of the LLVM that Dr.Jit loaded, or None. Imports Dr.Jit, runs no kernel."""
    try:
        import drjit as dr
    except NameError as error:  # Dr.Jit 1.5 trips over its own message when a system library is missing
        remedy = f"run `{_SUDO}apt-get install libatomic1`"
        raise ImportError(f"Dr.Jit cannot be loaded ({error.__context__}): {remedy}") from error
    version = dr.detail.llvm_version() if dr.has_backend(dr.JitBackend.LLVM) else None
    return None if _usable(version) else diagnose(version, os.environ.get(ENVIRONMENT_VARIABLE))


def diagnose(version: tuple[int, ...] | None, chosen: str | None) -> Problem:
    """Describe an unusable LLVM of `version` (None: not loaded) in the file `chosen` by the user, if any."""
    usable, needed = find_library(), f"LLVM {MINIMUM_MAJOR} or newer is needed"
    if chosen:
        version = version or named_version(Path(chosen))
        if version is not None and not _usable(version):
            what = f"is LLVM {version[0]}"
        else:
            absent = os.sep in chosen and not Path(chosen).exists()
            what = "does not exist" if absent else "cannot be loaded"
        remedy = f"unset {ENVIRONMENT_VARIABLE}" if usable else f"{REMEDY} && unset {ENVIRONMENT_VARIABLE}"
        return Problem(f"{ENVIRONMENT_VARIABLE}={chosen} {what}, but {needed}", remedy)
    loaded = "found no usable libLLVM" if version is None else f"loaded LLVM {version[0]}"
    first = f"import mi_refgs before mitsuba and drjit, or set {ENVIRONMENT_VARIABLE}={usable}"
    return Problem(f"Dr.Jit {loaded}, but {needed}", first if usable else REMEDY)


if __name__ == "__main__":
    _chosen = os.environ.get(ENVIRONMENT_VARIABLE)
    _library = Path(_chosen) if _chosen else find_library()
    _version = loaded_version(_library) if _library else None
    print(_library if _usable(_version) else diagnose(_version, _chosen))
    sys.exit(not _usable(_version))
