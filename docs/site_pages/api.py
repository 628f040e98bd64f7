"""The page of the Python interface: the public names of `mi_refgs`, by the package that defines them."""

from __future__ import annotations

import ast

import mi_refgs
from site_pages import ROOT

FIRST = ("reconstruct", "reconstruction")
"""Names that most readers look for: listed first."""


def page() -> str:
    """A section for each package with public names; mkdocstrings writes the names themselves."""
    text = [
        "# Python",
        "`import mi_refgs` registers the [plugins](plugins.md); it should precede `import mitsuba`, so "
        "that it can choose the LLVM that Dr.Jit loads. These names are imported from `mi_refgs` itself, and "
        "each is loaded when it is first asked for. Tables have shapes (N, C), images (H, W, C); lengths "
        "are in the units of the scene.",
    ]
    for package, names in by_package().items():
        text.append(f"## {package}\n\n{summary(package)}")
        for name, module in names:
            text.append(f"::: {module}\n    options:\n      heading: {name}\n      toc_label: {name}")
    return "\n\n".join(text) + "\n"


def by_package() -> dict[str, list[tuple[str, str]]]:
    """First name below `mi_refgs` → public names, and where each is defined."""
    found: dict[str, list[tuple[str, str]]] = {}
    for name in mi_refgs.__all__:
        value = getattr(mi_refgs, name)
        found.setdefault(value.__module__.split(".")[1], []).append(
            (name, f"{value.__module__}.{value.__qualname__}")
        )
    return dict(sorted(found.items(), key=lambda item: (item[0] not in FIRST, item[0])))


def summary(package: str) -> str:
    """The first paragraph of the docstring of a package or module."""
    path = ROOT / "mi_refgs" / package
    source = (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").split("\n\n")[0]
