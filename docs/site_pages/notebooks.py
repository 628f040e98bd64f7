"""Notebooks as pages: their text, their code, and the outputs that they were saved with."""

from __future__ import annotations

import base64
import json
import posixpath
from typing import Any

from site_pages import ROOT

PICTURES = {"image/png": "png", "image/jpeg": "jpg"}
"""Types of outputs that become files beside the page."""


def pages(name: str) -> dict[str, str | bytes]:
    """The page of a notebook below docs/, and its images, by their paths in the site."""
    notebook = json.loads((ROOT / "docs" / name).read_text(encoding="utf-8"))
    stem = name.removesuffix(".ipynb")
    made: dict[str, str | bytes] = {}
    text = []
    for number, cell in enumerate(notebook["cells"]):
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            text.append(source)
        elif cell["cell_type"] == "code":
            text.append(f"```python\n{source.rstrip()}\n```")
            for index, output in enumerate(cell["outputs"]):
                text.append(_output(output, f"{stem}_{number}_{index}", made))
    place = posixpath.basename(name)
    text.insert(
        1, f"*This page is the notebook `docs/{posixpath.dirname(name)}/{place}`, as it was last run.*"
    )
    made[f"{stem}.md"] = "\n\n".join(part for part in text if part) + "\n"
    return made


def _output(output: dict[str, Any], stem: str, made: dict[str, str | bytes]) -> str:
    """One output as Markdown; an image is added to the generated files."""
    if output["output_type"] == "stream":
        return _verbatim(output["text"]) if output["name"] == "stdout" else ""
    data = output.get("data", {})
    for kind, suffix in PICTURES.items():
        if kind in data:
            made[f"{stem}.{suffix}"] = base64.b64decode("".join(data[kind]))
            return f"![Output of the code above]({posixpath.basename(stem)}.{suffix})"
    return _verbatim(data["text/plain"]) if "text/plain" in data else ""


def _verbatim(lines: str | list[str]) -> str:
    return "```text\n" + "".join(lines).rstrip() + "\n```"
