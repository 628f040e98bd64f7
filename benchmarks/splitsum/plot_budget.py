"""The picture of the error budgets."""

from __future__ import annotations

from typing import Any

from benchmarks.common import figures
from benchmarks.common.select import where
from benchmarks.splitsum import select


def budget(result: dict[str, Any]) -> Any:
    """relMSE of each approximation alone over roughness, one panel a shape and light."""
    budgets = result["budgets"]
    if not budgets:
        return None
    shapes = list(dict.fromkeys(row["shape"] for row in budgets))
    names = select.lights(result)
    metallic, height = max(row["metallic"] for row in budgets), max(row["height"] for row in budgets)
    figure, axes = figures.new(len(shapes), len(names), 2.7, 2.2, sharex=True, sharey=True)
    parts = list(dict.fromkeys(part["name"] for row in budgets for part in row["parts"]))
    colours = dict(zip(parts, (f"C{k}" for k in range(len(parts))), strict=True))
    for line, shape in zip(axes, shapes, strict=True):
        for ax, light in zip(line, names, strict=True):
            cases = where(budgets, shape=shape, light=light, metallic=metallic, height=height)
            x = [row["roughness"] for row in cases]
            ax.plot(x, [row["total"] for row in cases], color="black", linewidth=2, label="whole error")
            for name in parts:
                y = [part["relmse"] for row in cases for part in row["parts"] if part["name"] == name]
                if len(y) == len(x):
                    ax.plot(x, y, "o-", markersize=2.5, linewidth=1, color=colours[name], label=name)
            ax.plot(x, [row["floor"] for row in cases], ":", color="grey", linewidth=1, label="noise")
            ax.set_yscale("log")
            ax.set_title(f"{shape}, {light}", fontsize=9)
        line[0].set_ylabel("relMSE", fontsize=8)
    axes.flat[0].set_ylim(1e-8, 10)
    for ax in axes[-1]:
        ax.set_xlabel("roughness", fontsize=8)
    handles: dict[str, Any] = {}
    for ax in axes.flat:
        handles |= {label: handle for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=5, fontsize=8, frameon=False
    )
    figure.suptitle(
        f"Error of each approximation alone, {height} rows of light, metallic {metallic:g}", fontsize=10
    )
    return figure
