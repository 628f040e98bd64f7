"""How the benchmarks' plots look."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.io.files import replace_file

COLOURS = {
    "path": "#444444",
    "monte_carlo": "#c77b30",
    "split_sum": "#1f77b4",
    "option": "#2a9d5c",
    "floor": "#bbbbbb",
}
DOTS_PER_INCH = 110


def new(rows: int, columns: int, width: float, height: float, **options: Any) -> tuple[Any, Any]:
    """Figure and (rows, columns) axes; width and height of one panel in inches."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        rows,
        columns,
        figsize=(columns * width, rows * height),
        squeeze=False,
        layout="constrained",
        **options,
    )
    for ax in axes.flat:
        ax.tick_params(labelsize=8)
        ax.spines[["top", "right"]].set_visible(False)
    return figure, axes


def grid(titles: Sequence[str], columns: int, width: float, height: float, x: str, y: str) -> tuple[Any, Any]:
    """Figure and an axis for each title, in rows of so many; axes are shared, labels are at the rim."""
    columns = min(columns, len(titles))
    figure, axes = new(-(-len(titles) // columns), columns, width, height, sharex=True, sharey=True)
    for ax, title in zip(axes.flat, titles, strict=False):
        ax.set_title(title, fontsize=9)
    for ax in axes.flat[len(titles) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel(x, fontsize=8)
    for ax in axes[:, 0]:
        ax.set_ylabel(y, fontsize=8)
    return figure, axes.ravel()[: len(titles)]


def legend(figure: Any, axes: Any, title: str, columns: int) -> None:
    """One legend for all panels, and the title."""
    named: dict[str, Any] = {}
    for ax in axes:
        named |= {label: handle for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    options = {"loc": "outside lower center", "ncols": columns, "fontsize": 8, "frameon": False}
    figure.legend(named.values(), named.keys(), **options)
    figure.suptitle(title, fontsize=10)


def series(
    ax: Any,
    points: Sequence[tuple[float, float, Any]],
    style: str,
    colour: str,
    label: str | None,
    **look: Any,
) -> None:
    """Points (x, y, text) on two logarithmic axes, each with its text beside it unless that is None."""
    if not points:
        return
    x, y, texts = zip(*points, strict=True)
    ax.plot(x, y, style, color=colour, label=label, **{"markersize": 4, "linewidth": 1} | look)
    ax.set(xscale="log", yscale="log")
    for place, text in zip(zip(x, y, strict=True), texts, strict=True):
        if text is not None:
            ax.annotate(f"{text}", place, xytext=(3, 3), textcoords="offset points", fontsize=6)


def save(figure: Any, path: Path) -> Path:
    """Write a PNG, whole or not at all."""
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, lambda temporary: figure.savefig(temporary, dpi=DOTS_PER_INCH, format="png"))
    plt.close(figure)
    return path


def heat(
    ax: Any, values: np.ndarray, texts: list[list[str]], rows: list[str], columns: list[str], **scale: Any
) -> Any:
    """Heat map with a number in each cell; NaN stays white."""
    image = ax.imshow(values, aspect="auto", **scale)
    norm = image.norm
    for i, line in enumerate(texts):
        for j, text in enumerate(line):
            if np.isfinite(values[i, j]):
                red, green, blue, _ = image.cmap(norm(values[i, j]))
                dark = 0.3 * red + 0.59 * green + 0.11 * blue < 0.5
                ax.text(j, i, text, ha="center", va="center", fontsize=7, color="white" if dark else "black")
    ax.set_xticks(range(len(columns)), columns)
    ax.set_yticks(range(len(rows)), rows)
    ax.spines[:].set_visible(False)
    ax.tick_params(length=0)
    return image
