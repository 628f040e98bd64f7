"""Kernels of the tests are compiled without LLVM's optimisations, which take most of the time of the tests.

Import before Dr.Jit. With REFGS_TESTS_OPTIMISED=1, LLVM compiles as it does for users."""

import ctypes
import os
from pathlib import Path

OPTIMISED = bool(os.environ.get("REFGS_TESTS_OPTIMISED"))
OPTIONS = (b"-force-attribute=noinline", b"-force-attribute=optnone", b"-optimize-regalloc=0")
"""Of LLVM: as clang's -O0. It ignores those that it does not know."""

if not OPTIMISED:  # users' commands must not find such kernels in their cache
    folder = Path(os.environ.get("DRJIT_CACHE_DIR") or Path.home() / ".drjit") / "simple"
    folder.mkdir(parents=True, exist_ok=True)
    os.environ["DRJIT_CACHE_DIR"] = str(folder)


def set_options() -> None:
    """Of the libLLVM that mi_refgs has chosen, for this process."""
    library = os.environ.get("DRJIT_LIBLLVM_PATH")
    if library and not OPTIMISED:
        arguments = (b"", *OPTIONS)
        array = (ctypes.c_char_p * len(arguments))(*arguments)
        ctypes.CDLL(library).LLVMParseCommandLineOptions(len(arguments), array, None)
