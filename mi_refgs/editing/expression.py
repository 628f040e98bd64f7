"""Expressions over the surfels' values, such as `metallic > 0.5 and roughness < 0.2`: parsed by a grammar of
our own, never by Python.

    truth       := both ("or" both)*            both    := not ("and" not)*
    not         := "not" not | comparison       compared by < <= > >= == !=, in chains: 0 < x < 1
    sum         := product (("+" | "-") product)*
    product     := signed (("*" | "/") signed)*
    signed      := ("+" | "-") signed | power
    power       := atom ["**" signed]
    atom        := number | name | function "(" sum ("," sum)* ")" | "(" truth ")"

Names are those of `fields`; functions are abs and sqrt of one, min and max of one or more. What is compared
and computed are float64 numbers; a number that is not defined, such as 0 / 0, compares as false.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from mi_refgs.errors import InputError, abbreviated

MAX_LENGTH = 2000
"""Characters of an expression: what a person types is far below."""
MAX_DEPTH = 30
"""Brackets, signs and powers within each other: each takes some ten calls of Python's stack of 1,000."""
TOKEN = re.compile(
    r"(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)"
    r"|(?P<name>[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*)"
    r"|(?P<sign>\*\*|[<>=!]=|[-+*/()<>,])",
    re.ASCII,
)
FUNCTIONS: dict[str, tuple[Any, bool]] = {
    "abs": (np.abs, False),
    "sqrt": (np.sqrt, False),
    "min": (np.minimum, True),
    "max": (np.maximum, True),
}
"""Functions by name, and whether they take several arguments."""
COMPARISONS: dict[str, Any] = {
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
    "==": np.equal,
    "!=": np.not_equal,
}
ARITHMETIC: dict[str, Any] = {"+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide}
WORDS = ("and", "or", "not")

Values = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Expression:
    """A parsed expression: a number, or a truth, of every surfel."""

    text: str
    truth: bool
    names: frozenset[str]
    compute: Callable[[Values], Any]

    def of(self, values: Values) -> np.ndarray:
        """The value of every surfel, from those of the `names`; float64, or bool for a truth."""
        with np.errstate(all="ignore"):
            return np.asarray(self.compute(values))


def parse_condition(text: str, where: str = "--where") -> Expression:
    """A comparison, or several; raises InputError, with `where` in the message, for anything else."""
    (found,) = _Parser(text, where).all(1)
    if not found.truth:
        raise InputError(f"{where}: {abbreviated(text)}: compares nothing; write it like metallic > 0.5")
    return found


def parse_numbers(text: str, where: str = "--set") -> list[Expression]:
    """Numbers with commas between them; raises InputError, with `where` in the message, for anything else."""
    found = _Parser(text, where).all(None)
    if any(expression.truth for expression in found):
        raise InputError(f"{where}: {abbreviated(text)}: a comparison is no number; give numbers")
    return found


@dataclass(frozen=True)
class _Node:
    truth: bool
    compute: Callable[[Values], Any]


class _Parser:
    """Recursive descent over the tokens of one text."""

    def __init__(self, text: str, where: str) -> None:
        self.text, self.where = text, where
        self.depth = 0
        self.names: set[str] = set()
        if len(text) > MAX_LENGTH:
            raise InputError(f"{where}: {abbreviated(text)}: longer than {MAX_LENGTH} characters; shorten it")
        self.tokens: list[tuple[str, str, int]] = []
        place = 0
        while place < len(text):
            if text[place] in " \t\n\r":
                place += 1
                continue
            found = TOKEN.match(text, place)
            if found is None:
                sign = text[place]
                remedy = (
                    "use == to compare" if sign == "=" else f"{abbreviated(sign)} is not allowed; remove it"
                )
                raise self._error(remedy, place)
            self.tokens.append((str(found.lastgroup), found[0], place))
            place = found.end()
        self.tokens.append(("end", "", len(text)))
        self.next = 0

    def all(self, count: int | None) -> list[Expression]:
        """The expressions between commas, `count` of them where that is given."""
        found = []
        while True:
            self.names = set()
            node = self._truth()
            found.append(Expression(self.text, node.truth, frozenset(self.names), node.compute))
            if len(found) == count or not self._take(","):
                break
        if self._kind != "end":
            raise self._error("write an operator before it, or remove it")
        return found

    # ---------------- the grammar ----------------

    def _truth(self) -> _Node:
        return self._joined("or", lambda: self._joined("and", self._not, np.logical_and), np.logical_or)

    def _joined(self, word: str, part: Callable[[], _Node], function: Any) -> _Node:
        place, first = self._place, part()
        parts = [first]
        while self._take(word):
            parts.append(part())
        if len(parts) == 1:
            return first
        if not all(node.truth for node in parts):
            raise self._error(f"'{word}' stands between comparisons; write them like metallic > 0.5", place)
        return _Node(True, lambda values: reduce(function, [node.compute(values) for node in parts]))

    def _not(self) -> _Node:
        place = self._place
        if not self._take("not"):
            return self._comparison()
        inner = self._deeper(self._not)
        if not inner.truth:
            raise self._error("'not' stands before a comparison; write one like metallic > 0.5", place)
        return _Node(True, lambda values: np.logical_not(inner.compute(values)))

    def _comparison(self) -> _Node:
        place, first = self._place, self._sum()
        parts, signs = [first], []
        while (sign := self._any_of(COMPARISONS)) is not None:
            signs.append(COMPARISONS[sign])
            parts.append(self._sum())
        if not signs:
            return first
        self._numbers(parts, place)

        def compute(values: Values) -> Any:
            found = [node.compute(values) for node in parts]
            pairs = zip(signs, found, found[1:], strict=False)
            return reduce(np.logical_and, [sign(a, b) for sign, a, b in pairs])

        return _Node(True, compute)

    def _sum(self) -> _Node:
        return self._chain(("+", "-"), lambda: self._chain(("*", "/"), self._signed))

    def _chain(self, signs: tuple[str, ...], part: Callable[[], _Node]) -> _Node:
        place, first = self._place, part()
        rest: list[tuple[Any, _Node]] = []
        while (sign := self._any_of(signs)) is not None:
            rest.append((ARITHMETIC[sign], part()))
        if not rest:
            return first
        self._numbers([first, *(node for _, node in rest)], place)

        def compute(values: Values) -> Any:
            return reduce(lambda a, b: b[0](a, b[1].compute(values)), rest, first.compute(values))

        return _Node(False, compute)

    def _signed(self) -> _Node:
        place, sign = self._place, self._any_of(("+", "-"))
        if sign is None:
            return self._power()
        inner = self._deeper(self._signed)
        self._numbers([inner], place)
        return inner if sign == "+" else _Node(False, lambda values: np.negative(inner.compute(values)))

    def _power(self) -> _Node:
        place, base = self._place, self._atom()
        if not self._take("**"):
            return base
        exponent = self._deeper(self._signed)
        self._numbers([base, exponent], place)
        return _Node(False, lambda values: np.power(base.compute(values), exponent.compute(values)))

    def _atom(self) -> _Node:
        kind, word, place = self.tokens[self.next]
        if self._take("("):
            inner = self._deeper(self._truth)
            self._close()
            return inner
        if kind == "number":
            self.next += 1
            number = np.float64(word)
            if not np.isfinite(number):
                raise self._error("the number is too large; give a smaller one", place)
            return _Node(False, lambda values: number)
        if kind != "name" or word in WORDS:
            raise self._error("a name or a number is missing; write one", place)
        self.next += 1
        if self._take("("):
            return self._call(word, place)
        self.names.add(word)
        return _Node(False, lambda values: values[word])

    def _call(self, name: str, place: int) -> _Node:
        if name not in FUNCTIONS:
            raise self._error(f"'{name}' is no function here; use one of {', '.join(FUNCTIONS)}", place)
        function, several = FUNCTIONS[name]
        arguments = [self._deeper(self._sum)]
        while self._take(","):
            arguments.append(self._deeper(self._sum))
        self._close()
        self._numbers(arguments, place)
        if several:
            return _Node(False, lambda values: reduce(function, [node.compute(values) for node in arguments]))
        if len(arguments) > 1:
            raise self._error(f"'{name}' takes one argument; give one", place)
        return _Node(False, lambda values: function(arguments[0].compute(values)))

    # ---------------- tokens ----------------

    @property
    def _kind(self) -> str:
        return self.tokens[self.next][0]

    @property
    def _place(self) -> int:
        return self.tokens[self.next][2]

    def _take(self, word: str) -> bool:
        """Go past the next token if it is this one."""
        found = self.tokens[self.next][1] == word
        self.next += found
        return found

    def _any_of(self, words: Any) -> str | None:
        return next((word for word in words if self._take(word)), None)

    def _close(self) -> None:
        if not self._take(")"):
            raise self._error("a bracket is not closed; write ) or an operator")

    def _deeper(self, part: Callable[[], _Node]) -> _Node:
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise self._error(f"more than {MAX_DEPTH} brackets within each other; simplify it")
        node = part()
        self.depth -= 1
        return node

    def _numbers(self, nodes: list[_Node], place: int) -> None:
        if any(node.truth for node in nodes):
            raise self._error("a comparison is no number; put 'and' or 'or' between comparisons", place)

    def _error(self, remedy: str, place: int | None = None) -> InputError:
        place = self._place if place is None else place
        return InputError(f"{self.where}: {abbreviated(self.text)}: character {place + 1}: {remedy}")
