"""What surrounds the code: citation, changelog, licences and hosted checks say what is true."""

import re
from pathlib import Path
from typing import Any

import yaml

import mi_refgs
from tests.helpers import ROOT


def read(path: Path) -> Any:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def test_changelog_has_this_version_first() -> None:
    """With the date of the release, once there is one, as cited."""
    headings = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    assert all(re.fullmatch(r"\d+\.\d+\.\d+ \((unreleased|\d{4}-\d\d-\d\d)\)", text) for text in headings)
    version, date = headings[0].split()
    cited = read(ROOT / "CITATION.cff")
    released = cited.get("date-released")
    assert version == mi_refgs.__version__ == cited["version"]
    assert f"({released})" == date or (released is None and date == "(unreleased)")


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
    """On the oldest Python that the package supports, too."""
    job = read(ROOT / ".github" / "workflows" / "ci.yml")["jobs"]["checks"]
    assert [step["run"] for step in job["steps"] if "run" in step] == [".ci/run"]
    oldest = re.search(r'requires-python = ">=(.*)"', (ROOT / "pyproject.toml").read_text())
    assert oldest is not None and oldest[1] in job["strategy"]["matrix"]["python"]
