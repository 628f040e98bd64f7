"""Panels, series and legends of the benchmarks' plots."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mi_refgs.io.files import replace_file

DOTS_PER_INCH = 110


def grid(titles: Sequence[str], columns: int, width: float, height: float, x: str, y: str) -> tuple[Any, Any]:
    """Return a figure and an axis per title, so many in a row; width and height of a panel in inches."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    columns = min(columns, len(titles))
    lines = -(-len(titles) // columns)
    size = (columns * width, lines * height)
    figure, axes = plt.subplots(
        lines, columns, figsize=size, squeeze=False, layout="constrained", sharey=True
    )
    for ax, title in zip(axes.flat, titles, strict=False):
        ax.set_title(title, fontsize=9)
        ax.tick_params(labelsize=8)
        ax.spines[["top", "right"]].set_visible(False)
    for ax in axes.flat[len(titles) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel(x, fontsize=8)
    for ax in axes[:, 0]:
        ax.set_ylabel(y, fontsize=8)
    return figure, axes.ravel()[: len(titles)]


def series(ax: Any, x: Sequence[float], y: Sequence[float], style: str, label: str, **look: Any) -> None:
    """Draw points on two logarithmic axes; values that are None or 0 are left out."""
    points = [(a, b) for a, b in zip(x, y, strict=True) if a and b]
    if points:
        ax.plot(*zip(*points, strict=True), style, label=label, **{"markersize": 4, "linewidth": 1} | look)
        ax.set(xscale="log", yscale="log")


def plain_times(ax: Any) -> None:
    """Label a logarithmic axis of times by plain numbers."""
    from matplotlib import ticker

    ax.xaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
    ax.xaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
    ax.xaxis.set_minor_formatter(ticker.NullFormatter())


def save(figure: Any, axes: Any, path: Path, columns: int = 4) -> Path:
    """Add one legend for all panels, and write a PNG atomically."""
    import matplotlib.pyplot as plt

    named: dict[str, Any] = {}
    for ax in axes:
        named |= {label: handle for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    options = {"loc": "outside lower center", "ncols": columns, "fontsize": 8, "frameon": False}
    figure.legend(named.values(), named.keys(), **options)
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, lambda temporary: figure.savefig(temporary, dpi=DOTS_PER_INCH, format="png"))
    plt.close(figure)
    return path
