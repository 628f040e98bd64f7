"""Reflective Gaussian Splatting on Mitsuba 3.

`import mi_refgs` chooses a usable LLVM for Dr.Jit (`mi_refgs.llvm`) and registers the Mitsuba plugins
(`mi_refgs.plugins`): at once if a variant is set, and after every switch. It may come before or after
`mi.set_variant`, and should come before `import mitsuba`, so that it can still choose the LLVM. The public
names are those of `__init__.pyi`; their modules are imported on first use, so that the import is quick.

Without a usable LLVM and without a CUDA device, the import warns (RuntimeWarning) and names the remedy.
`mi.set_variant` to an LLVM variant then raises ImportError; if one is set already, the import does.
"""

from __future__ import annotations

import ast
import importlib
import warnings
from pathlib import Path
from typing import Any

from mi_refgs import llvm

__version__ = "0.1.0"

PUBLIC: dict[str, tuple[str, str]] = {}
"""Public name → the module that defines it, and its name there, from `__init__.pyi`."""

for _node in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body:
    if isinstance(_node, ast.ImportFrom):  # from MODULE import NAME as NAME
        PUBLIC |= {alias.name: (str(_node.module), alias.name) for alias in _node.names}
    elif isinstance(_node, ast.Assign):  # NAME = MODULE.INNER
        _module, _, _inner = ast.unparse(_node.value).rpartition(".")
        PUBLIC[ast.unparse(_node.targets[0])] = (_module, _inner)

__all__ = sorted(PUBLIC)


def __dir__() -> list[str]:
    return [*globals(), *__all__]


def __getattr__(name: str) -> Any:
    """Import a public name on first use. [PEP 562]"""
    if name not in PUBLIC:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    module, inner = PUBLIC[name]
    value = globals()[name] = getattr(importlib.import_module(module), inner)
    return value


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
