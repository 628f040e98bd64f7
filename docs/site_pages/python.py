"""The page of the Python interface: the public names of `mi_refgs`, by the package that defines them."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

import mi_refgs
from site_pages import ROOT, table

FIRST = ("reconstruct", "reconstruction")
"""Names that most readers look for: listed first."""
WIDTH = 100
"""Characters of a signature on one line."""


def page() -> str:
    """A section for each package with public names."""
    text = [
        "# Python",
        "`import mi_refgs` registers the [plugins](plugins.md); it should precede `import mitsuba`, so "
        "that it can choose the LLVM that Dr.Jit loads. These names are imported from `mi_refgs` itself, and "
        "each is loaded when it is first asked for. Tables have shapes (N, C), images (H, W, C); lengths "
        "are in the units of the scene.",
    ]
    for package, names in by_package().items():
        text.append(f"## {package}\n\n{summary(package)}")
        for name in names:
            text += [f"### {name}", *entry(name, getattr(mi_refgs, name))]
    return "\n\n".join(text) + "\n"


def by_package() -> dict[str, list[str]]:
    """First name below `mi_refgs` → public names."""
    found: dict[str, list[str]] = {}
    for name in mi_refgs.__all__:
        value = getattr(mi_refgs, name)
        module = value.__name__ if inspect.ismodule(value) else value.__module__
        found.setdefault(module.split(".")[1], []).append(name)
    return dict(sorted(found.items(), key=lambda item: (item[0] not in FIRST, item[0])))


def summary(package: str) -> str:
    """The first paragraph of the docstring of a package or module."""
    path = ROOT / "mi_refgs" / package
    source = (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").split("\n\n")[0]


def entry(name: str, value: Any) -> Iterator[str]:
    """A public name: its signature, docstring, fields, and documented methods."""
    source = textwrap.dedent(inspect.getsource(value))
    if inspect.ismodule(value):
        yield inspect.getdoc(value) or ""
        for one in ast.parse(source).body:
            if isinstance(one, ast.FunctionDef) and not one.name.startswith("_"):
                yield from _function(f"{name}.{one.name}", one)
        return
    [node] = ast.parse(source).body
    if isinstance(node, ast.FunctionDef):
        yield from _function(name, node)
        return
    assert isinstance(node, ast.ClassDef), name
    bases = ", ".join(base for base in map(ast.unparse, node.bases) if base != "Any")
    yield f"```py\nclass {name}{f'({bases})' if bases else ''}\n```"
    yield _text(ast.get_docstring(node))
    if fields := list(_fields(node, source.splitlines())):
        yield table(["field", "type", "default", "meaning"], fields)
    for inner in node.body:
        if isinstance(inner, ast.FunctionDef) and ast.get_docstring(inner) and inner.name.strip("_"):
            if not inner.name.startswith("_"):
                yield from _function(f"{name}.{inner.name}", inner)


def _function(name: str, node: ast.FunctionDef) -> Iterator[str]:
    for part in ast.walk(node):  # annotations of names that the module defines later are strings
        for field in {"annotation", "returns"} & {*part._fields}:
            if isinstance(quoted := getattr(part, field), ast.Constant) and isinstance(quoted.value, str):
                setattr(part, field, ast.parse(quoted.value, mode="eval").body)
    marks = [ast.unparse(mark) for mark in node.decorator_list]
    result = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    if "property" in marks or "cached_property" in marks:
        yield f"```py\n{name}{result.replace(' ->', ':')}\n```"
    else:
        arguments = ast.unparse(node.args).removeprefix("self").removeprefix(", ")
        line = f"{name}({arguments}){result}"
        if len(line) > WIDTH:  # an argument a line
            parts = re.split(r", (?![^\[(]*[\])])", arguments)
            line = f"{name}(\n    " + ",\n    ".join(parts) + f",\n){result}"
        yield f"```py\n{line}\n```"
    names = [one.arg for one in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
    yield _text(ast.get_docstring(node), names)


def _text(docstring: str | None, arguments: Sequence[str] = ()) -> str:
    """A docstring as Markdown: `name: meaning` of an argument is an item, and "Raises" starts a paragraph."""
    first, blank, rest = (docstring or "").partition("\n\n")
    for name in arguments:
        rest = re.sub(rf"(?:^|(?<=[.;\"])\s)`?{name}`?:\s", f"\n\n- `{name}`: ", rest, flags=re.MULTILINE)
    rest = re.sub(r"(?<=\.)\s(?=Raises [A-Z])", "\n\n", rest)
    return first + blank + re.sub(r"\n{3,}", "\n\n", rest).strip()


def _fields(node: ast.ClassDef, source: list[str]) -> Iterator[list[str]]:
    """Name, type, default and remark of the annotated names in a class; the remark is beside or below."""
    for inner, below in zip(node.body, [*node.body[1:], None], strict=True):
        if not isinstance(inner, ast.AnnAssign) or not isinstance(inner.target, ast.Name):
            continue
        if inner.target.id.startswith("_"):
            continue
        _, _, remark = source[(inner.end_lineno or 1) - 1][inner.end_col_offset :].partition("# ")
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            remark = str(below.value.value)
        kind = inner.annotation
        while isinstance(kind, ast.Subscript) and ast.unparse(kind.value) in ("Annotated", "ClassVar"):
            kind = kind.slice.elts[0] if isinstance(kind.slice, ast.Tuple) else kind.slice
        default = ast.unparse(inner.value) if inner.value is not None else ""
        yield [f"`{inner.target.id}`", f"`{ast.unparse(kind)}`", f"`{default}`" if default else "", remark]
