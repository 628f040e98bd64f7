"""Comments beside the fields of dataclasses as their documentation, with shapes and units."""

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
