"""Error budgets as Markdown: tables of parts, and what is measured of those that do not add up."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from benchmarks.common.budget import TOLERANCE
from benchmarks.common.report import number, percent, table

Row = dict[str, Any]


def budget_table(head: str, cases: Iterable[tuple[str, Row]]) -> str:
    """A line for each labelled budget: parts, total, sum of squares and interaction."""
    found = list(cases)
    names = [part["name"] for part in found[0][1]["parts"]]
    rows = [[label, *_cells(case)] for label, case in found]
    return table([head, *names, "total", "sum", "interaction"], rows)


def _cells(case: Row) -> list[str]:
    if case["total"] < case["floor"]:
        return [*["–"] * len(case["parts"]), f"< {number(case['floor'], 2)}", "–", "noise"]
    parts = [f"{100 * part['share']:.0f} % ({number(part['relmse'], 2)})" for part in case["parts"]]
    left = f"{100 * case['interaction'] / case['total']:+.0f} %"
    if not case["adds_up"]:
        left += f": {case['pair'][0]} and {case['pair'][1]}, ρ = {case['correlation']:+.2f}"
    return [*parts, number(case["total"], 2), number(case["sum"], 2), left]


def adding_up(budgets: Sequence[Row], groups: Sequence[tuple[str, str]] = ()) -> str:
    """How many budgets add up: by their shares, by their squares, and with groups as one part each."""
    clear = _clear(budgets)
    within = f"within {percent(TOLERANCE)} of the total"
    text = (
        f"**Shares by projection sum to 100 % exactly in every budget.** The squares in brackets need not: "
        f"of {len(clear)} budgets above the noise they sum to {within} in "
        f"**{sum(row['adds_up'] for row in clear)}**"
    )
    for k, (a, b) in enumerate(groups):
        met = sum(row["joined_add_up"][k] for row in clear)
        text += f"; with {a} and {b} as one part{' too' * (k > 0)} in **{met}**"
    return text + "."


def largest(budgets: Sequence[Row]) -> str:
    """Which part of each budget has the largest share, in words, the most frequent first."""
    names = [max(row["parts"], key=lambda part: float(part["share"]))["name"] for row in _clear(budgets)]
    counts = {name: names.count(name) for name in names}
    ordered = sorted(counts.items(), key=lambda item: -item[1])
    return ", ".join(f"{name} ({count} of {len(names)})" for name, count in ordered) or "none above the noise"


def interactions(budgets: Sequence[Row]) -> str:
    """Of the budgets whose squares do not add up: the pairs of parts, what they do and where; "" for none."""
    pairs: dict[tuple[str, str], list[Row]] = {}
    for row in _clear(budgets):
        if not row["adds_up"]:
            pairs.setdefault(tuple(row["pair"]), []).append(row)
    if not pairs:
        return ""
    ordered = sorted(pairs.items(), key=lambda item: -len(item[1]))
    lines = [f"- {a} and {b}, {_said(rows)};" for (a, b), rows in ordered]
    return (
        "The budgets whose squares alone do not add up, by the two parts that interact most (ρ: the cosine "
        "between two parts over all pixels, weighted as relMSE weights them; medians over budgets):\n\n"
        + "\n".join(lines)[:-1]
        + "."
    )


def _said(rows: list[Row]) -> str:
    values = [row["correlation"] for row in rows]
    cancel, explained = sum(ρ < 0 for ρ in values), sum(row["pair_explains"] for row in rows)
    signs = [f"they cancel in {cancel}"] * (cancel > 0)
    signs += [f"they add in {len(rows) - cancel}"] * (cancel < len(rows))
    return (
        f"in {len(rows)}: {', '.join(signs)} (median ρ {np.median(values):+.2f}); as one part they make "
        f"{explained} of these add up; {_where(rows)}"
    )


def _where(rows: list[Row]) -> str:
    """The range of n·v that most of the interaction comes from, medians over the budgets."""
    places: dict[str, list[Row]] = {}
    for row in rows:
        for place in row["where"]:
            places.setdefault(place["name"], []).append(place)
    share = {name: float(np.median([p["share"] for p in found])) for name, found in places.items()}
    most = max(share, key=lambda name: share[name])
    points = float(np.median([p["points"] for p in places[most]]))
    return f"{percent(share[most])} of their product comes from n·v {most}, {percent(points)} of the pixels"


def _clear(budgets: Sequence[Row]) -> list[Row]:
    return [row for row in budgets if row["total"] >= row["floor"]]
