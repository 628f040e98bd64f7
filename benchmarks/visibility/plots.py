"""The plot: error over time, and convergence with the number of rays, a column for each scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.common import figures
from benchmarks.common.select import where
from benchmarks.visibility.tradeoff import MIRROR

RAYS_ONLY = "#c77b30"
BOUNCES = ("#9ecae1", "#4292c6", "#08306b", "#6a51a3")
"""Colours of rising numbers of bounces."""
MARKERS = {False: "o", True: "^"}
"""By `dominant`."""
SHADES = ("#9ecae1", "#4292c6", "#08306b")


def middle(values: list[float]) -> float:
    """The roughness that the plot of error over time shows."""
    return values[len(values) // 2]


def plot(result: dict[str, Any], folder: Path) -> Path:
    """Write visibility_convergence.png."""
    scenes = list(result["scenes"])
    figure, axes = figures.new(2, len(scenes), 3.9, 3.2)
    roughness = middle(list(result["settings"]["roughness"]))
    for column, scene in enumerate(scenes):
        _speed(axes[0, column], result, scene, roughness)
        _convergence(axes[1, column], result, scene)
    for row in axes:
        row[0].legend(fontsize=6, framealpha=0.9, edgecolor="none", handlelength=3)
    return figures.save(figure, folder / "visibility_convergence.png")


def _speed(ax: Any, result: dict[str, Any], scene: str, roughness: float) -> None:
    from matplotlib import ticker

    rows = where(result["rows"], scene=scene, roughness=roughness, depth="full")
    timed = [row for row in rows if row["ms"] is not None]
    for bounces, dominant in dict.fromkeys((row["bounces"], row["dominant"]) for row in timed):
        found = [row for row in where(timed, bounces=bounces, dominant=dominant) if row["rays"]]
        points = [(row["ms"], row["relmse"], None if dominant else row["rays"]) for row in found]
        rank = list(result["settings"]["bounces"]).index(bounces) if bounces else 0
        colour = BOUNCES[rank % len(BOUNCES)] if bounces else RAYS_ONLY
        label = f"{bounces} bounce{'s' * (bounces > 1)}" if bounces else "rays only"
        figures.series(ax, points, MARKERS[dominant], colour, label + ", dominant" * dominant)
    none, mirror = where(timed, rays=0)[0], where(timed, method=MIRROR)[0]
    ax.plot(none["ms"], none["relmse"], "x", color="#444444", label="no occlusion")
    ax.axhline(mirror["relmse"], color="#bbbbbb", lw=0.8, zorder=0)
    ax.set(xlabel="ms per frame", title=f"{scene}, roughness {roughness:g}")
    ax.set_ylabel("relMSE at full depth")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_formatter(ticker.LogFormatterSciNotation(minor_thresholds=(1.2, 0.3)))
        axis.set_tick_params(which="minor", labelsize=6)


def _convergence(ax: Any, result: dict[str, Any], scene: str) -> None:
    values = list(result["settings"]["roughness"])
    for k, roughness in enumerate(values):
        rows = where(result["curve"], scene=scene, roughness=roughness)
        colour = SHADES[k % len(SHADES)]
        near = [(row["rays"], row["visibility_rms"], None) for row in rows]
        picture = [(row["rays"], row["to_limit"] ** 0.5, None) for row in rows[:-1]]
        figures.series(ax, near, "o-", colour, f"visibility, r = {roughness:g}", markersize=3)
        figures.series(ax, picture, "s--", colour, f"traced picture, r = {roughness:g}", markersize=3)
        ax.axhline(rows[0]["visibility_floor"], color=colour, lw=0.8, ls=":", zorder=0)
    ax.set(xlabel="rays of the lobe", ylabel="distance to the traced answer")
    ax.set_title(scene)
