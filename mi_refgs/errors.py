"""Exceptions for input that a user can fix, and values in their messages."""

import contextlib
import importlib
import math
from collections.abc import Iterator
from typing import Any, Self


class InputError(ValueError):
    """Bad input: what is wrong, the file and the field where it is, and a remedy.

    `str` is the sentence "file: field: what; remedy", which the command line prints before exit code 2."""

    def __init__(
        self, what: str, file: object = None, field: str | None = None, remedy: str | None = None
    ) -> None:
        """`file` is a path, or the name of what was given instead, such as an option or an object."""
        super().__init__(what)
        self.what, self.file, self.field, self.remedy = what, file, field, remedy

    @property
    def advice(self) -> str:
        """What is wrong and the remedy, without the place."""
        return self.what if self.remedy is None else f"{self.what}; {self.remedy}"

    def __str__(self) -> str:
        return ": ".join(_given(self.file, self.field, self.advice))

    def at(self, file: object = None, field: str | None = None) -> Self:
        """A copy whose place is inside `file` and `field`, which precede the place that it had."""
        within = ": ".join(_given(field, None if self.file == file else self.file, self.field))
        return type(self)(self.what, file, within or None, self.remedy)


def _given(*parts: object) -> list[str]:
    return [str(part) for part in parts if part is not None]


class UnknownNameError(InputError):
    """A registry has nothing of this name."""


@contextlib.contextmanager
def within(file: object = None, field: str | None = None) -> Iterator[None]:
    """Let every InputError inside say that its place is in `file` and `field`."""
    try:
        yield
    except InputError as error:
        raise error.at(file, field) from error


def require_package(name: str, extra: str, file: object) -> Any:
    """Import a package that an extra installs; raises InputError that says how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        remedy = f'pip install "mi_refgs[{extra}]"'
        raise InputError(f"{name} is not installed", file, remedy=remedy) from None


def require_between(value: float, option: str, least: float, most: float = math.inf) -> None:
    """Raise InputError for a number that is not in least … most."""
    if not least <= value <= most:
        remedy = f"give a number from {least}" if most == math.inf else f"give {least} to {most}"
        raise InputError(f"{value} is out of range", option, remedy=remedy)


def counted(count: int, noun: str) -> str:
    """A number of things, such as 1 surfel and 2 surfels."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def abbreviated(value: object) -> str:
    """Format a value for a message: at most 80 characters, whatever a file contains."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of more than 4,300 digits; lists in lists
        text = f"a {type(value).__name__} without end"
    return text if len(text) <= 80 else f"{text[:80]}…"
