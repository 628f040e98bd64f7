"""The wheel holds all that the package imports and opens, and declares its command and its plugin."""

from __future__ import annotations

import configparser
import importlib.metadata
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from helpers import ROOT, imported_packages, run_python

from mi_refgs.errors import InputError
from mi_refgs.resources import resource_dir

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built without a network, from a copy so that nothing is left in the checkout."""
    needed = 77  # the setuptools that knows licence expressions, as pyproject.toml requires
    if int(importlib.metadata.version("setuptools").split(".")[0]) < needed:
        pytest.skip(f"building needs setuptools {needed} (the dev extra brings it)")
    source = tmp_path_factory.mktemp("source")
    for name in ("mi_refgs", "variants", "scenes"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "-qq",
        "--no-deps",
        "--no-build-isolation",
        "-w",
        "dist",
        ".",
    ]
    subprocess.run(command, cwd=source, check=True, timeout=300)
    [built] = (source / "dist").glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds the wheel's contents, as an installation would."""
    folder = tmp_path_factory.mktemp("installed")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def test_wheel_holds_every_module_and_data_file(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        packed = set(archive.namelist())
    expected = {str(path.relative_to(ROOT)) for path in (ROOT / "mi_refgs").rglob("*.py")}
    expected |= {f"mi_refgs/variants/{path.name}" for path in (ROOT / "variants").glob("*.toml")}
    expected |= {
        f"mi_refgs/{path.relative_to(ROOT)}"
        for path in (ROOT / "scenes").rglob("*")
        if path.suffix in {".toml", ".xml", ".ply", ".exr"}
    }
    assert expected | {"mi_refgs/py.typed"} <= packed


def test_wheel_holds_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        tops = {name.split("/")[0] for name in archive.namelist()}
    assert tops == {"mi_refgs", *(top for top in tops if top.endswith(".dist-info"))}


def test_wheel_declares_the_command_and_the_plugin(installed: Path) -> None:
    [path] = installed.glob("*.dist-info/entry_points.txt")
    points = configparser.ConfigParser()
    points.read(path)
    assert points["console_scripts"]["refgs"] == "mi_refgs.cli:main"
    assert points["mitsuba"]["refgs"] == "mi_refgs.plugins.integrator"


def test_plugins_and_entry_points_name_the_same_modules() -> None:
    from mi_refgs.plugins import PLUGINS

    modules = {name: module for name, (_, module) in PLUGINS.items()}
    assert modules == PROJECT["project"]["entry-points"]["mitsuba"]


def test_wheel_imports_and_finds_its_data(installed: Path) -> None:
    code = "import mi_refgs\nfrom mi_refgs.resources import resource_dir\nprint(resource_dir('scenes'))"
    assert Path(run_python(code, folder=installed, package=installed)) == installed / "mi_refgs" / "scenes"


def test_every_package_is_listed() -> None:
    packages = {
        ".".join(path.parent.relative_to(ROOT).parts) for path in (ROOT / "mi_refgs").rglob("__init__.py")
    }
    assert packages | {"mi_refgs.variants", "mi_refgs.scenes"} == set(
        PROJECT["tool"]["setuptools"]["packages"]
    )


IMPORT_NAMES = {"scikit_image": "skimage", "pillow": "pil", "mitsuba": "drjit", "dask": "distributed"}
"""What a distribution brings under another name than its own, in lower case."""


def imported(source: str) -> set[str]:
    """First names of what a file imports that is neither Python's nor its own package's."""
    return imported_packages(source) - sys.stdlib_module_names - {"mi_refgs"}


def declared(requirements: list[str]) -> set[str]:
    """Import names that a list of requirements provides, in lower case."""
    names = {re.split(r"[^\w.-]", requirement)[0].lower().replace("-", "_") for requirement in requirements}
    return names | {IMPORT_NAMES[name] for name in names if name in IMPORT_NAMES}


def test_every_import_is_declared() -> None:
    """What the package imports is a dependency, or belongs to an extra that a user may leave out."""
    project = PROJECT["project"]
    extras = [
        line for name, lines in project["optional-dependencies"].items() if name != "dev" for line in lines
    ]
    known = declared(project["dependencies"] + extras)
    for path in (ROOT / "mi_refgs").rglob("*.py"):
        missing = {name for name in imported(path.read_text()) if name.lower() not in known}
        assert not missing, f"{path.name} imports {missing}, which pyproject.toml does not declare"


def test_version_is_stated_once() -> None:
    import mi_refgs

    assert re.fullmatch(r"\d+\.\d+\.\d+", mi_refgs.__version__)
    assert PROJECT["project"]["dynamic"] == ["version"]


@pytest.mark.parametrize("name", ["variants", "scenes"])
def test_checkout_finds_its_data(name: str) -> None:
    assert resource_dir(name) == ROOT / name


def test_missing_data_is_one_sentence() -> None:
    with pytest.raises(InputError, match="absent: the folder is missing from this installation"):
        resource_dir("absent")
