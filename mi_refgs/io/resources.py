"""Folders of the files that come with the package: `variants/*.toml` and `scenes/*.xml`."""

from __future__ import annotations

from pathlib import Path

from mi_refgs.errors import InputError

_PACKAGE = Path(__file__).resolve().parents[1]


def resource_dir(name: str) -> Path:
    """Folder `name` ("variants" or "scenes"): inside an installed package, or beside that of a checkout."""
    checkout = [_PACKAGE.parent] if (_PACKAGE.parent / "pyproject.toml").is_file() else []
    for parent in (_PACKAGE, *checkout):
        if (parent / name).is_dir():
            return parent / name
    raise InputError("the folder is missing from this installation", _PACKAGE, name, "install mi_refgs again")
