"""The page of the formats of other programs, from their declarations and docstrings."""

import inspect

from mi_refgs.formats import FORMATS
from mi_refgs.formats.format import Format
from site_pages import table


def page() -> str:
    """A table of all formats and a section for each."""
    text = [
        "# Formats of other programs",
        "`refgs export RUN --to NAME -o PATH` writes them, several at once with commas, and so does "
        "`Reconstruction.export(NAME, PATH)`. [Files and formats](../formats.md) describes what is ours.",
        table(
            ["format", "writes", "what it is", "extra"],
            [
                [
                    f"[`{name}`](#{name})",
                    form.suffix or "a folder",
                    form.summary,
                    f"`{form.extra}`" if form.extra else "",
                ]
                for name, form in FORMATS.items()
            ],
        ),
        *(section(name, form) for name, form in FORMATS.items()),
    ]
    return "\n\n".join(text) + "\n"


def section(name: str, form: Format) -> str:
    """A format: its description and its options."""
    text = [f"## {name}", inspect.getdoc(form.writer) or form.summary]
    if form.options:
        rows = [
            [f"`--{o.name.replace('_', '-')}`", "off" if o.default is False else f"`{o.default}`", o.help]
            for o in form.options
        ]
        text.append(table(["option", "default", "meaning"], rows))
    return "\n\n".join(text)
