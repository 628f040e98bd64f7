"""Questions to the rows of a result."""

from __future__ import annotations

from typing import Any

from benchmarks.common.errors import CLEAR
from benchmarks.common.select import Row, where
from benchmarks.splitsum.settings import CONVEX

PICTURE_METALLIC = 0.5
"""Plots of speed against error show this metal: half diffuse, half mirror."""


def worst(rows: list[Row]) -> Row | None:
    """The row of the largest relMSE."""
    return max(rows, key=lambda row: float(row["relmse"]), default=None)


def shown_relmse(row: Row) -> float:
    """relMSE, or the floor it hides below."""
    return float(max(row["relmse"], CLEAR * row["relmse_floor"]))


def best_height(result: dict[str, Any]) -> int:
    """The finest light."""
    return int(max(result["settings"]["heights"]))


def picture_metallic(result: dict[str, Any]) -> float:
    """The metal that plots show, if it was measured."""
    found = list(result["settings"]["metallic"])
    return PICTURE_METALLIC if PICTURE_METALLIC in found else float(found[-1])


def convex(result: dict[str, Any]) -> list[str]:
    """The convex shapes of the run."""
    return [shape for shape in result["settings"]["shapes"] if shape in CONVEX]


def lights(result: dict[str, Any]) -> list[str]:
    """The run's lights by name, in the order of their frequency."""
    frequencies: dict[str, float] = result["frequencies"]
    return sorted(frequencies, key=lambda name: frequencies[name])


def view_bins(result: dict[str, Any]) -> list[str]:
    """Names of the ranges of n·v, grazing first."""
    names = {row["n_dot_v"] for row in result["rows"]} - {"all"}
    return sorted(names, key=lambda name: float(name.partition("-")[0]))


def trust(result: dict[str, Any], light: str, roughness: float, view: str) -> Row | None:
    """The split sum's worst case, over shapes and metals, for the finest light."""
    return worst(
        where(
            result["rows"],
            method="split_sum",
            setting=best_height(result),
            light=light,
            roughness=roughness,
            n_dot_v=view,
            shape=convex(result),
        )
    )
