"""What the options buy for a bounded price, against the paper's rule."""

from __future__ import annotations

import numpy as np

from benchmarks.common.select import Row, where

MIRROR = "mirror ray"
"""One mirror ray for the whole lobe and no indirect light: what the price is a multiple of."""
PAPER = "harmonics"
"""Budget of the paper's rule: one mirror ray, indirect light by the best-fit spherical harmonics."""
BUDGET = 3.0
"""Times of the mirror ray alone that a setting may take."""
TIMES = ("ms", "frame_ms")
"""Of visibility and shading on a mesh; of the product's frame of surfels."""


def tradeoffs(rows: list[Row], budgets: list[Row]) -> list[Row]:
    """For each scene, roughness and kind of time: a setting within the budget, and what it gains.

    The setting is chosen on the other scenes: of those within the budget here, the one of the least mean
    logarithm of relMSE there, over all roughness. With one scene only, it is chosen on that scene. Errors are
    those against the path tracer at full depth; `gain` is the ratio of relMSE of the paper's rule and of the
    setting, `best_gain` that of the best setting in hindsight, `price` the ratio of times.
    """
    found = []
    names = list(dict.fromkeys(row["scene"] for row in rows))
    for case in dict.fromkeys((row["scene"], row["roughness"]) for row in rows):
        full = where(rows, scene=case[0], roughness=case[1], depth="full")
        mirror = where(full, method=MIRROR)[0]
        (paper,) = where(budgets, scene=case[0], roughness=case[1], indirect=PAPER)
        others = [name for name in names if name != case[0]] or names
        elsewhere = where(rows, scene=others, depth="full")
        for key in TIMES:
            affordable = [row for row in full if row[key] is not None and row[key] <= BUDGET * mirror[key]]
            chosen = min(affordable, key=lambda row: _mean_log(where(elsewhere, method=row["method"])))
            found.append(
                {
                    "scene": case[0],
                    "roughness": case[1],
                    "time": key,
                    "method": chosen["method"],
                    "gain": paper["total"] / chosen["relmse"],
                    "best_gain": paper["total"] / min(row["relmse"] for row in affordable),
                    "price": chosen[key] / mirror[key],
                    "mirror_relmse": mirror["relmse"],
                    "paper_relmse": paper["total"],
                    "relmse": chosen["relmse"],
                }
            )
    return found


def _mean_log(rows: list[Row]) -> float:
    # The floor keeps an exact setting finite.
    return float(np.mean([np.log(max(row["relmse"], 1e-12)) for row in rows]))
