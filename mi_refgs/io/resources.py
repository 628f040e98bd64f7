"""Folders of the files that come with the package: `variants/*.toml` and `scenes/*.xml`."""

from __future__ import annotations

from pathlib import Path

from mi_refgs.errors import InputError

_PACKAGE = Path(__file__).resolve().parents[1]


def resource_dir(name: str) -> Path:
    """Folder of the resource `name` ("variants" or "scenes"), in an installed wheel as in a checkout.

    A wheel has these folders inside the package; a checkout has them beside it. Raises InputError if neither
    has the folder.
    """
    checkout = [_PACKAGE.parent] if (_PACKAGE.parent / "pyproject.toml").is_file() else []
    for parent in (_PACKAGE, *checkout):
        if (parent / name).is_dir():
            return parent / name
    raise InputError("the folder is missing from this installation", _PACKAGE, name, "install mi_refgs again")
