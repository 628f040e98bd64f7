"""Reflective Gaussian Splatting on Mitsuba 3.

`import mi_refgs` chooses a usable LLVM for Dr.Jit (`mi_refgs.llvm`) and registers the Mitsuba plugins
(`mi_refgs.plugins`): at once if a variant is set, and after every switch. It may come before or after
`mi.set_variant`, and should come before `import mitsuba`, so that it can still choose the LLVM. The public
names are those of `mi_refgs.public`, which is imported on first use, so that the import is quick.

Without a usable LLVM and without a CUDA device, the import warns (RuntimeWarning) and names the remedy.
`mi.set_variant` to an LLVM variant then raises ImportError; if one is set already, the import does.
"""

from __future__ import annotations

import importlib.util
import warnings
from typing import TYPE_CHECKING, Any

from mi_refgs import llvm

if TYPE_CHECKING:
    from mi_refgs.public import *  # noqa: F403

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Import a module of the package, or all public names, at the first use of one. [PEP 562]"""
    if name.startswith("_") and name != "__all__":
        raise AttributeError(name)
    if importlib.util.find_spec(f"{__name__}.{name}"):
        return importlib.import_module(f"{__name__}.{name}")
    found = vars(importlib.import_module(f"{__name__}.public"))
    found = {key: value for key, value in found.items() if not key.startswith("_")}
    globals().update(found, __all__=[*found])
    if name not in globals():
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return globals()[name]


def __dir__() -> list[str]:
    return [*globals(), *__getattr__("__all__")]


llvm.select()
_llvm_problem = llvm.problem()

import drjit as dr  # noqa: E402  (only now is the library named that this loads)
import mitsuba as mi  # noqa: E402

from mi_refgs import plugins  # noqa: E402

# A warning, not an error: `refgs doctor` must start, and it too begins with this import.
if _llvm_problem and not dr.has_backend(dr.JitBackend.CUDA):
    warnings.warn(str(_llvm_problem), RuntimeWarning, stacklevel=2)


def _on_variant(old: str | None, new: str) -> None:
    """Refuse an LLVM variant that would abort the process at its first kernel, else register the plugins."""
    if _llvm_problem and new.startswith("llvm"):
        raise ImportError(str(_llvm_problem))
    plugins.load()


mi.detail.add_variant_callback(_on_variant)
if (_variant := mi.variant()) is not None:
    _on_variant(None, _variant)
