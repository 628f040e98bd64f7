"""What `mkdocs` runs while it builds the site: pages of notebooks, and of files outside of docs/."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mkdocs.structure.files import File
from site_pages import links, notebooks


def on_config(config: Any) -> Any:
    """Put the notebooks below Use, as Tutorials."""
    [use] = [pages["Use"] for pages in config.nav if "Use" in pages]
    folder = Path(config.docs_dir)
    found = sorted(path.relative_to(folder) for path in (folder / "tutorials").glob("*.ipynb"))
    use.append({"Tutorials": [path.with_suffix(".md").as_posix() for path in found]})
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the pages of files elsewhere in the repository and of notebooks."""
    made = links.pages_from_elsewhere()
    for file in [file for file in files if file.src_uri.endswith(".ipynb")]:
        files.remove(file)
        made |= notebooks.pages(file.src_uri)
    for name, content in made.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Lead links that leave docs/ to pages of the site, and indent lists as Python-Markdown wants them."""
    return links.for_the_site(markdown, page.file.src_uri)


def on_post_build(config: Any) -> None:
    """List the links that leave the site, for a user or a program to follow."""
    Path(config.site_dir, "external_links.txt").write_text("\n".join(sorted(links.EXTERNAL)) + "\n")
