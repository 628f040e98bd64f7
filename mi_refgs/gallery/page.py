"""README.md of a gallery: its pictures, their scores, and the commands that repeat them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mi_refgs import __version__
from mi_refgs.gallery.exhibits import Exhibit

TURNTABLE, DECOMPOSITION, RELIT, EDITS = "turntable.webp", "decomposition.webp", "relit.webp", "edits.webp"
"""Pictures of an exhibit, in its folder."""
HEAD = """\
| scene | PSNR | normals | albedo | roughness error | metallic error | relit |
|---|---|---|---|---|---|---|"""


def page(settings: Mapping[str, Any], exhibits: Mapping[str, Exhibit], found: Mapping[str, Any]) -> str:
    """The Markdown, of the settings of the gallery and the scores of each exhibit."""
    command = " ".join(
        f"--{name} {' '.join(value) if isinstance(value, list) else value}"
        for name, value in settings.items()
        if value
    )
    text = [
        "# Gallery",
        f"Made by `refgs gallery -o docs/gallery {command}`, version {__version__}: scenes of the package, "
        f"path-traced from {settings['views']} sides at {settings['size']}², fitted with the method for "
        f"relighting at the preset `{settings['preset']}`, and rendered by the fit. No view shown is "
        "one that it was fitted to.",
        "\n".join([HEAD, *(_row(name, found[name]) for name in exhibits)]),
        "Normal errors are means over the foreground. Albedo and relit pictures are compared after one scale "
        "a channel, which no picture can tell.",
    ]
    for name, exhibit in exhibits.items():
        shown = "; ".join(f"*{title}*: `{_words(edit)}`" for title, edit in exhibit.edits.items())
        text += [
            f"## {name}",
            f"{exhibit.caption} [The scene](../../scenes/README.md).",
            f"![{name} turning, under the light of the pictures and under another]({name}/{TURNTABLE})",
            "Left under the light that was recovered, right under one that the fit has not seen.",
            f"![Pictures and materials of {name} beside the truth]({name}/{DECOMPOSITION})",
            f"![{name} under another light, beside the path tracer]({name}/{RELIT})",
            f"![{name} edited]({name}/{EDITS})",
            f"Edits: {shown}.",
        ]
    return "\n\n".join(text) + "\n"


def _row(name: str, scores: Mapping[str, Any]) -> str:
    cells = [
        f"[{name}](#{name})",
        _number(scores["psnr"], "{:.1f} dB"),
        _number(scores["normal_mae_deg"], "{:.1f}°"),
        _number(scores["albedo_psnr"], "{:.1f} dB"),
        _number(scores["roughness_mae"], "{:.2f}"),
        _number(scores["metallic_mae"], "{:.2f}"),
        _number(scores["relit_psnr"], "{:.1f} dB"),
    ]
    return f"| {' | '.join(cells)} |"


def _number(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)


def _words(edit: Mapping[str, Any]) -> str:
    """An edit as options of `refgs edit`."""
    words = ["--set " + " ".join(edit["set"])] if "set" in edit else []
    words += [f'--where "{edit["where"]}"'] if "where" in edit else []
    for name, value in edit.items():
        if name not in ("set", "where"):
            words.append(f"--{name}" + ("" if value is True else f" {' '.join(map(str, value))}"))
    return " ".join(words)
