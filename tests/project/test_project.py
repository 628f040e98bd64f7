"""What surrounds the code: citation, changelog, hosted checks, hooks and issue templates say what is true."""

from __future__ import annotations

import re
import shutil
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

import mi_refgs
from tests.helpers import ROOT, run_process

TEMPLATES = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))


def read(path: Path) -> Any:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def test_citation_is_complete_and_of_this_version() -> None:
    """Keys that version 1.2.0 of the format requires, and their types."""
    cited = read(ROOT / "CITATION.cff")
    assert cited["cff-version"] == "1.2.0" and cited["type"] == "software"
    assert cited["version"] == mi_refgs.__version__
    assert isinstance(cited["message"], str) and isinstance(cited["title"], str)
    for work in (cited, *cited["references"]):
        assert work["authors"] and all({"name", "family-names"} & set(author) for author in work["authors"])
    [paper] = cited["references"]
    assert paper["title"] == "Reflective Gaussian Splatting" and paper["year"] == 2025
    licence = re.search(r'^license = "(.*)"', (ROOT / "pyproject.toml").read_text(), flags=re.MULTILINE)
    assert licence is not None and cited["license"] == licence[1]


def test_changelog_has_this_version_first() -> None:
    headings = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    assert all(re.fullmatch(r"\d+\.\d+\.\d+ \((unreleased|\d{4}-\d\d-\d\d)\)", text) for text in headings)
    assert headings[0].split()[0] == mi_refgs.__version__


def test_release_date_is_cited_once_there_is_one() -> None:
    dates = re.findall(r"^## \S+ \((.*)\)$", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    released = read(ROOT / "CITATION.cff").get("date-released")
    assert str(released) == dates[0] or (released is None and dates[0] == "unreleased")


def test_authors_are_the_same_everywhere() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert read(ROOT / "CITATION.cff")["authors"] == project["authors"] == [{"name": "mi_refgs contributors"}]


def test_licences_of_assets_are_listed() -> None:
    """Every file that is not text is in the table of docs/releasing.md."""
    text = (ROOT / "docs" / "releasing.md").read_text(encoding="utf-8").partition("## Licences")[2]
    listed = {
        path
        for glob in re.findall(r"`([\w/]+/\*+[.\w]*)`", text)
        for path in ROOT.glob(glob + "/*" * glob.endswith("**"))
    }
    kinds = {".exr", ".ply", ".png", ".webp", ".jpg", ".svg", ".npz", ".npy", ".hdr", ".obj", ".glb"}
    folders = ("mi_refgs", "benchmarks", "scenes", "variants", "docs", "tests")
    assets = {path for name in folders for path in (ROOT / name).rglob("*") if path.suffix in kinds}
    assert len(assets) > 40 and not assets - listed


def test_hosted_checks_are_those_of_ci() -> None:
    steps = read(ROOT / ".github" / "workflows" / "ci.yml")["jobs"]["checks"]["steps"]
    assert [step["run"] for step in steps if "run" in step] == [".ci/run"]


def test_hosted_checks_run_the_oldest_python() -> None:
    job = read(ROOT / ".github" / "workflows" / "ci.yml")["jobs"]["checks"]
    oldest = re.search(r'requires-python = ">=(.*)"', (ROOT / "pyproject.toml").read_text())
    assert oldest is not None and oldest[1] in job["strategy"]["matrix"]["python"]


@pytest.mark.parametrize(
    "path", [pytest.param(path, id=path.stem) for path in TEMPLATES if path.stem != "config"]
)
def test_templates_ask_for_the_installation(path: Path) -> None:
    form = read(path)
    assert form["name"] and form["description"] and form["body"]
    assert len({part["id"] for part in form["body"]}) == len(form["body"])
    assert "refgs doctor --json" in path.read_text()


def test_hooks_are_valid_and_their_tools_here() -> None:
    config = ROOT / ".pre-commit-config.yaml"
    done = run_process("-m", "pre_commit", "validate-config", config)
    assert done.returncode == 0, done.stdout
    tools = f"{Path(sys.executable).parent}:/usr/bin:/bin"
    for repository in read(config)["repos"]:
        assert repository["repo"] == "local"  # nothing is downloaded
        for hook in repository["hooks"]:
            assert shutil.which(hook["entry"].split()[0], path=tools), hook["id"]
