"""Markdown of the repository as pages of the site: links, files outside of docs/, lists."""

from __future__ import annotations

import posixpath
import re

from site_pages import ROOT

ELSEWHERE = {
    "is_it_for_me.md": "README.md",
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "scenes.md": "scenes/README.md",
}
"""Page of the site → the file of the repository that is its text."""

STANDS_FOR = {name: page for page, name in ELSEWHERE.items()} | {
    "scenes": "scenes.md",
    "variants": "reference/methods.md",
}
"""File or folder of the repository → the page that a link to it leads to."""

LINK = re.compile(r"(!?)\[([^\]\n]*(?:\n[^\]\n]+)?)\]\(([^)#\s]+)(#[^)\s]*)?\)")
FENCED = re.compile(r"(^ *```.*?^ *```[ \t]*$)", flags=re.DOTALL | re.MULTILINE)


EXTERNAL: set[str] = set()
"""Addresses that leave the site, gathered while its pages are built. Nothing fetches them."""


def pages_from_elsewhere() -> dict[str, str | bytes]:
    """The pages whose text is outside of docs/; the README answers the question of its page."""
    pages = {page: (ROOT / name).read_text(encoding="utf-8") for page, name in ELSEWHERE.items()}
    pages["is_it_for_me.md"] = pages["is_it_for_me.md"].replace("# mi_refgs\n", "# Is it for me?\n", 1)
    return {**pages}


def for_the_site(markdown: str, page: str) -> str:
    """The Markdown of a page as mkdocs wants it; code blocks stay as they are."""
    folder = posixpath.dirname(ELSEWHERE.get(page, f"docs/{page}"))
    parts = FENCED.split(markdown)  # text and code in turns
    for i in range(0, len(parts), 2):
        parts[i] = LINK.sub(lambda found: _link(found, folder, page), lists_apart(parts[i]))
    return "".join(parts)


def lists_apart(text: str) -> str:
    """Lists as Python-Markdown reads them: their insides by four spaces, not two, and after an empty line."""
    lines: list[str] = []
    in_list = True  # the block that a line belongs to began with an item
    for line in text.split("\n"):
        inner = line.lstrip(" ")
        spaces = len(line) - len(inner)
        item = re.match(r"([-*]|\d+\.) ", inner) is not None
        if not lines or not lines[-1].strip():
            in_list = item
        elif item and not in_list:
            lines.append("")
            in_list = True
        lines.append(" " * (2 * spaces if spaces in (2, 3) else spaces) + inner)
    return "\n".join(lines)


def _link(found: re.Match[str], folder: str, page: str) -> str:
    """A link relative to `folder` of the repository, as one relative to the page.

    What the site has no page of, a source file for example, becomes its text.
    """
    image, text, target, anchor = found.groups()
    if re.match(r"[a-z]+:", target):
        EXTERNAL.add(target)
        return found.group()
    path = posixpath.normpath(posixpath.join(folder, target))
    if path in STANDS_FOR:
        there = STANDS_FOR[path]
    elif path.startswith("docs/"):
        there = re.sub(r"\.ipynb$", ".md", path.removeprefix("docs/"))
    elif (ROOT / path).exists() and not image:
        return text
    else:
        return found.group()  # mkdocs says that it leads nowhere
    return f"{image}[{text}]({posixpath.relpath(there, posixpath.dirname(page) or '.')}{anchor or ''})"
