"""The list of errors is that of the commands; `python -m tests.errors` writes it anew."""

from __future__ import annotations

from tests.errors import LIST, listed


def test_errors_are_those_of_the_list() -> None:
    assert listed().splitlines() == LIST.read_text(encoding="utf-8").splitlines()
