"""The section of the page on where the split sum may be trusted."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.common.errors import CLEAR
from benchmarks.common.report import floored, percent, signed, table
from benchmarks.common.select import Row, where
from benchmarks.splitsum import select

TRUSTED, DOUBTFUL = 0.02, 0.10
"""Typical relative errors (√relMSE) up to which a picture passes for exact, and above which it is wrong."""


def trust_section(result: dict[str, Any], picture: str) -> str:
    """Markdown of where the finest split sum may be trusted."""
    roughness, views = list(result["settings"]["roughness"]), select.view_bins(result)
    rows = []
    for light in select.lights(result):
        cells = [select.trust(result, light, r, "all") for r in roughness]
        rows.append([f"`{light}`", *(cell(row) for row in cells)])
    sentences = [_sentence(result, light, roughness, views) for light in select.lights(result)]
    head = ["typical relative error", *(f"r = {r:g}" for r in roughness)]
    biases = [
        [f"`{light}`", *(_bias(result, light, r) for r in roughness)] for light in select.lights(result)
    ]
    return "\n\n".join(
        [
            "## Where it may be trusted",
            f"The split sum with {select.best_height(result)} rows of light; the worst of the convex shapes "
            f"and metals. Trusted means a typical relative error below {percent(TRUSTED)}, wrong one above "
            f"{percent(DOUBTFUL)}.",
            "\n".join(f"- {sentence}" for sentence in sentences),
            _frequency(result, views),
            table(head, rows),
            "Bias of the same cases (of the shape and metal where it is largest; negative is too dark):",
            table(["bias", *head[1:]], biases),
            picture,
        ]
    )


def cell(row: Row | None) -> str:
    """√relMSE, or its floor."""
    return floored(row["relmse"], row["relmse_floor"], CLEAR) if row else "–"


def _bias(result: dict[str, Any], light: str, roughness: float) -> str:
    rows = where(
        result["rows"],
        method="split_sum",
        setting=select.best_height(result),
        light=light,
        roughness=roughness,
        n_dot_v="all",
        shape=select.convex(result),
    )
    row = max(rows, key=lambda row: abs(float(row["bias"])))
    floor = CLEAR * row["bias_floor"]
    return signed(row["bias"], floor)


def _sentence(result: dict[str, Any], light: str, roughness: list[float], views: list[str]) -> str:
    """Where this light's split sum passes, and where it fails first."""
    facing, grazing = views[-1], views[0]
    said = []
    for view, words in (
        (facing, f"facing the camera (n·v > {facing.partition('-')[0]})"),
        (grazing, f"at grazing angles (n·v < {grazing.partition('-')[2]})"),
    ):
        cells = [(r, select.trust(result, light, r, view)) for r in roughness]
        known = [(r, float(np.sqrt(select.shown_relmse(row)))) for r, row in cells if row]
        good = [r for r, error in known if error <= TRUSTED]
        bad = [r for r, error in known if error > DOUBTFUL]
        worst_r, worst_error = max(known, key=lambda item: item[1])
        text = f"{words} it may be trusted {_range(good, roughness)}"
        if bad:
            text += f", and is wrong {_range(bad, roughness)}"
        said.append(f"{text} (at worst {percent(worst_error)}, at roughness {worst_r:g})")
    return f"**`{light}`**: {'; '.join(said)}."


def _range(chosen: list[float], every: list[float]) -> str:
    if not chosen:
        return "nowhere"
    if len(chosen) == len(every):
        return "at every roughness"
    runs: list[list[float]] = []
    for r in every:
        if r in chosen:
            if runs and every.index(r) - every.index(runs[-1][-1]) == 1:
                runs[-1].append(r)
            else:
                runs.append([r])
    return "at roughness " + " and ".join(
        f"{run[0]:g}" if len(run) == 1 else f"{run[0]:g}–{run[-1]:g}" for run in runs
    )


def _frequency(result: dict[str, Any], views: list[str]) -> str:
    """How the error at grazing angles grows with the light's frequency."""
    medians = []
    for light in select.lights(result):
        cells = [select.trust(result, light, r, views[0]) for r in result["settings"]["roughness"]]
        medians.append((light, float(np.median([np.sqrt(select.shown_relmse(c)) for c in cells if c]))))
    chain = ", ".join(f"`{light}` {percent(value)}" for light, value in medians)
    return f"At grazing angles, the median over roughness, lights in order of their frequency: {chain}."
