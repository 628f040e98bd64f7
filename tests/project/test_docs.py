"""README and pages: Python blocks run, commands exist, links resolve, the site builds without a warning."""

import re
import shlex
import shutil
import tomllib
from pathlib import Path
from urllib.parse import urlparse

import pytest

from tests.helpers import ROOT, command_names, command_options, completed, run_python

REFERENCE = ROOT / "docs" / "reference"
PAGES = [*ROOT.glob("*.md"), ROOT / "scenes" / "README.md", *(ROOT / "docs").rglob("*.md")]
"""Every page of a clone."""


def blocks(page: Path, language: str) -> list[str]:
    """The code blocks of a language, outside of lists."""
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


PYTHON = [
    pytest.param(code, id=f"{name(page)}-{i}", marks=() if page.name == "README.md" else pytest.mark.slow)
    for page in PAGES
    for i, code in enumerate(blocks(page, "python"))
]
SHELL = [pytest.param(page, id=name(page)) for page in PAGES if blocks(page, "sh")]


@pytest.fixture(scope="module")
def checkout(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder like a checkout in which `bash setup.sh demo` was run; its run is a tiny one."""
    folder = tmp_path_factory.mktemp("checkout")
    shutil.copytree(finished, folder / "runs" / "demo" / "quick")
    (folder / "scenes").symlink_to(ROOT / "scenes")
    return folder


@pytest.mark.parametrize("code", PYTHON)
def test_python_blocks_run(code: str, checkout: Path) -> None:
    """Each block in a process of its own, as a reader would paste it; warnings are errors."""
    run_python(code, folder=checkout)


def test_methods_of_plugins_load(tmp_path: Path) -> None:
    (block,) = blocks(ROOT / "docs" / "scripting.md", "toml")
    (tmp_path / "coat.toml").write_text(block)
    plugin = str(ROOT / "tests/scenes/coat.py")
    code = f"import mi_refgs\nmi_refgs.load_plugins([{plugin!r}])\nmi_refgs.load_method('coat.toml')"
    run_python(code, folder=tmp_path)


@pytest.mark.parametrize("page", SHELL)
def test_commands_exist(page: Path) -> None:
    """Every `refgs` line parses: its command and options are known."""
    from mi_refgs.cli import parse

    for line in "\n".join(blocks(page, "sh")).replace("\\\n", " ").splitlines():
        if line.startswith("refgs "):
            parse(shlex.split(line, comments=True)[1:])


@pytest.mark.parametrize("page", [pytest.param(page, id=name(page)) for page in PAGES])
def test_links_resolve(page: Path) -> None:
    """To a file of a clone. The build of the site checks their anchors."""
    text = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)#\s]+)", text):
        if "://" in target:
            assert urlparse(target).scheme == "https" and urlparse(target).hostname, target
        else:
            assert (page.parent / target).exists(), target


def test_reference_describes_the_code(tmp_path: Path) -> None:
    """In a process of its own, without what other tests register."""
    completed("-m", "docs.site_pages", tmp_path)
    for page in REFERENCE.glob("*.md"):
        made = (tmp_path / page.name).read_text(encoding="utf-8")
        assert page.read_text(encoding="utf-8") == made, "run `python -m docs.site_pages`"


def test_reference_is_complete() -> None:
    """Every command and option, public name, plugin, method with its deviations, and setting."""
    import mi_refgs
    from mi_refgs.methods.method import LOSS_WEIGHTS

    text = {path.stem: path.read_text(encoding="utf-8") for path in REFERENCE.glob("*.md")}
    for command in command_names():
        for option in command_options(command):
            assert option in text["commands"] or not option.startswith("--"), option
    assert all(f"\n### {public}\n" in text["python"] for public in mi_refgs.__all__)
    assert "| `dominant`, `antialias` |" in text["plugins"]
    for path in (ROOT / "variants").glob("*.toml"):
        for deviation in tomllib.loads(path.read_text())["about"]["deviations"]:
            assert f"- {deviation}" in text["methods"], deviation
    assert all(f"`{loss}`" in text["settings"] for loss in LOSS_WEIGHTS)
    without = re.findall(r"^\| `.*\|  \|$", text["settings"], flags=re.MULTILINE)
    assert not without, f"settings without a description: {without}"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built with warnings as errors."""
    target = tmp_path_factory.mktemp("site")
    arguments = ("-m", "mkdocs", "build", "--strict", "-f", ROOT / "mkdocs.yml", "-d", target)
    completed(*arguments, environment={"NO_MKDOCS_2_WARNING": "1"})
    return target


def test_site_works_without_a_network(site: Path) -> None:
    """Neither scripts nor styles, fonts or images from other servers; sliders have two labelled images."""
    sliders = []
    for page in site.rglob("*.html"):
        text = re.sub(r'<link rel="canonical"[^>]*>', "", page.read_text(encoding="utf-8"))
        elsewhere = r'<(?:script|img|iframe|source|video|link)[^>]*(?:src|href)="(?:https?:)?//[^"]*"'
        assert not re.findall(elsewhere, text), page
        sliders += re.findall(r'<div class="compare">(.*?)</div>', text, flags=re.DOTALL)
    assert sliders and all(len(re.findall(r'<img alt="[^"]+" src="[^"]+" ?/?>', x)) == 2 for x in sliders)
