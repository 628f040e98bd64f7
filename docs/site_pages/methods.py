"""The page of the methods, from the files that define them."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from mi_refgs.methods.read import PRESETS, load
from site_pages import ROOT, table

FIRST = "ref_gaussian"
"""The first method: the others list their differences from it."""


def page() -> str:
    """Presets, a table of all methods, and a section for each with its deviations and its file."""
    files = sorted((ROOT / "variants").glob("*.toml"), key=lambda path: (path.stem != FIRST, path.stem))
    methods = {path: tomllib.loads(path.read_text(encoding="utf-8")) for path in files}
    text = [
        "# Methods and their deviations",
        "A method is a TOML file: where it shades, with which reflectance, light and visibility, over which "
        "primitive, fitted on which schedule. `refgs train --method NAME` takes one of these or a file of "
        "your own; [settings](settings.md) lists the keys, and `--set key=value` changes one for a run. "
        "Each file says how it deviates from the original.",
        "## Presets",
        "A preset scales the schedule of any method to its own number of iterations. `--preset "
        "ITERATIONS:SURFELS`, such as `1000:20000`, does so for other numbers, with at most so many surfels, "
        "three quarters of them at the start, and images of any size. With `data.crop`, images may have four "
        "times the pixels.",
        table(
            [
                "preset",
                "iterations",
                "surfels at first",
                "at most",
                "pixels of an image",
            ],
            [
                [
                    f"`{name}`",
                    f"{p.iterations:,}",
                    f"{p.surfels:,}",
                    f"{p.max_surfels:,}",
                    f"{p.pixels:,}",
                ]
                for name, p in PRESETS.items()
            ],
        ),
        "## All methods",
        table(
            ["file", "method", "extends", "`--for`"],
            [
                [
                    f"[`{path.stem}`](#{path.stem})",
                    about(method, "name"),
                    f"`{method['extends']}`" if "extends" in method else "",
                    f"`{about(method, 'purpose')}`" if about(method, "purpose") else "",
                ]
                for path, method in methods.items()
            ],
        ),
        *(section(path, method) for path, method in methods.items()),
        "## Settings of the paper's data sets",
        "What the released code of Ref-Gaussian is called with for each scene, as methods that extend "
        "`ref_gaussian_paper`: " + ", ".join(f"`{name}`" for name in paper_settings()) + ".",
    ]
    return "\n\n".join(text) + "\n"


def about(method: dict[str, Any], key: str) -> Any:
    """A value of the `[about]` table, empty where it is absent."""
    return method.get("about", {}).get(key, "")


def section(path: Path, method: dict[str, Any]) -> str:
    """A method: its remark, paper and deviations, and what it resolves to."""
    source = path.read_text(encoding="utf-8").rstrip()
    remark = [line[1:].strip() for line in source.splitlines() if line.startswith("#")]
    resolved = load(path.stem, "standard")
    stages = "; then ".join(
        f"{stage.shading.reflectance} at {stage.shading.at}s" for _, stage in resolved.stages()
    )
    facts = [
        f"Splats {resolved.surfels.primitive}s with {', '.join(resolved.surfels.attributes)}; "
        f"shades {stages}."
    ]
    lines = [
        f"### {path.stem}",
        f"**{about(method, 'name')}** ([file](../../variants/{path.name}))",
        " ".join(remark[: remark.index("")] if "" in remark else remark),
        about(method, "paper"),
        *facts,
        "\n".join(["How it deviates:", "", *(f"- {text}" for text in about(method, "deviations"))]),
    ]
    return "\n\n".join(line for line in lines if line)


def paper_settings() -> list[str]:
    """Names of the methods of scenes/paper, as `--method` takes them."""
    return [
        str(path.relative_to(ROOT / "scenes").with_suffix(""))
        for path in sorted((ROOT / "scenes" / "paper").glob("*/*.toml"))
    ]
