"""Tables and plot of the page: settings by CPU time and PSNR, their Pareto front, verdicts on presets."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.common import figures
from benchmarks.common.report import Row, number, table, where
from mi_refgs.compare.table import NOTHING, Statistic

CLEAR = 0.5
"""dB: a smaller difference of two settings is only clear with at least two seeds of both."""


@dataclass(frozen=True)
class Setting:
    """Cells of a data set that differ in their seed only."""

    rows: Sequence[Row]

    def mean(self, name: str) -> Statistic | None:
        """Return a number over the seeds; None where it is not defined."""
        values = [row[name] for row in self.rows]
        return None if None in values else Statistic.of(values)

    @property
    def seconds(self) -> float:
        """Mean CPU seconds."""
        return Statistic.of([row["cpu_seconds"] for row in self.rows]).mean

    @property
    def psnr(self) -> float:
        """Mean PSNR, dB."""
        return Statistic.of([row["psnr"] for row in self.rows]).mean

    @property
    def preset(self) -> str | None:
        """Name of the shipped preset, if it is one."""
        name: str | None = self.rows[0]["preset"]
        return name

    @property
    def name(self) -> str:
        """Method and preset, or method, iterations and largest number of surfels."""
        row = self.rows[0]
        length = f"{row['iterations']:,} × {row['max_surfels']:,}" if self.preset is None else self.preset
        return f"{row['method']}, {length}"

    def dominates(self, other: Setting) -> bool:
        """Whether this one costs no more CPU time and reaches no lower PSNR, and is better in one of them."""
        better = self.seconds < other.seconds or self.psnr > other.psnr
        return better and self.seconds <= other.seconds and self.psnr >= other.psnr

    def spread(self) -> float | None:
        """Return the standard deviation of the PSNR over seeds, dB; None for one seed."""
        return Statistic.of([row["psnr"] for row in self.rows]).sd


KEY = ("method", "preset", "iterations", "max_surfels", "downscale", "samples")
"""Columns that are equal in all cells of a setting."""


def settings_of(rows: Sequence[Row], data: str) -> list[Setting]:
    """Return the settings of a data set in the order of their CPU time."""
    found = where(rows, data=data)
    keys = dict.fromkeys(tuple(row[name] for name in KEY) for row in found)
    groups = [where(found, **dict(zip(KEY, key, strict=True))) for key in keys]
    return sorted((Setting(group) for group in groups), key=lambda setting: setting.seconds)


def front(settings: Sequence[Setting]) -> list[Setting]:
    """Return the settings that no other one dominates, in the order of their CPU time."""
    kept = (one for one in settings if not any(other.dominates(one) for other in settings))
    return sorted(kept, key=lambda setting: setting.seconds)


def is_clear(first: Setting, second: Setting) -> bool:
    """Whether the difference in PSNR is at least CLEAR, or larger than the spread over seeds of both."""
    difference, spreads = abs(first.psnr - second.psnr), (first.spread(), second.spread())
    return difference >= CLEAR or all(sd is not None and difference > sd for sd in spreads)


@dataclass(frozen=True)
class Verdict:
    """Where a preset lies relative to the front of all other settings of its data set."""

    preset: Setting
    rival: Setting | None  # best PSNR among the others that cost no more CPU time; None: none is as cheap
    quicker: Setting | None  # least CPU time among the others that reach its PSNR; None: none does

    @property
    def margin(self) -> float | None:
        """PSNR above the rival, dB: negative by how much the preset misses the front."""
        return None if self.rival is None else self.preset.psnr - self.rival.psnr

    @property
    def is_on_front(self) -> bool:
        """Whether no other setting dominates the preset."""
        return self.rival is None or not self.rival.dominates(self.preset)

    def text(self) -> str:
        """Return the verdict in words."""
        if self.rival is None or (margin := self.margin) is None:
            return "on the front: no other setting is as cheap"
        doubt = "" if is_clear(self.preset, self.rival) else ", a difference that is not clear"
        if self.is_on_front:
            return f"on the front, {margin:.2f} dB above {self.rival.name}{doubt}"
        found = f"misses the front by {-margin:.2f} dB ({self.rival.name}{doubt})"
        if self.quicker is not None:
            ratio = self.preset.seconds / self.quicker.seconds
            found += f"; {self.quicker.name} reaches its PSNR in 1/{ratio:.1f} of the CPU time"
        return found


def verdicts(settings: Sequence[Setting]) -> list[Verdict]:
    """Return the verdict on every shipped preset among the settings of a data set."""
    found = []
    for preset in (one for one in settings if one.preset is not None):
        others = [one for one in settings if one is not preset]
        cheap = [one for one in others if one.seconds <= preset.seconds]
        good = [one for one in others if one.psnr >= preset.psnr]
        rival = max(cheap, key=lambda one: one.psnr, default=None)
        found.append(Verdict(preset, rival, min(good, key=lambda one: one.seconds, default=None)))
    return found


# ---------- Markdown ----------


def page(result: dict[str, Any]) -> dict[str, Any]:
    """By name in page.md."""
    rows, names = result["rows"], list(dict.fromkeys(row["data"] for row in result["rows"]))
    by_name = {name: settings_of(rows, name) for name in names}
    fewest = min(len(setting.rows) for settings in by_name.values() for setting in settings)
    judged = [(name, verdict) for name in names for verdict in verdicts(by_name[name])]
    on_front = [one for _, one in judged if one.is_on_front]
    return {
        "verdict": f"{len(on_front)} of {len(judged)} fits with a preset are on the Pareto front",
        "cpu_range": f"{number(min(row['cpu_seconds'] for row in rows), 2)} to "
        f"{number(max(row['cpu_seconds'] for row in rows), 2)} CPU seconds",
        "seeds": _seeds(fewest),
        "presets": table(
            ["data", "preset", "images fitted", "images scored", "CPU s", "PSNR, dB", "verdict"],
            [[name, *_preset(verdict)] for name, verdict in judged],
        ),
        "tables": "\n\n".join(_table(name, settings) for name, settings in by_name.items()),
        "cells": len(rows),
        "failed": _failed(result["failed"]),
        "code_version": f"{result['version']} (sources {result['code'][:12]})",
        "clear": CLEAR,
    }


def _seeds(fewest: int) -> str:
    """Sentence about what differences mean."""
    if fewest < 2:
        return (
            f"Some settings were run with one seed only: a difference below {CLEAR} dB is then not clear, "
            "and which of the two settings is on the front may be chance."
        )
    return (
        f"Every setting was run with at least {fewest} seeds. A difference below {CLEAR} dB is clear if "
        "it is larger than the standard deviation over seeds of both settings."
    )


def _pixels(rows: Sequence[Row], width: str, height: str) -> str:
    return f"{rows[0][width]} × {rows[0][height]}"


def _preset(verdict: Verdict) -> list[str]:
    setting = verdict.preset
    return [
        setting.name,
        _pixels(setting.rows, "width", "height"),
        _pixels(setting.rows, "full_width", "full_height"),
        number(setting.seconds),
        f"{setting.psnr:.2f}",
        verdict.text(),
    ]


FORMS = {
    "surfels": "{:,.0f}",
    "cpu_seconds": "{:.0f}",
    "wall_seconds": "{:.0f}",
    "peak_bytes": "{:.2f}",
    "psnr": "{:.2f}",
    "ssim": "{:.4f}",
    "normal_mae_deg": "{:.1f}",
}
"""Columns of numbers, with their formats."""
HEAD = [
    *("method, iterations × surfels", "images fitted", "samples", "seeds"),
    *("surfels", "CPU s", "wall s", "peak GB", "PSNR, dB", "SSIM", "normal error, °", "front"),
]


def _table(name: str, settings: Sequence[Setting]) -> str:
    row, best = settings[0].rows[0], front(settings)
    lines = [
        [
            setting.name,
            _pixels(setting.rows, "width", "height"),
            setting.rows[0]["samples"],
            len(setting.rows),
            *(_cell(setting, key, form) for key, form in FORMS.items()),
            "●" if setting in best else "",
        ]
        for setting in settings
    ]
    size = _pixels(settings[0].rows, "full_width", "full_height")
    views = f"{row['validation_views']} validation views of {size} pixels, {row['views']} fitted views"
    return f"### {name} ({views})\n\n{table(HEAD, lines)}"


def _cell(setting: Setting, key: str, form: str) -> str:
    """Mean ± standard deviation over seeds."""
    statistic, unit = setting.mean(key), 1e9 if key == "peak_bytes" else 1.0
    if statistic is None:
        return NOTHING
    return " ± ".join(form.format(x / unit) for x in (statistic.mean, statistic.sd) if x is not None)


def _failed(failed: Iterable[Row]) -> str:
    lines = [f"- {row['cell']}: {row['failed']}" for row in failed]
    return "\n".join(["Cells without a result:", "", *lines]) if lines else "Every cell has a result."


# ---------- Plot ----------

MARKERS = "osD^vP"


def plot(result: dict[str, Any], folder: Path) -> Path:
    """Write frontier.png: one panel per data set, one line per setting over its iterations."""
    from matplotlib import ticker

    names = list(dict.fromkeys(row["data"] for row in result["rows"]))
    columns = min(len(names), 3)
    figure, axes = figures.new(-(-len(names) // columns), columns, 4.2, 3.4)
    for ax in axes.flat[len(names) :]:
        ax.set_visible(False)
    lines = dict.fromkeys(_line(row) for row in result["rows"] if row["preset"] is None)
    looks = {line: (f"C{i % 10}", MARKERS[i // 10 % len(MARKERS)]) for i, line in enumerate(lines)}
    for ax, name in zip(axes.flat, names, strict=False):
        settings = settings_of(result["rows"], name)
        for line, (colour, marker) in looks.items():
            found = [one for one in settings if one.preset is None and _line(one.rows[0]) == line]
            label = f"{line[0]}, {line[1]:,} surfels, 1/{line[2]}, {line[3]} samples"
            style = {"color": colour, "marker": marker, "markersize": 4, "linewidth": 0.8, "capsize": 2}
            _draw(ax, found, label=label, **style)
        presets = sorted((one for one in settings if one.preset is not None), key=lambda one: one.seconds)
        for i, preset in enumerate(presets):  # labels to the left, alternately above and below their star
            _draw(ax, [preset], color="#444444", marker="*", markersize=9)
            look = {"textcoords": "offset points", "fontsize": 7, "ha": "right"}
            ax.annotate(preset.name, (preset.seconds, preset.psnr), xytext=(-5, 5 if i % 2 else -11), **look)
        best = front(settings)
        x, y = [one.seconds for one in best], [one.psnr for one in best]
        ax.step(x, y, where="post", color="#bbbbbb", lw=3, zorder=0, label="Pareto front")
        size = _pixels(settings[0].rows, "full_width", "full_height")
        ax.set(xscale="log", xlabel="CPU s", ylabel="PSNR, dB")
        ax.xaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
        ax.xaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
        ax.xaxis.set_minor_locator(ticker.NullLocator())
        ax.set_title(f"{name}, {size} pixels", fontsize=9)
    figures.legend(figure, axes.flat[: len(names)], "Validation PSNR against CPU time", columns)
    return figures.save(figure, folder / "frontier.png")


def _line(row: Row) -> tuple[str, int, int, int]:
    return row["method"], row["max_surfels"], row["downscale"], row["samples"]


def _draw(ax: Any, settings: Sequence[Setting], **look: Any) -> None:
    """Draw settings with their standard deviation over seeds."""
    if settings:
        x, y = zip(*((one.seconds, one.psnr) for one in settings), strict=True)
        ax.errorbar(x, y, yerr=[one.spread() or 0 for one in settings], **look)
