"""`python -m docs.site_pages` writes docs/reference: pages made from the code, committed for clones."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from site_pages import ROOT, commands, exports, methods, plugins, python, settings

FOLDER = ROOT / "docs" / "reference"
PAGES = {
    "commands.md": commands.page,
    "formats.md": exports.page,
    "methods.md": methods.page,
    "plugins.md": plugins.page,
    "python.md": python.page,
    "settings.md": settings.page,
}
"""Page → the function that writes its Markdown."""


if __name__ == "__main__":  # into a folder, by default that of the repository
    folder = Path(*sys.argv[1:]) if sys.argv[1:] else FOLDER
    for name, page in PAGES.items():
        (folder / name).write_text(page(), encoding="utf-8")
