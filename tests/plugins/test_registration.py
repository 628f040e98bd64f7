"""Plugins follow Mitsuba from variant to variant; each case is a fresh process: import order counts."""

from __future__ import annotations

from pathlib import Path

from tests.helpers import run_python

STAND_IN = """
import mitsuba as mi
from mi_refgs.kernels.device import require_supported_variant

class RefGSIntegrator(mi.SamplingIntegrator):
    def __init__(self, props):
        require_supported_variant("refgs")
        super().__init__(props)
    def to_string(self):
        return f"substitute under {mi.variant()}"

mi.register_integrator("refgs", RefGSIntegrator)
"""

PRELUDE = """
import sys
{order}
from mi_refgs import plugins
plugins.PLUGINS["refgs"] = ("register_integrator", "stand_in")

def make():
    try:
        return repr(mi.load_dict({{"type": "refgs"}}))
    except RuntimeError as error:
        return str(error).strip().splitlines()[-1]
"""


def run(code: str, folder: Path, order: str = "import mi_refgs, mitsuba as mi") -> list[str]:
    """Lines that `code` prints after the plugin's module was replaced by another one, in a fresh process."""
    (folder / "stand_in.py").write_text(STAND_IN)
    return run_python(PRELUDE.format(order=order) + code, folder=folder).splitlines()


def test_every_switch_registers_again(tmp_path: Path) -> None:
    """Not before a supported variant; twice is harmless; each supported variant has its own class."""
    code = """
mi.set_variant("scalar_rgb")
print("stand_in" in sys.modules)
for variant in ["llvm_ad_rgb", "scalar_rgb", "llvm_ad_spectral", "llvm_ad_rgb"]:
    mi.set_variant(variant)
    print(make())
plugins.load()
plugins.load()
print(make())
from mi_refgs.kernels import device
device.is_supported = plugins.is_supported = lambda variant: "_ad_" in variant
for variant in ["llvm_ad_mono", "llvm_ad_rgb"]:
    mi.set_variant(variant)
    print(make(), isinstance(mi.load_dict({"type": "refgs"}), mi.SamplingIntegrator))
"""
    before, first, scalar, spectral, again, twice, *own = run(code, tmp_path)
    assert before == "False"
    assert first == again == twice == "substitute under llvm_ad_rgb"
    assert "'scalar_rgb' is not supported; call mi.set_variant('llvm_ad_rgb')" in scalar
    assert "'llvm_ad_spectral' is not supported" in spectral
    assert own == ["substitute under llvm_ad_mono True", "substitute under llvm_ad_rgb True"]


def test_import_after_the_variant_registers_at_once(tmp_path: Path) -> None:
    order = "import mitsuba as mi\nmi.set_variant('llvm_ad_mono')\nimport mi_refgs"
    code = "print(make())\nmi.set_variant('llvm_ad_rgb')\nprint(make())"
    mono, rgb = run(code, tmp_path, order)
    assert "'llvm_ad_mono' is not supported" in mono
    assert rgb == "substitute under llvm_ad_rgb"


def test_loads_beside_entry_point_of_mitsuba(tmp_path: Path) -> None:
    """Mitsuba 3.10 imports the entry point under the first variant, even scalar, and then reloads it."""
    code = """
import importlib
modules = []
def autoload(old, new):
    if modules:
        importlib.reload(modules[0])
    else:
        modules.append(importlib.import_module("stand_in"))
mi.detail.add_variant_callback(autoload)
for variant in ["scalar_rgb", "llvm_ad_rgb", "scalar_rgb", "llvm_ad_spectral", "llvm_ad_rgb"]:
    mi.set_variant(variant)
    print(make())
"""
    lines = run(code, tmp_path)
    assert lines[1] == lines[4] == "substitute under llvm_ad_rgb"
    for line in (lines[0], lines[2], lines[3]):
        assert "is not supported" in line


def test_real_plugins_are_found_under_their_names(tmp_path: Path) -> None:
    """After each switch, Mitsuba finds them; an unsupported variant is named."""
    code = """
import importlib, sys
import mitsuba as mi
mi.set_variant("scalar_rgb")
modules = {"refgs": "mi_refgs.plugins.integrator", "refgs_bsdf": "mi_refgs.plugins.bsdf"}
for module in modules.values():
    importlib.import_module(module)
for variant in ["llvm_ad_rgb", "scalar_rgb", "llvm_ad_spectral", "llvm_ad_rgb"]:
    mi.set_variant(variant)
    for plugin, module in modules.items():
        importlib.reload(sys.modules[module])
        try:
            mi.load_dict({"type": plugin})
            print("known")
        except RuntimeError as error:
            assert "not found" not in str(error), error
            print("refused" if f"{plugin}: variant: '{variant}' is not supported" in str(error) else "known")
"""
    lines = run_python(code, folder=tmp_path).split()
    assert lines == [*["known"] * 2, *["refused"] * 4, *["known"] * 2]
