"""Sdist and wheel contain what they should, install in a clean environment, declare command and plugins."""

import configparser
import json
import re
import shutil
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path
from typing import Any

import pytest

import mi_refgs
from mi_refgs.cli.doctor import EXTRAS
from mi_refgs.io.files import resource_dir
from tests.helpers import ROOT, completed, imported_packages, refused

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
LEFT_OUT = {".git", ".venv", "runs", "data", "site", "build", "dist"}
"""Folders of a checkout that are no part of the project."""


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the sdist, and the wheel that was built of the sdist; without a network, from a copy."""
    source = tmp_path_factory.mktemp("source") / "checkout"
    made = shutil.ignore_patterns("__pycache__", "*.egg-info", ".*_cache", ".hypothesis")
    shutil.copytree(
        ROOT,
        source,
        ignore=lambda folder, names: made(folder, names) | (LEFT_OUT if Path(folder) == ROOT else set()),
    )
    target = tmp_path_factory.mktemp("dist")
    completed("-m", "build", "--no-isolation", "-o", target, ".", folder=source, package=source)
    return target


@pytest.fixture(scope="module")
def environment(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clean environment with the wheel installed by pip; what it depends on is this one's."""
    [package] = built.glob("*.whl")
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, symlinks=True)
    options = ["--no-index", "--no-deps", "--disable-pip-version-check", "-qq"]
    completed("-m", "pip", "--python", folder, "install", *options, package, package=folder)
    [site] = folder.glob("lib/python*/site-packages")
    (site / "others.pth").write_text(f"{sysconfig.get_path('purelib')}\n{sysconfig.get_path('platlib')}")
    return folder


def run_in(environment: Path, *command: str) -> str:
    """Standard output of a command of an environment, started away from the checkout."""
    program, *arguments = command
    options: dict[str, Any] = {"folder": environment, "environment": {"PYTHONPATH": None}}
    return completed(*arguments, program=environment / "bin" / program, **options)


def test_installed_package_works(environment: Path) -> None:
    """It finds its modules and data, registers its plugins, and its command examines the installation."""
    code = """
import mi_refgs, json, mitsuba as mi
from mi_refgs.methods.read import load
from mi_refgs.io.files import resource_dir
mi.set_variant("llvm_ad_rgb")
plugin = type(mi.load_dict({"type": "refgs_bsdf"})).__name__
print(json.dumps([mi_refgs.__file__, str(resource_dir("scenes")), load("relighting").name, plugin]))
"""
    module, scenes, name, plugin = json.loads(run_in(environment, "python", "-W", "error", "-c", code))
    package = Path(module).parent
    assert environment in package.parents and environment in Path(scenes).parents
    assert (Path(scenes) / "glossy_demo.xml").is_file() and (package / "py.typed").is_file()
    assert (name, plugin) == ("relighting", "RefGSBSDF")
    found = json.loads(run_in(environment, "refgs", "doctor", "--json"))
    assert found["usable"] and found["mi_refgs"] == mi_refgs.__version__


def test_sdist_contains_all_that_checks_need(built: Path) -> None:
    [path] = built.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"setup.sh", "mkdocs.yml", ".ci/run", "CITATION.cff", "CHANGELOG.md", "pyproject.toml"} <= names
    for folder in ("mi_refgs", "tests", "docs", "benchmarks", "scenes", "variants"):
        for path in (ROOT / folder).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                assert str(path.relative_to(ROOT)) in names, path
    left_out = (".venv", "runs/", "site/")
    assert not [name for name in names if "__pycache__" in name or name.startswith(left_out)]


def test_wheel_contains_the_package_and_nothing_else(built: Path) -> None:
    """Every module and data file; the command and the plugin are declared."""
    [path] = built.glob("*.whl")
    points = configparser.ConfigParser()
    with zipfile.ZipFile(path) as archive:
        packed = set(archive.namelist())
        [entries] = (name for name in packed if name.endswith(".dist-info/entry_points.txt"))
        points.read_string(archive.read(entries).decode())
    expected = {str(path.relative_to(ROOT)) for path in (ROOT / "mi_refgs").rglob("*.py")}
    expected |= {f"mi_refgs/variants/{path.name}" for path in (ROOT / "variants").glob("*.toml")}
    scenes = [p for p in (ROOT / "scenes").rglob("*") if p.suffix in {".toml", ".xml", ".ply", ".exr"}]
    expected |= {f"mi_refgs/{path.relative_to(ROOT)}" for path in scenes}
    assert expected | {"mi_refgs/py.typed"} <= packed
    tops = {name.split("/")[0] for name in packed}
    assert tops == {"mi_refgs", *(top for top in tops if top.endswith(".dist-info"))}
    assert points["console_scripts"]["refgs"] == "mi_refgs.cli:main"
    assert points["mitsuba"]["refgs"] == "mi_refgs.plugins.integrator"


def test_plugins_and_packages_are_listed() -> None:
    from mi_refgs.plugins import PLUGINS

    modules = {name: module for name, (_, module) in PLUGINS.items()}
    assert modules == PROJECT["project"]["entry-points"]["mitsuba"]
    found = {path.parent.relative_to(ROOT) for path in (ROOT / "mi_refgs").rglob("__init__.py")}
    packages = {".".join(path.parts) for path in found} | {"mi_refgs.variants", "mi_refgs.scenes"}
    assert packages == set(PROJECT["tool"]["setuptools"]["packages"])


IMPORT_NAMES = {"scikit_image": "skimage", "pillow": "pil", "mitsuba": "drjit"}
IMPORT_NAMES |= {"dask": "distributed", "openexr": "imath"}
"""Modules that a distribution installs under another name than its own, in lower case."""


def declared(requirements: list[str]) -> set[str]:
    """Import names that a list of requirements provides, in lower case."""
    names = {re.split(r"[^\w.-]", requirement)[0].lower().replace("-", "_") for requirement in requirements}
    return names | {IMPORT_NAMES[name] for name in names if name in IMPORT_NAMES}


def test_every_import_is_declared() -> None:
    """What the package imports is a dependency, or belongs to an extra that a user may leave out."""
    project = PROJECT["project"]
    extras = {name: lines for name, lines in project["optional-dependencies"].items() if name != "dev"}
    known = declared(sum(extras.values(), project["dependencies"]))
    for path in (ROOT / "mi_refgs").rglob("*.py"):
        found = imported_packages(path.read_text()) - sys.stdlib_module_names - {"mi_refgs"}
        missing = {name for name in found if name.lower() not in known}
        assert not missing, f"{path.name} imports {missing}, which pyproject.toml does not declare"


def test_doctor_checks_modules_of_the_extras() -> None:
    extras = PROJECT["project"]["optional-dependencies"]
    for name, distribution in EXTRAS.items():
        assert any(line.startswith(distribution) for line in extras[name]), name


def test_checkout_finds_its_data() -> None:
    assert [resource_dir(name) for name in ("variants", "scenes")] == [ROOT / "variants", ROOT / "scenes"]
    refused(lambda: resource_dir("absent"), "absent: the folder is missing from this installation")
