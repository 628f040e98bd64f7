"""The Mitsuba plugins, and how they follow Mitsuba from variant to variant.

Each variant has base classes of its own, so a plugin's module is imported or reloaded whenever it changes, by
`load` (and Mitsuba 3.10's entry point). Never import it before a variant is set, nor classes from it."""

import contextlib
import ctypes
import importlib
import sys
from pathlib import Path

import mitsuba as mi

from mi_refgs.kernels.device import is_supported, require_supported_variant

PLUGINS = {
    "refgs": ("register_integrator", "mi_refgs.plugins.integrator"),
    "refgs_bsdf": ("register_bsdf", "mi_refgs.plugins.bsdf"),
}
"""For each plugin name, the Mitsuba function that registers it and the module that defines it."""


def load() -> None:
    """Register all plugins for the variant that is set; under an unsupported one, functions that say so."""
    supported = is_supported(mi.variant())
    for plugin, (register, module) in PLUGINS.items():
        if not supported:
            getattr(mi, register)(plugin, lambda props, plugin=plugin: require_supported_variant(plugin))
        elif module in sys.modules:
            importlib.reload(sys.modules[module])
        else:
            importlib.import_module(module)


# Mitsuba tries each tensor of a dictionary as a vector and as colours; for one with three rows, nanobind
# prints a line for each failure. Only its C++ function can switch that off.
with contextlib.suppress(StopIteration, OSError, AttributeError):  # elsewhere, the lines stay
    library = ctypes.CDLL(str(next(Path(mi.__file__).parent.glob("libnanobind*"))))
    library._ZN8nanobind6detail26set_implicit_cast_warningsEb(False)
