"""The rules that keep the package in layers, read off its imports."""

import ast
import re
import tomllib
from collections.abc import Iterator
from graphlib import TopologicalSorter

from tests.helpers import ROOT

FLOORS: list[set[str]] = [
    {"constants", "errors", "llvm", "types"}, {"registry"}, {"kernels"}, {"io"}, {"surfels"}, {"splat"},
    {"data"}, {"occlusion"}, {"shade"}, {"render"}, {"capture", "methods", "plugins", "synthesis"}, {"runs"},
    {"fitting"}, {"evaluation"}, {"compare", "editing"}, {"formats"}, {"reconstruction"}, {"viewer"},
    {"cli", "public"}, {"__main__"},
]  # fmt: skip
"""Folders and modules of the package from the ground up: each imports from the floors below it only.

Those of one floor do not import each other. `reference` imports `constants` only, and nothing of the package
imports it. `public` has the public names; of the package's own `__init__`, folders import only `__version__`.
"""

PATHS = sorted((ROOT / "mi_refgs").rglob("*.py"))
TREES = {
    ".".join(path.relative_to(ROOT / "mi_refgs").with_suffix("").parts).removesuffix(".__init__"): ast.parse(
        path.read_text()
    )
    for path in PATHS
}
"""The files of the package by their dotted name below it, as "splat.tiles"."""


def imports(tree: ast.Module) -> Iterator[str]:
    """Everything that a file imports, such as "mi_refgs.splat.camera.Camera"; all imports are absolute."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_imports_point_down() -> None:
    floor = {folder: level for level, folders in enumerate(FLOORS) for folder in folders}
    assert {module.partition(".")[0] for module in TREES} == {*floor, "reference", "__init__"}
    for module, tree in TREES.items():
        folder = module.partition(".")[0]
        for name in imports(tree):
            package, _, inner = name.partition(".")
            target = inner.partition(".")[0]
            if package != "mi_refgs" or folder in ("__init__", target) or target == "__version__":
                continue
            if folder == "reference":
                assert target == "constants", (module, name)
            else:
                assert floor.get(target, len(FLOORS)) < floor[folder], (module, name)


def test_no_files_import_each_other() -> None:
    """Neither in pairs nor in longer cycles: every file can be read after those that it imports."""
    targets = {}
    for module, tree in TREES.items():
        found = set()
        for name in imports(tree):  # an imported name counts for the file that it is found in
            package, _, inner = name.partition(".")
            while inner and inner not in TREES:
                inner = inner.rpartition(".")[0]
            found |= {inner} if package == "mi_refgs" else set()
        targets[module] = found - {module, ""}
    TopologicalSorter(targets).prepare()  # raises CycleError


def test_reference_imports_neither_drjit_nor_mitsuba_and_only_methods_read_toml() -> None:
    for module, tree in TREES.items():
        packages = {name.partition(".")[0] for name in imports(tree)}
        assert not (module.startswith("reference") and packages & {"drjit", "mitsuba"}), module
        assert module == "methods.read" or not packages & {"tomllib", "toml"}, module


def test_no_code_names_a_method() -> None:
    """A method is data: no string of the package but documentation is one's name, unless it is a purpose."""
    variants = (ROOT / "variants").glob("*.toml")
    about = {path.stem: tomllib.loads(path.read_text())["about"] for path in variants}
    purposes = {one.get("purpose") for one in about.values()}
    names = {*about, *(one["name"] for one in about.values() if "name" in one)} - purposes
    for module, tree in TREES.items():
        documentation = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        strings = [node for node in ast.walk(tree) if isinstance(node, ast.Constant)]
        assert not names & {node.value for node in strings if id(node) not in documentation}, module


def test_numpy_arrays_reach_the_device_by_upload() -> None:
    """Kernels read beyond the end of wrapped ones: `device.upload` and `upload_tensor` copy them."""
    wrapped = r"(?:np\.|(?!dr\.)[\w.\[\]]+\.(?:T|astype|ravel|reshape|numpy|flatten)\b)"
    pattern = re.compile(rf"mi\.(?:Float|UInt32|Int32|Bool|TensorX[fuib])\({wrapped}")
    for path in PATHS:
        assert path.name == "device.py" or not pattern.search(path.read_text()), path


def test_no_test_module_imports_a_test_module() -> None:
    """What tests share is in tests/helpers.py, tests/scenes, or a module of their folder without `test_`."""
    pattern = re.compile(r"^\s*(?:from|import) tests\b.*\btest_", re.MULTILINE)
    assert not [path for path in (ROOT / "tests").rglob("*.py") if pattern.search(path.read_text())]
