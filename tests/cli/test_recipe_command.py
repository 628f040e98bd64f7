"""CONTRIBUTING's recipe "a command", followed: a command of this test's own, from its help to its result."""

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
from tyro.conf import Positional, arg

from mi_refgs.cli import COMMANDS, main
from mi_refgs.cli.command import Common, Flag, Output, Result
from mi_refgs.errors import InputError
from tests.helpers import command_options, refused


@dataclass(frozen=True, kw_only=True)
class Count:
    """Blank lines do not count.

    example:
      refgs count notes.txt -o count.txt"""

    file: Annotated[Positional[Path], arg(metavar="FILE")]  # text file
    output: Output  # file of the number
    words: Flag = False  # count words instead
    common: Common = Common()

    def run(self) -> Result:
        """Count."""
        if not self.file.is_file():
            raise InputError(f"{self.file}: FILE: missing; name a text file")
        text = self.file.read_text()
        count = len(text.split()) if self.words else sum(map(bool, text.splitlines()))
        self.output.write_text(str(count))
        return Result({"count": count}, f"{self.output}: {count}")


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """One module, and one line of COMMANDS."""
    monkeypatch.setitem(sys.modules, "mi_refgs.cli.count", sys.modules[__name__])
    monkeypatch.setitem(COMMANDS["Use"], "count", ("count:Count", "count the lines of a file"))
    yield


def test_help_has_summary_options_and_example(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert "  count       count the lines of a file\n" in capsys.readouterr().out
    assert main(["count", "--help"]) == 0
    text = capsys.readouterr().out
    for part in ("Count the lines of a file.", "Blank lines", "example:\n  refgs count", "--words", "--json"):
        assert part in text
    assert command_options("count") == ["file", "--output", "--words", "--json", "--plugin"]


def test_command_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "notes.txt").write_text("two words\n\n")
    command = ["count", str(tmp_path / "notes.txt"), "-o", str(tmp_path / "count.txt")]
    assert main(command) == 0 and (tmp_path / "count.txt").read_text() == "1"
    assert capsys.readouterr().out == f"{tmp_path / 'count.txt'}: 1\n"
    assert main([*command, "--words", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"count": 2}


def test_bad_input_is_refused(tmp_path: Path) -> None:
    refused(["count", tmp_path / "none", "-o", tmp_path / "a"], "none: FILE: missing")
    assert main(["count", "notes.txt"]) == main(["count", "notes.txt", "-o", "a", "--wrods"]) == 2
