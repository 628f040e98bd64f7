"""`refgs completion`: the scripts that shells source, made of the parser as it is."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from mi_refgs.cli import main
from tests.helpers import command_names, refused


def script(shell: str, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["completion", shell]) == 0
    return capsys.readouterr().out


def completed(source: str, *words: str) -> set[str]:
    """What bash offers for the last word."""
    code = f"""{source}
COMP_WORDS=({" ".join(f"'{word}'" for word in words)})
COMP_CWORD={len(words) - 1}
COMP_LINE="${{COMP_WORDS[*]}}"
$(complete -p refgs | sed -E 's/.*-F ([^ ]+).*/\\1/') refgs
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, timeout=60, check=True)
    return set(done.stdout.split())


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
def test_bash_completes_commands_options_and_files(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = script("bash", capsys)
    assert completed(source, "refgs", "") >= {*command_names()}
    assert completed(source, "refgs", "tr") == {"train"}
    assert "--preset" in completed(source, "refgs", "train", "--p")
    assert "--turntable" in completed(source, "refgs", "relight", "run", "--turn")
    (tmp_path / "vase").mkdir()
    monkeypatch.chdir(tmp_path)
    assert "vase" in completed(source, "refgs", "train", "va")


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh", "fish"])
def test_every_shell_has_a_script(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = script(shell, capsys)
    assert "refgs" in text and "relight" in text
    assert "--turntable" in text or shell == "tcsh"
    assert main(["completion", shell, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"shell": shell, "script": text.removesuffix("\n")}


def test_unknown_shell_is_refused() -> None:
    refused(["completion", "powershell"], "powershell", "'bash', 'zsh', 'tcsh', 'fish'")
