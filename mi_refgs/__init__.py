"""Reflective Gaussian Splatting on Mitsuba 3.

`import mi_refgs` does two things: it makes sure that Dr.Jit runs on a usable LLVM (`mi_refgs.llvm`), and it
registers the Mitsuba plugins (`mi_refgs.plugins`), now if a variant is set and again after every switch. It
may stand before or after `mi.set_variant`; it should stand before `import mitsuba`, so that it can still
choose the LLVM.

Raises:
    ImportError: when neither a usable LLVM nor a CUDA device is there; the message says what to install.
"""

from __future__ import annotations

import sys
from pathlib import Path

from mi_refgs import llvm

__version__ = "0.1.0"

llvm.select()
_llvm_problem = llvm.problem()

import drjit as dr  # noqa: E402  (only now is the library named that this loads)
import mitsuba as mi  # noqa: E402

from mi_refgs import plugins  # noqa: E402

# The command must be able to start without LLVM, because `refgs doctor` says what is missing.
_is_command = Path((getattr(sys, "argv", None) or [""])[0]).stem == "refgs" or (
    sys.orig_argv[1:3] == ["-m", "mi_refgs"]
)

if _llvm_problem and not _is_command and not dr.has_backend(dr.JitBackend.CUDA):
    raise ImportError(str(_llvm_problem))


def _on_variant(old: str | None, new: str) -> None:
    """Refuse an LLVM variant that would abort the process at its first kernel, else register the plugins."""
    if _llvm_problem and new.startswith("llvm"):
        raise ImportError(str(_llvm_problem))
    plugins.load()


mi.detail.add_variant_callback(_on_variant)
if (_variant := mi.variant()) is not None:
    _on_variant(None, _variant)
