"""The page of the Mitsuba plugins, from the docstrings of their classes.

The docstrings are reStructuredText with Mitsuba's directives; what they use of it is translated here.
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap

from mi_refgs.plugins import PLUGINS
from site_pages import ROOT, table


def page() -> str:
    """One section a plugin."""
    text = [
        "# Plugins",
        "After `import mi_refgs`, Mitsuba has these plugins, in scene files and in dictionaries.",
    ]
    for name, (register, module) in PLUGINS.items():
        kind = register.removeprefix("register_")
        text += [f"## {name}", f"Kind: {kind}.", markdown(docstring(module))]
    return "\n\n".join(text) + "\n"


def docstring(module: str) -> str:
    """The docstring of the class that a plugin module defines, read without importing the module."""
    tree = ast.parse((ROOT / (module.replace(".", "/") + ".py")).read_text(encoding="utf-8"))
    found = [ast.get_docstring(node) for node in tree.body if isinstance(node, ast.ClassDef)]
    [text] = [text for text in found if text and "pluginparameters" in text]
    return text


def markdown(text: str) -> str:
    """A plugin's docstring as Markdown."""
    written = []
    for block in re.split(r"\n(?=\S)", inspect.cleandoc(text)):
        if block.startswith(".. pluginparameters::"):
            written.append(parameters(block))
        elif block.startswith(".. math::"):
            written.append("```text\n" + textwrap.dedent(block.partition("\n")[2]).strip() + "\n```")
        else:
            written.append(inline(block))
    return "\n".join(written)


def inline(text: str) -> str:
    """Roles and literals of a paragraph."""
    return re.sub(r"``([^`]+)``", r"`\1`", re.sub(r":\w+:`([^`]+)`", r"`\1`", text))


def parameters(block: str) -> str:
    """The table of a `pluginparameters` directive, from its list of `name (type): meaning`."""
    rows = []
    for entry in re.split(r"\n *\* ", block)[1:]:
        found = re.fullmatch(r"(.*?) \((.*?)\): (.*)", " ".join(entry.split()))
        assert found, entry
        name, kind, meaning = found.groups()
        names, _, other = name.partition(" *")
        shown = ", ".join(f"`{part.strip()}`" for part in names.split(",")) + (f" *{other}" if other else "")
        rows.append([shown, kind, inline(meaning)])
    return "\n" + table(["parameter", "type", "meaning"], rows) + "\n"
