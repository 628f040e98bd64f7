"""README and pages stay true: their Python blocks run, their commands exist, their links lead somewhere, and
the site is built of them without a warning."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import tomllib
from pathlib import Path
from urllib.parse import urlparse

import pytest

from tests.helpers import ROOT, command_names, command_options, run_process, run_python

README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [*ROOT.glob("*.md"), ROOT / "scenes" / "README.md", *(ROOT / "docs").rglob("*.md")]
"""Every hand-written page."""
MADE = {
    f"{name}.md"
    for name in "api changelog cli contributing exports is_it_for_me methods plugins scenes settings".split()
}
"""Pages of docs/ that are made while the site is built."""


def blocks(page: Path, language: str) -> list[str]:
    """The code blocks of a language, outside of lists."""
    return re.findall(
        rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
    )


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


PYTHON = [
    pytest.param(code, id=f"{name(page)}-{i}")
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


@pytest.mark.parametrize("page", SHELL)
def test_commands_exist(page: Path) -> None:
    """Every `refgs` line parses: its command and options are known."""
    from mi_refgs.cli import parse

    text = "\n".join(blocks(page, "sh")).replace("\\\n", " ")
    for line in text.splitlines():
        if line.startswith("refgs "):
            parse(shlex.split(line, comments=True)[1:])


def test_readme_setup_commands_match_ci() -> None:
    assert "bash setup.sh test" in README and "bash setup.sh demo" in README
    assert "bash setup.sh test" in (ROOT / ".ci" / "run").read_text()


def test_pages_stay_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 110
    assert len((ROOT / "docs" / "decisions.md").read_text().split()) <= 5000


@pytest.mark.parametrize("page", [pytest.param(page, id=name(page)) for page in PAGES])
def test_links_resolve(page: Path) -> None:
    """To a file; or, within docs/, to a page that is made. The build of the site checks their anchors."""
    text = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)#\s]+)", text):
        made = page.parent == ROOT / "docs" and target in MADE
        if "://" in target:
            assert urlparse(target).scheme == "https" and urlparse(target).hostname, target
        else:
            assert made or (page.parent / target).exists(), target


# ---------- The site ----------


def build(config: Path, target: Path) -> subprocess.CompletedProcess[str]:
    """Build a site with warnings as errors."""
    arguments = ("-m", "mkdocs", "build", "--strict", "-f", config, "-d", target)
    return run_process(*arguments, environment={"NO_MKDOCS_2_WARNING": "1"})


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built."""
    target = tmp_path_factory.mktemp("site")
    done = build(ROOT / "mkdocs.yml", target)
    assert done.returncode == 0, done.stderr[-4000:]
    return target


def headings(page: Path) -> set[str]:
    """Anchors of a built page."""
    return set(re.findall(r'<h[1-6] id="([^"]+)"', page.read_text(encoding="utf-8")))


def test_site_has_every_page(site: Path) -> None:
    expected = {page.stem for page in (ROOT / "docs").glob("*.md")} | {Path(made).stem for made in MADE}
    assert {page.parent.name for page in site.glob("*/index.html")} >= expected - {"index"}
    assert (site / "index.html").is_file()


def test_site_has_every_command(site: Path) -> None:
    page = site / "cli" / "index.html"
    assert {*command_names()} <= headings(page)
    text = page.read_text(encoding="utf-8")
    for name in command_names():
        for option in command_options(name):
            assert option in text or not option.startswith("--"), option


def test_site_has_every_public_name(site: Path) -> None:
    import mi_refgs

    page = (site / "api" / "index.html").read_text(encoding="utf-8")
    for public in mi_refgs.__all__:
        assert re.search(rf"<h3[^>]*>.*?\b{public}\b.*?</h3>", page, flags=re.DOTALL), public


def test_site_has_every_plugin_and_parameter(site: Path) -> None:
    from mi_refgs.plugins import PLUGINS

    page = site / "plugins" / "index.html"
    assert set(PLUGINS) <= headings(page)
    text = page.read_text(encoding="utf-8")
    for parameter in ("filename", "shade_at", "visibility_rays", "surroundings", "background", "albedo"):
        assert f"<code>{parameter}</code>" in text


def test_site_has_every_method_with_its_deviations(site: Path) -> None:
    page = site / "methods" / "index.html"
    text = page.read_text(encoding="utf-8")
    for path in (ROOT / "variants").glob("*.toml"):
        assert path.stem in headings(page)
        for deviation in tomllib.loads(path.read_text())["about"]["deviations"]:
            assert deviation.split(",")[0].split("<")[0].split("&")[0] in text, deviation


def test_site_has_every_setting(site: Path) -> None:
    from mi_refgs.methods.method import LOSS_WEIGHTS

    text = (site / "settings" / "index.html").read_text(encoding="utf-8")
    for name in LOSS_WEIGHTS:
        assert f"<code>{name}</code>" in text
    without = re.findall(r"<tr>\s*<td><code>([^<]*)</code></td>(?:\s*<td>.*?</td>){2}\s*<td></td>", text)
    assert "<code>height</code>" in text and not without, f"settings without a description: {without}"


def test_site_loads_nothing_from_other_servers(site: Path) -> None:
    """Neither scripts nor styles, fonts or images: it works without a network."""
    for page in site.rglob("*.html"):
        text = re.sub(r'<link rel="canonical"[^>]*>', "", page.read_text(encoding="utf-8"))
        assert not re.findall(r'<(?:script|img|iframe|source|video)[^>]*src="(?:https?:)?//[^"]*"', text), (
            page
        )
        assert not re.findall(r'<link[^>]*href="(?:https?:)?//[^"]*"', text), page


def test_sliders_have_two_labelled_images(site: Path) -> None:
    """What theme/site.js makes a slider of; its labels are the alternative texts."""
    found = [
        box
        for page in site.rglob("*.html")
        for box in re.findall(r'<div class="compare">(.*?)</div>', page.read_text("utf-8"), flags=re.DOTALL)
    ]
    assert found
    for box in found:
        assert len(re.findall(r'<img alt="[^"]+" src="[^"]+" ?/?>', box)) == 2, box


def test_site_lists_external_links(site: Path) -> None:
    listed = (site / "external_links.txt").read_text().split()
    assert "https://www.mitsuba-renderer.org" in listed


BROKEN = ["[a](nowhere.md)", "[a](#nowhere)", "![a](nowhere.png)", "[a](/absolute.md)"]


def test_broken_links_fail_the_build(tmp_path: Path) -> None:
    """With the settings of the real site: each of them is a warning."""
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text("# Title\n\n" + "\n\n".join(BROKEN))
    config = tmp_path / "mkdocs.yml"
    config.write_text(
        f"INHERIT: {ROOT / 'mkdocs.yml'}\ndocs_dir: docs\nhooks: []\nplugins: []\nnav: [index.md]\n"
        "theme: {name: mkdocs, icon: null, palette: null}\n"
    )
    done = build(config, tmp_path / "site")
    assert done.returncode != 0
    for text in BROKEN:
        target = re.search(r"\((.*)\)", text)
        assert target and f"'{target[1]}'" in done.stderr, text
