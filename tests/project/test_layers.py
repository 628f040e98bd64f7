"""The rules that keep the package in layers, read off its syntax trees and tried on breaches."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from tests.helpers import ROOT, imported_packages

PACKAGE = "mi_refgs"

FLAT = {"Float", "UInt32", "Int32", "Bool", "TensorXf", "TensorXu", "TensorXi", "TensorXb"}
"""Arrays that Dr.Jit wraps around NumPy's memory, without a copy, where they are made of a NumPy array."""

FLOORS: list[set[str]] = [
    {"constants", "errors", "llvm", "progress", "types"},
    {"registry"},
    {"kernels"},
    {"io"},
    {"surfels"},
    {"splat"},
    {"data"},
    {"occlusion"},
    {"shade"},
    {"render"},
    {"capture", "methods", "plugins", "synthesis"},
    {"runs"},
    {"fitting"},
    {"evaluation", "profiling"},
    {"compare", "editing"},
    {"formats"},
    {"reconstruction"},
    {"relighting"},
    {"viewer"},
    {"cli"},
    {"__main__"},
]
"""Folders and modules of the package from the ground up: each imports from the floors below it only.

Those of one floor do not import each other. `reference` imports `constants` only, and nothing of the package
imports it. The package's own `__init__` contains the public names: folders import only `__version__` from it.
"""


def module_name(path: Path) -> str:
    """Dotted name below the package: "" for its `__init__`, "splat.tiles", "splat" for splat's `__init__`."""
    parts = list(path.relative_to(ROOT / PACKAGE).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def sources() -> dict[str, str]:
    """Module name → source of every file of the package."""
    return {module_name(path): path.read_text() for path in sorted((ROOT / PACKAGE).rglob("*.py"))}


def imports(source: str) -> Iterator[str]:
    """Names below the package that `source` imports: "" for the package itself, "splat.camera", …

    All imports are absolute: ruff's TID252 refuses others.
    """
    for node in ast.walk(ast.parse(source)):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        yield from (name[len(PACKAGE) + 1 :] for name in names if name.partition(".")[0] == PACKAGE)


def layer_breaches(modules: dict[str, str]) -> list[str]:
    """Imports that `FLOORS` does not allow."""
    floor = {folder: level for level, folders in enumerate(FLOORS) for folder in folders}
    found = []
    for module, source in modules.items():
        folder = module.partition(".")[0]
        if folder not in floor and folder not in ("", "reference"):
            found.append(f"{module}: no floor is declared for it")
            continue
        for imported in imports(source):
            target = imported.partition(".")[0]
            if folder in ("", target) or imported == "__version__":
                continue
            if folder == "reference":
                allowed = target == "constants"
            else:
                allowed = floor.get(target, len(FLOORS)) < floor[folder]
            if not allowed:
                found.append(f"{module}: imports {imported or PACKAGE}")
    return found


def import_cycle(modules: dict[str, str]) -> list[str]:
    """Files that import each other, directly or through others, `TYPE_CHECKING` included; empty without any.

    An imported name counts for the file that it is found in: a submodule, or the folder's `__init__`.
    """
    targets: dict[str, set[str]] = {}
    for module, source in modules.items():
        found = set()
        for name in imports(source):
            while name and name not in modules:
                name = name.rpartition(".")[0]
            found.add(name)
        targets[module] = found - {module, ""}

    try:
        TopologicalSorter(targets).prepare()
    except CycleError as error:
        return sorted({*error.args[1]})
    return []


def strings_outside_docstrings(source: str) -> set[str]:
    """String constants of `source` that are values: bare strings document, and may cite a method by name."""
    tree = ast.parse(source)
    bare = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    return {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in bare
    }


def variant_names() -> set[str]:
    """What the variants are called: their files' names, and the names that they give themselves; but for the
    purposes that they say they are for, which are what code may ask for."""
    names, purposes = set(), set()
    for path in (ROOT / "variants").glob("*.toml"):
        about = tomllib.loads(path.read_text()).get("about", {})
        names |= {path.stem} | ({about["name"]} if "name" in about else set())
        purposes.add(about.get("purpose"))
    return names - purposes


def numpy_fields(modules: dict[str, str]) -> set[str]:
    """Names of fields that are NumPy arrays in every class of the package that has them."""
    kinds: dict[str, set[bool]] = {}
    for source in modules.values():
        for owner in (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ClassDef)):
            for node in (node for node in owner.body if isinstance(node, ast.AnnAssign)):
                kinds.setdefault(ast.unparse(node.target), set()).add(is_numpy_type(node.annotation))
    return {name for name, found in kinds.items() if found == {True}}


def is_numpy_type(annotation: ast.expr | None) -> bool:
    return annotation is not None and ast.unparse(annotation) in ("np.ndarray", "np.ndarray | None")


def wrapped_arrays(source: str, fields: set[str]) -> list[str]:
    """Calls such as `mi.Float(values)` of what is a NumPy array for all that one function shows."""
    return [
        ast.unparse(call)
        for function in ast.walk(ast.parse(source))
        if isinstance(function, ast.FunctionDef)
        for names in [numpy_names(function, fields)]
        for call in ast.walk(function)
        if isinstance(call, ast.Call)
        and isinstance(call.func, ast.Attribute)
        and call.func.attr in FLAT
        and call.args
        and is_numpy(call.args[0], names, fields)
    ]


def numpy_names(function: ast.FunctionDef, fields: set[str]) -> set[str]:
    """Arguments and variables of a function that are NumPy arrays at their last value."""
    every = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    names = {argument.arg for argument in every if is_numpy_type(argument.annotation)}
    pairs: list[tuple[ast.expr, ast.expr]] = []
    for node in ast.walk(function):
        if isinstance(node, ast.Assign):
            pairs += [(target, node.value) for target in node.targets]
        elif isinstance(node, ast.For | ast.comprehension):
            pairs.append((node.target, node.iter))
    for target, value in sorted(pairs, key=lambda pair: (pair[0].lineno, pair[0].col_offset)):
        if isinstance(target, ast.Name):
            (names.add if is_numpy(value, names, fields) else names.discard)(target.id)
    return names


def is_numpy(value: ast.expr, names: set[str], fields: set[str]) -> bool:
    """Whether an expression is a NumPy array: by its function, its method, or what it is made of."""
    match value:
        case ast.Call(func=ast.Attribute(value=ast.Name(id="np"))):
            return True
        case ast.Call(func=ast.Attribute(attr="astype" | "ravel" | "reshape" | "numpy" | "flatten")):
            return not ast.unparse(value).startswith("dr.")
        case ast.Attribute(attr=attr):
            return attr == "T" or attr in fields
        case ast.Name(id=name):
            return name in names
        case ast.Subscript(value=inner) | ast.UnaryOp(operand=inner):
            return is_numpy(inner, names, fields)
        case ast.BinOp(left=left, right=right):
            return is_numpy(left, names, fields) or is_numpy(right, names, fields)
        case ast.Compare(left=left):
            return is_numpy(left, names, fields)
    return False


# ---------- The rules ----------


def test_imports_point_down() -> None:
    assert layer_breaches(sources()) == []


def test_only_the_configuration_opens_toml() -> None:
    readers = {
        module for module, source in sources().items() if {"tomllib", "toml"} & imported_packages(source)
    }
    assert readers <= {"methods.read"}


def test_reference_imports_neither_drjit_nor_mitsuba() -> None:
    for module, source in sources().items():
        if module.partition(".")[0] == "reference":
            assert not {"drjit", "mitsuba"} & imported_packages(source), module


def test_no_code_names_a_method() -> None:
    """A method is data: nothing under the package may compare with, or choose, a variant's name."""
    names = variant_names()
    for module, source in sources().items():
        assert not names & strings_outside_docstrings(source), module


def test_numpy_arrays_reach_the_device_by_upload() -> None:
    """Kernels read beyond the end of wrapped ones: `device.upload` and `upload_tensor` copy them."""
    modules = sources()
    fields = numpy_fields(modules)
    found = {
        module: wrapped_arrays(source, fields)
        for module, source in modules.items()
        if module.partition(".")[0] != "reference" and module != "kernels.device"
    }
    assert {module: calls for module, calls in found.items() if calls} == {}


def test_no_files_import_each_other() -> None:
    """Neither in pairs nor in longer cycles: every file can be read after those that it imports."""
    assert import_cycle(sources()) == []


def test_package_root_has_few_modules() -> None:
    names = {path.stem for path in (ROOT / PACKAGE).glob("*.py")}
    assert len(names) <= 8, sorted(names)


def test_no_test_module_imports_a_test_module() -> None:
    """What tests share is in tests/helpers.py, tests/scenes, or a module of their folder without `test_`."""
    pattern = re.compile(r"^\s*(?:from|import) tests\b.*\btest_", re.MULTILINE)
    paths = sorted((ROOT / "tests").rglob("*.py"))
    assert [path for path in paths if pattern.search(path.read_text())] == []


# ---------- The rules hold what they say ----------


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("splat.tiles", "from mi_refgs.render import pipeline"),
        ("splat.tiles", "import mi_refgs.fitting.train"),
        ("splat.tiles", "def f():\n    from mi_refgs.shade.brdf import split_sum"),
        ("occlusion.mesh", "from mi_refgs.shade.brdf import split_sum"),
        ("surfels.table", "from mi_refgs.reference import splat"),
        ("cli", "from mi_refgs.reference import splat"),
        ("plugins.integrator", "from mi_refgs.cli import main"),
        ("constants", "import mi_refgs"),
        ("cli", "from mi_refgs import Surfels"),
        ("cli", "from mi_refgs import read_ply"),
        ("novelty", "import numpy"),
    ],
)
def test_forbidden_import_is_found(module: str, source: str) -> None:
    assert layer_breaches({module: source})


@pytest.mark.parametrize(
    "modules",
    [
        {"splat.a": "from mi_refgs.splat import b", "splat.b": "import mi_refgs.splat.a"},
        {"splat": "from mi_refgs.splat.a import f", "splat.a": "from mi_refgs.splat import g"},
        {
            "a": "from mi_refgs.b import f",
            "b": "def f():\n    from mi_refgs import c",
            "c": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from mi_refgs.a import f",
        },
    ],
)
def test_import_cycle_is_found(modules: dict[str, str]) -> None:
    assert import_cycle(modules) == sorted(modules)
    last = list(modules)[-1]
    assert import_cycle(modules | {last: "import numpy"}) == []


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("shade.brdf", "from mi_refgs.splat.camera import Camera"),
        ("splat", "from mi_refgs.splat.composite import composite"),
        ("cli", "from mi_refgs import __version__, llvm"),
        ("render.pipeline", "from mi_refgs import splat\nimport numpy as np"),
    ],
)
def test_permitted_import_is_not_found(module: str, source: str) -> None:
    assert layer_breaches({module: source}) == []


def test_method_name_in_code_is_found() -> None:
    source = (
        '"""Cites two_d."""\ndef f(x):\n    """Cites two_d."""\n    return x == "two_d" or f"{x} no two_d"\n'
    )
    assert strings_outside_docstrings(source) == {"two_d", " no two_d"}
    assert strings_outside_docstrings('"""two_d"""\nWIDTH = 3\n"""two_d"""') == set()


@pytest.mark.parametrize(
    "body",
    [
        "mi.Float(np.arange(3.0))",
        "mi.TensorXf(np.ascontiguousarray(x, np.float32))",
        "mi.Float(view.depth.ravel())",
        "mi.Bool(edit.fresh)",
        "mi.UInt32(mesh.faces[:, 0])",
        "mi.Bool(a > 0)",
        "[mi.Float(column) for column in a.T]",
        "y = 2 * a; z = y[3:]; mi.Float(z)",
    ],
)
def test_wrapped_array_is_found(body: str) -> None:
    source = f"def f(a: np.ndarray, x):\n    {body}"
    assert wrapped_arrays(source, {"fresh", "faces"})


@pytest.mark.parametrize(
    "body",
    [
        "mi.Float(x)",
        "mi.Bool(x > 0)",
        "mi.Point3f(a.T)",
        "mi.Float(0)",
        "mi.TensorXf(dr.ravel(x), shape=(3, 3))",
        "y = a; y = x; mi.Float(y)",
    ],
)
def test_other_calls_are_not_wrapped_arrays(body: str) -> None:
    assert not wrapped_arrays(f"def f(a: np.ndarray, x):\n    {body}", {"fresh"})
