"""Docstrings as mkdocstrings displays them: comments beside fields, and arguments as lists."""

from __future__ import annotations

import re
from typing import Any

import griffe


class FieldComments(griffe.Extension):
    """Take `name: type  # remark` for a docstring, where an attribute has none of its own."""

    def on_attribute(self, *, attr: griffe.Attribute, **kwargs: Any) -> None:
        """Called by griffe for each attribute that it has read."""
        file, line = attr.filepath, attr.lineno
        in_class = isinstance(attr.parent, griffe.Class)
        if attr.docstring is not None or line is None or not in_class or isinstance(file, list):
            return
        source = attr.lines_collection[file][line - 1]
        if found := re.match(rf"\s+{re.escape(attr.name)}: [^#]*#\s*(.+)$", source):
            attr.docstring = griffe.Docstring(found[1], lineno=line, parent=attr)


class ArgumentLists(griffe.Extension):
    """Start a list item at each sentence `name: meaning` about an argument, and a paragraph at "Raises"."""

    def on_function(self, *, func: griffe.Function, **kwargs: Any) -> None:
        """Called by griffe for each function that it has read."""
        names = "|".join(re.escape(parameter.name.lstrip("*")) for parameter in func.parameters)
        if func.docstring is None or not names or "Args:" in func.docstring.value:
            return
        first, blank, rest = func.docstring.value.partition("\n\n")
        listed = re.sub(rf"(?:^|(?<=[.;\"])\s)({names}): ", r"\n\n- `\1`: ", rest, flags=re.MULTILINE)
        listed = re.sub(r"(?<=\.)\s(?=Raises [A-Z])", "\n\n", listed)
        func.docstring.value = first + blank + listed.strip()
