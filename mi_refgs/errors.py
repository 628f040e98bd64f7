"""Exceptions for input that a user can fix, and values in their messages."""


class InputError(ValueError):
    """Bad input: the message names the file, the field and the remedy.

    The command line prints it as one sentence and exits with code 2.
    """


class UnknownNameError(InputError):
    """A registry has nothing of this name."""


class SceneError(InputError):
    """A scene lacks what a request needs. Where a run is read, its folder precedes the message."""


def counted(count: int, noun: str) -> str:
    """A number of things, such as 1 surfel and 2 surfels."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def abbreviated(value: object, limit: int = 80) -> str:
    """Format a value for a message: at most `limit` characters, whatever a file contains."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of more than 4,300 digits; lists in lists
        text = f"a {type(value).__name__} without end"
    return text if len(text) <= limit else f"{text[:limit]}…"
