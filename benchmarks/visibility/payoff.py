"""What the knobs buy for a bounded price."""

from __future__ import annotations

from benchmarks.common.select import Row, where

PAPER = "mirror ray"
"""The paper's rule: one mirror ray for the whole lobe, and no traced light."""
BUDGET = 3.0
"""Times of the paper's rule that a set of knobs may take."""
TARGET = 4.0
"""How many times smaller its relMSE is asked to be."""
TIMES = ("ms", "frame_ms")
"""Of visibility and shading on a mesh; of the product's frame of surfels."""


def payoffs(rows: list[Row]) -> list[Row]:
    """For each scene, roughness and kind of time: the best rule within the budget, and what it gains.

    Errors are those against the path tracer at full depth; `gain` is the ratio of relMSE, `price` of times.
    """
    found = []
    for case in dict.fromkeys((row["scene"], row["roughness"]) for row in rows):
        full = where(rows, scene=case[0], roughness=case[1], depth="full")
        paper = where(full, method=PAPER)[0]
        for key in TIMES:
            affordable = [row for row in full if row[key] is not None and row[key] <= BUDGET * paper[key]]
            best = min(affordable, key=lambda row: float(row["relmse"]))
            found.append(
                {
                    "scene": case[0],
                    "roughness": case[1],
                    "time": key,
                    "method": best["method"],
                    "gain": paper["relmse"] / best["relmse"],
                    "price": best[key] / paper[key],
                    "paper_relmse": paper["relmse"],
                    "relmse": best["relmse"],
                }
            )
    return found
