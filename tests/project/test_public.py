"""The public names: they are there, they say what they are, and they cost nothing until they are used."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path

import pytest

import mi_refgs
from tests.helpers import run_python


@pytest.mark.parametrize("name", mi_refgs.__all__)
def test_a_public_name_is_documented(name: str) -> None:
    value = getattr(mi_refgs, name)
    assert name in dir(mi_refgs) and getattr(mi_refgs, name) is value
    text = inspect.getdoc(value) or ""
    assert len(text.split()) > 1 and not text.startswith(f"{name}(")  # that of a dataclass without one


def test_type_checkers_see_the_same_names() -> None:
    """The imports under TYPE_CHECKING are the table, and `__all__` its keys."""
    tree = ast.parse(Path(mi_refgs.__file__).read_text())
    (block,) = [
        node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    ]
    shown = {
        alias.asname: (node.module, alias.name)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    table = {name: (f"mi_refgs.{module}", inner) for name, (module, inner) in mi_refgs._PUBLIC.items()}
    assert shown == table and set(mi_refgs.__all__) == set(table)


def test_what_is_no_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="module 'mi_refgs' has no attribute 'Surfel'"):
        mi_refgs.Surfel  # type: ignore[attr-defined]  # noqa: B018


def test_an_import_loads_no_heavy_module(tmp_path: Path) -> None:
    """Nor does the first use of the table load what only meshes need."""
    code = (
        "import sys, mi_refgs\n"
        "heavy = {'scipy', 'skimage', 'trimesh', 'PIL', 'matplotlib', 'OpenEXR'} & {*sys.modules}\n"
        "assert not heavy and 'mi_refgs.surfels.table' not in sys.modules, heavy\n"
        "from mi_refgs import Surfels\n"
        "assert 'mi_refgs.surfels.table' in sys.modules and 'trimesh' not in sys.modules\n"
    )
    run_python(code, folder=tmp_path)
