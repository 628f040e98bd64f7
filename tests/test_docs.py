"""The README stays true: its Python blocks run, its commands exist, its links lead somewhere."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.parametrize("number", range(len(blocks("python"))))
def test_python_blocks_run(number: int, tmp_path: Path) -> None:
    """Each block in a process of its own, as a reader would paste it; warnings are errors."""
    code = blocks("python")[number]
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert result.returncode == 0, result.stderr[-2000:]


def test_commands_of_the_readme_exist() -> None:
    """Every `refgs` line parses: its command and options are known."""
    from mi_refgs.cli import build_parser

    lines = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("refgs ")]
    assert lines
    for line in lines:
        build_parser().parse_args(line.split("#")[0].split()[1:])


def test_setup_commands_of_the_readme_are_those_of_ci() -> None:
    assert "bash setup.sh test" in README and "bash setup.sh demo" in README
    assert "bash setup.sh test" in (ROOT / ".ci" / "run").read_text()


def test_links_of_the_readme_lead_somewhere() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        if not target.startswith("http"):
            assert (ROOT / target).exists(), target
