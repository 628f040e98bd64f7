"""Plugins follow Mitsuba from variant to variant; each case is a fresh process: import order counts."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers import run_python, slow

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

CODE = """
import importlib, sys
{order}
from mi_refgs import plugins
plugins.PLUGINS["refgs"] = ("register_integrator", "stand_in")

def autoload(old, new):  # as Mitsuba 3.10 does with entry points, even under a scalar variant
    importlib.reload(sys.modules["stand_in"]) if "stand_in" in sys.modules else __import__("stand_in")

{callback}
for variant in {variants}:
    mi.set_variant(variant)
    try:
        print(repr(mi.load_dict({{"type": "refgs"}})))
    except RuntimeError as error:
        print(str(error).strip().splitlines()[-1])
"""

FIRST, AFTER = (
    "import mi_refgs, mitsuba as mi",
    "import mitsuba as mi; mi.set_variant('llvm_ad_mono'); import mi_refgs",
)
RGB, SCALAR, SPECTRAL = "llvm_ad_rgb", "scalar_rgb", "llvm_ad_spectral"


@pytest.mark.parametrize(
    ("order", "autoload", "variants"),
    [
        (FIRST, True, [SCALAR, RGB, SCALAR, SPECTRAL, RGB]),
        slow(FIRST, False, [SCALAR, RGB, SCALAR, SPECTRAL, RGB]),
        slow(AFTER, False, [SPECTRAL, RGB]),
    ],
)
def test_every_switch_registers_again(
    order: str, autoload: bool, variants: list[str], tmp_path: Path
) -> None:
    """Beside Mitsuba's own callback or without; registering twice is harmless."""
    (tmp_path / "stand_in.py").write_text(STAND_IN)
    callback = "mi.detail.add_variant_callback(autoload)" if autoload else ""
    code = CODE.format(order=order, callback=callback, variants=variants)
    for variant, line in zip(variants, run_python(code, folder=tmp_path).splitlines(), strict=True):
        made = f"substitute under {variant}"
        assert line == made if variant == RGB else f"'{variant}' is not supported" in line
