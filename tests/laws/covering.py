"""Covering arrays: few cases in which every allowed combination of values of any t dimensions occurs."""

import random
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import pytest

Dimensions = Mapping[str, Sequence[Hashable]]
Case = dict[str, Any]
Combination = tuple[tuple[str, Any], ...]
CANDIDATES = 8  # random cases of which the one that covers most is kept


@dataclass(frozen=True)
class Rule:
    """Values that do not go together."""

    names: tuple[str, ...]  # dimensions
    forbids: Callable[..., bool]  # of one value of each
    refusal: str = ""  # what the product answers (regular expression); "": no input can say it

    def broken(self, case: Mapping[str, Any]) -> bool:
        """Whether the values of a case, or of a part of one, are forbidden."""
        return all(name in case for name in self.names) and self.forbids(*(case[n] for n in self.names))


def combinations_of(dimensions: Dimensions, strength: int) -> Iterator[Combination]:
    """Every combination of values of every `strength` dimensions."""
    for names in combinations(dimensions, strength):
        for values in product(*(dimensions[name] for name in names)):
            yield tuple(zip(names, values, strict=True))


def completed(partial: Case, dimensions: Dimensions, rules: Sequence[Rule]) -> Case | None:
    """A whole case with the values of `partial` that breaks no rule; None if there is none."""
    if any(rule.broken(partial) for rule in rules):
        return None
    # Only dimensions that rules mention can fail; the first value of the others does.
    ruled = {name for rule in rules for name in rule.names}
    rest = [name for name in dimensions if name not in partial]
    open_ = next((name for name in rest if name in ruled), None)
    if open_ is None:
        return {name: partial.get(name, values[0]) for name, values in dimensions.items()}
    for value in dimensions[open_]:
        found = completed(partial | {open_: value}, dimensions, rules)
        if found is not None:
            return found
    return None


def covering_array(
    dimensions: Dimensions, rules: Sequence[Rule], strength: int = 2, seed: int = 0
) -> list[Case]:
    """Cases that together have every allowed combination of `strength` values, greedily."""
    rng, every = random.Random(seed), combinations_of(dimensions, strength)
    missing = {c: None for c in every if completed(dict(c), dimensions, rules)}
    cases: list[Case] = []
    while missing:
        first = next(iter(missing))
        found = [_candidate(first, dimensions, rules, strength, missing, rng) for _ in range(CANDIDATES)]
        best, covered = max(found, key=lambda pair: len(pair[1]))
        for combination in covered:
            del missing[combination]
        cases.append(best)
    return cases


def _candidate(
    first: Combination,
    dimensions: Dimensions,
    rules: Sequence[Rule],
    strength: int,
    missing: Mapping[Combination, None],
    rng: random.Random,
) -> tuple[Case, list[Combination]]:
    """A case with `first`, and the missing combinations that it covers."""
    partial, place = dict(first), {name: i for i, name in enumerate(dimensions)}

    def new(case: Case, name: str) -> list[Combination]:
        """Missing combinations of a part of a case with one of its names."""
        others = [other for other in case if other != name]
        chosen = (sorted((*rest, name), key=place.__getitem__) for rest in combinations(others, strength - 1))
        return [c for names in chosen if (c := tuple((n, case[n]) for n in names)) in missing]

    for name in rng.sample([*dimensions], len(dimensions)):
        if name in partial:
            continue
        values = rng.sample([*dimensions[name]], len(dimensions[name]))
        values.sort(key=lambda value: -len(new(partial | {name: value}, name)))
        partial[name] = next(v for v in values if completed(partial | {name: v}, dimensions, rules))
    covered = {c: None for name in dimensions for c in new(partial, name)}
    return {name: partial[name] for name in dimensions}, [*covered]


def marked(cases: Sequence[Mapping[str, Any]]) -> list[Sequence[pytest.MarkDecorator]]:
    """Marks of cases: slow, unless one has a value that none before it has."""
    seen: set[tuple[str, str]] = set()
    marks: list[Sequence[pytest.MarkDecorator]] = []
    for case in cases:
        values = {(name, str(value)) for name, value in case.items()}
        marks.append([] if values - seen else [pytest.mark.slow])
        seen |= values
    return marks
