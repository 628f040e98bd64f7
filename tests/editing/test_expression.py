"""Expressions: values equal Python's, and anything else is refused in one sentence."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_refgs.editing.change import assignments
from mi_refgs.editing.expression import MAX_DEPTH, parse_condition, parse_numbers
from mi_refgs.errors import InputError
from tests.helpers import refused

VALUES = {
    "a": np.array([0.0, 1.0, -2.0, 0.5]),
    "b": np.array([3.0, 1.0, 0.25, -1.0]),
    "c.x": np.array([1.0, 2.0, 3.0, 4.0]),
}


def by_python(text: str, row: int) -> Any:
    names: dict[str, Any] = {"abs": abs, "min": min, "max": max, "sqrt": math.sqrt}
    values = {name.replace(".", "_"): float(table[row]) for name, table in VALUES.items()}
    return eval(text.replace("c.x", "c_x"), {"__builtins__": {}}, names | values)


@pytest.mark.parametrize(
    "text",
    [
        "a > 0.5",
        "a > 0.5 and b < 2 or c.x == 3",
        "not a > 0 and not (b > 0 or c.x > 2)",
        "not not a > 0",
        "0 <= a < b <= 3",
        "a < b != c.x",
        "a - b - c.x < 1 - 2 - 3",
        "a / 2 * b < -a * -b",
        "2 ** 3 ** 0.5 < 3.4",
        "-2 ** 2 == -4",
        "2 ** -1 == .5",
        "(a + 1) * 2 >= 1e0",
        "abs(a) == max(a, -a) and min(a, b, c.x) <= a",
        "sqrt(c.x * c.x) == c.x",
        "a > 0 or b > 0 and c.x > 2",
        "+a >= --a",
        "1 < 2",
    ],
)
def test_values_equal_python(text: str) -> None:
    found = np.broadcast_to(parse_condition(text).evaluate(VALUES), 4)
    assert found.dtype == bool
    assert found.tolist() == [by_python(text, row) for row in range(4)]


def test_numbers_are_separated_by_commas() -> None:
    first, second, third = parse_numbers(" 0.5 , a*b+1,min(a,b) ")
    assert first.evaluate(VALUES) == 0.5 and not first.names and second.names == {"a", "b"}
    np.testing.assert_array_equal(second.evaluate(VALUES), VALUES["a"] * VALUES["b"] + 1)
    np.testing.assert_array_equal(third.evaluate(VALUES), np.minimum(VALUES["a"], VALUES["b"]))


def test_undefined_numbers_compare_as_false() -> None:
    for text in ("a / 0 * 0 > 0", "sqrt(-1) < 1", "(0/0) == (0/0)", "10**10**10 < 1"):
        assert not np.any(parse_condition(text).evaluate(VALUES)), text
    assert np.all(parse_condition("10**10**10 > 1").evaluate(VALUES))


HOSTILE = [
    *("", " ", "a", "a >", "> a", "a > 1 b", "a > 1,", "a > 1, b > 1", "a = 1", "a = = 1", "(a > 1"),
    *("a > 1)", "()", "a > ()", "and", "a and b", "not a", "a > 1 and b", "(a > 1) + 1 > 0", "-(a > 1)"),
    *("abs(a > 1) > 0", "a > (b > 1)", "abs() > 1", "abs(a, b) > 1", "exp(a) > 1", "a(1) > 1"),
    *("__import__('os').system('true')", "().__class__.__bases__[0]", "a.__class__ .b > 1 .real"),
    *("lambda: 0", "[a for a in b]", "a if b else a", "a := 1", "a in b", "a < b is not c.x"),
    *("True > a", "min(*a) > 1", "min(a=1) > 1", "a & b", "a > 1 # b", 'a > "1"', "a\x00 > 1", "α > 1"),
    *("a \uff1e 1", "a > \u0661", "1e999 > a", "1_000 > a", "0x10 > a", "1j > a", "a > 1; b"),
    *("a\\\n > 1", "%s" * 10, "(" * 1000 + "a" + ")" * 1000 + " > 1", "-" * 1500 + "a > 1"),
    *("not " * 400 + "a > 1", "2" + "**2" * 600 + " > 1", "abs(" * 200 + "a" + ")" * 200 + "> 1"),
    *("a+" * 100_000 + "a > 1", "9" * 1900 + " > a"),
]


@pytest.mark.parametrize("text", HOSTILE, ids=range(len(HOSTILE)))
def test_hostile_expressions_are_one_sentence(text: str) -> None:
    message = refused(lambda: parse_condition(text))
    assert message.startswith("--where: ") and "\n" not in message and len(message) < 300


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("metallic > ", "character 12: a name or a number is missing"),
        ("  (a > 1", "character 3: the bracket is not closed"),
        ("x < {", "character 5: '{' is not allowed"),
        (" a > exp(b)", "character 6: 'exp' is no function here; use one of abs, sqrt, min, max"),
        ("abs(" * 31 + "a" + ")" * 31 + " > 1", "more than 30 operations within each other"),
    ],
)
def test_an_error_names_the_character_and_the_remedy(text: str, words: str) -> None:
    refused(lambda: parse_condition(text), words)


def test_long_chains_and_nearly_too_deep_ones_are_computed() -> None:
    assert np.all(parse_condition("+".join(["1"] * 900) + " == 900").evaluate(VALUES))
    inside = MAX_DEPTH - 1
    assert np.all(parse_condition("abs(" * inside + "a" + ")" * inside + " >= a").evaluate(VALUES))
    assert np.all(parse_condition(" and ".join(["a == a"] * 150)).evaluate(VALUES))


WORDS = ["a", "b", "c.x", "1", "2.5", ".5", "1e3", "(", ")", ",", "+", "-", "*", "/", "**", "<", "<=", ">"]
WORDS += [">=", "==", "!=", "and", "or", "not", "abs", "min(", "max(", "sqrt(", "=", ".", "é", "\n", "_"]


@given(st.lists(st.sampled_from(WORDS), max_size=25).map(" ".join) | st.text(max_size=60))
def test_any_text_is_a_value_of_every_surfel_or_a_sentence(text: str) -> None:
    for parse in (parse_condition, parse_numbers):
        try:
            parsed = parse(text)
        except InputError as error:
            assert "\n" not in str(error)
            continue
        for expression in parsed if isinstance(parsed, list) else [parsed]:
            if expression.names <= {*VALUES}:
                found = np.broadcast_to(expression.evaluate(VALUES), 4)
                assert found.dtype == (bool if expression.is_condition else np.float64)


@given(
    st.lists(st.sampled_from([*WORDS, "roughness", "*=", "albedo.r"]), max_size=12).map(" ".join) | st.text()
)
def test_any_text_is_an_assignment_or_a_sentence(text: str) -> None:
    try:
        (found,) = assignments([text])
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert found.values and "=" in text
