"""The public names: each is documented, and imported on first use."""

import inspect
from pathlib import Path

import pytest

import mi_refgs
from tests.helpers import run_python


@pytest.mark.parametrize("name", mi_refgs.__all__)
def test_public_name_is_documented(name: str) -> None:
    value = getattr(mi_refgs, name)
    assert name in dir(mi_refgs) and getattr(mi_refgs, name) is value
    text = inspect.getdoc(value) or ""
    assert len(text.split()) > 1 and not text.startswith(f"{name}(")  # that of a dataclass without one


def test_import_loads_no_heavy_module(tmp_path: Path) -> None:
    code = """
import sys, mi_refgs
before = {*sys.modules}
import mi_refgs.formats  # declarations of formats import no more
heavy = {"scipy", "skimage", "trimesh", "PIL", "matplotlib", "OpenEXR"} & {*sys.modules}
heavy |= {"numpy", "mitsuba"} & ({*sys.modules} - before)
assert not heavy and "mi_refgs.surfels.table" not in sys.modules, heavy
from mi_refgs import Surfels
assert Surfels is sys.modules["mi_refgs.surfels.table"].Surfels
"""
    run_python(code, folder=tmp_path)
