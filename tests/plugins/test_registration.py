"""Plugins follow Mitsuba from variant to variant; each case is a fresh process: import order counts."""

from pathlib import Path

import pytest

from tests.helpers import run_process, slow

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

OTHER = """
import mitsuba as mi
assert mi.variant() is not None, "as some packages, it is imported under a variant"

class Other(mi.SamplingIntegrator):
    def __init__(self, props):
        super().__init__(props)
        self.rows = props["rows"].shape[0]
    def to_string(self):
        return f"{self.rows} rows"

mi.register_integrator("other", Other)
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
    importlib.reload(sys.modules["other"]) if "other" in sys.modules else __import__("other")
    if variant == "llvm_ad_rgb":  # the tensor has as many rows as a vector: nanobind must not print attempts
        assert repr(mi.load_dict({{"type": "other", "rows": mi.TensorXf([0] * 6, (3, 2))}})) == "3 rows"
    try:
        print(repr(mi.load_dict({{"type": "refgs"}})))
    except RuntimeError as error:
        print(str(error).strip().splitlines()[-1])
"""

FIRST, AFTER = (
    "import mi_refgs, mitsuba as mi",
    "import mitsuba as mi; mi.set_variant('llvm_ad_mono'); import other, mi_refgs",
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
def test_switches_register_again(order: str, autoload: bool, variants: list[str], tmp_path: Path) -> None:
    """Beside Mitsuba's own callback or without; registering twice is harmless, and so is another package."""
    (tmp_path / "stand_in.py").write_text(STAND_IN)
    (tmp_path / "other.py").write_text(OTHER)
    callback = "mi.detail.add_variant_callback(autoload)" if autoload else ""
    code = CODE.format(order=order, callback=callback, variants=variants)
    done = run_process("-W", "error", "-c", code, folder=tmp_path)
    assert done.returncode == 0 and not done.stderr, done.stderr
    for variant, line in zip(variants, done.stdout.strip().splitlines(), strict=True):
        made = f"substitute under {variant}"
        assert line == made if variant == RGB else f"'{variant}' is not supported" in line
