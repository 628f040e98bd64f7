"""The Mitsuba plugins, and how they follow Mitsuba from variant to variant.

Mitsuba has one set of base classes for each variant, so a plugin class must be defined anew after every
switch. A plugin therefore lives in a module of its own that defines the class and registers it, both at
module scope:

    class RefGSIntegrator(mi.SamplingIntegrator):
        def __init__(self, props):
            require_supported_variant("refgs")
            super().__init__(props)
            ...

    mi.register_integrator("refgs", RefGSIntegrator)

and that is imported, or reloaded, each time the variant changes: by `load` below, which `import mi_refgs`
connects to Mitsuba's variant callback, and from Mitsuba 3.10 on also by Mitsuba itself, through the entry
point in pyproject.toml. Being loaded twice is harmless: the second registration replaces the first. Such a
module must not be imported before a variant is set, and nothing else may import classes from it.
"""

from __future__ import annotations

import importlib
import sys

import mitsuba as mi

from mi_refgs.kernels.device import is_supported, require_supported_variant

PLUGINS = {
    "refgs": ("register_integrator", "mi_refgs.plugins.integrator"),
    "refgs_bsdf": ("register_bsdf", "mi_refgs.plugins.bsdf"),
}
"""For each plugin name, the Mitsuba function that registers it and the module that defines it."""


def load() -> None:
    """Define and register all plugins for the variant that is set.

    Under an unsupported variant each name is registered with a function that says so, instead of Mitsuba's
    `plugin not found`.
    """
    supported = is_supported(mi.variant())
    for plugin, (register, module) in PLUGINS.items():
        if not supported:
            getattr(mi, register)(plugin, lambda props, plugin=plugin: require_supported_variant(plugin))
        elif module in sys.modules:
            importlib.reload(sys.modules[module])
        else:
            importlib.import_module(module)
