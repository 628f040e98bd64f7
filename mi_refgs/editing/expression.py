"""Expressions over surfel attributes, such as `metallic > 0.5 and roughness < 0.2`, and the values they use.

The syntax is a subset of Python's: numbers, names of `SurfelValues`, + - * / **, comparisons also in chains
(0 < x < 1), and, or, not, and the functions abs, sqrt, min, max. Python parses the text; only the nodes
below are evaluated, in float64. A number that is not defined, such as 0 / 0, compares as false.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property, reduce
from typing import Any

import numpy as np

from mi_refgs.errors import InputError, abbreviated
from mi_refgs.evaluation.images import LUMINANCE
from mi_refgs.runs.relightable import outward
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.surfels.attributes import ATTRIBUTES, SH_DC, sigmoid

MAX_LENGTH = 2000
"""Characters of an expression: bounds the work of Python's parser."""
MAX_DEPTH = 30
"""Operations within each other: each takes a few calls of Python's stack of 1,000."""
TOKEN = re.compile(
    r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?!\w)"  # numbers, but not 1_000, 0x10, 1j
    r"|[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*"
    r"|\*\*|[<>=!]=|[-+*/()<>,\s]",
    re.ASCII,
)
FUNCTIONS: dict[str, Callable[..., Any]] = {
    "abs": np.abs,
    "sqrt": np.sqrt,
    "min": lambda *numbers: reduce(np.minimum, numbers),
    "max": lambda *numbers: reduce(np.maximum, numbers),
}
OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
    ast.UAdd: np.positive,
    ast.USub: np.negative,
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
    ast.Eq: np.equal,
    ast.NotEq: np.not_equal,
}
COLOUR = "colour"
"""The SH term of degree 0 of radiance_sh, ½ + c Y₀: linear radiance."""
AXES = "xyz"


def parse_condition(text: str, where: str = "--where") -> Expression:
    """Parse a comparison, or several; raises InputError, with `where` in the message, for anything else."""
    found = Expression(_Source(text, where))
    if not found.is_condition:
        raise InputError(f"{where}: {abbreviated(text)}: compares nothing; write it like metallic > 0.5")
    return found


def parse_numbers(text: str, where: str = "--set") -> list[Expression]:
    """Parse numbers between commas; raises InputError, with `where` in the message, for anything else."""
    source = _Source(text, where)
    parts = source.tree.elts if isinstance(source.tree, ast.Tuple) else [source.tree]
    found = [Expression(source, part) for part in parts]
    if not found or any(expression.is_condition for expression in found):
        raise InputError(f"{where}: {abbreviated(text)}: a comparison is no number; give numbers")
    return found


class _Source:
    """A text and its syntax tree."""

    def __init__(self, text: str, where: str) -> None:
        """Parse a text with Python; raises InputError for characters and syntax outside the language."""
        self.text, self.where = text, where
        if len(text) > MAX_LENGTH:
            raise InputError(f"{where}: {abbreviated(text)}: longer than {MAX_LENGTH} characters; shorten it")
        place = 0
        while place < len(text):
            token, sign = TOKEN.match(text, place), text[place]
            if token is None:
                raise self.error(
                    place,
                    "use == to compare" if sign == "=" else f"{abbreviated(sign)} is not allowed; remove it",
                )
            place = token.end()
        line = re.sub(r"\s", " ", text).lstrip()
        self.indent = len(text) - len(line)  # which Python refuses
        try:
            self.tree = ast.parse(line, mode="eval").body
        except SyntaxError as error:
            place = (error.offset or len(line) + 1) - 1  # no offset: the end of the line
            if place >= len(line.rstrip()):
                raise self.error(len(text), "a name or a number is missing; write one") from error
            open_bracket = "never closed" in error.msg
            remedy = "the bracket is not closed; write )" if open_bracket else "not understood; correct it"
            raise self.error(place + self.indent, remedy) from error
        except (RecursionError, MemoryError) as error:
            raise self.error(0, "too many operations within each other; simplify it") from error

    def error(self, place: int | ast.expr, remedy: str) -> InputError:
        """Return the error at an index of the text, or at a node of its tree."""
        index = place if isinstance(place, int) else place.col_offset + self.indent
        return InputError(f"{self.where}: {abbreviated(self.text)}: character {index + 1}: {remedy}")


class _Names(dict[str, Any]):
    """Records the names that are looked up; each has the value 1."""

    def __missing__(self, name: str) -> Any:
        return self.setdefault(name, np.float64(1))


class Expression:
    """A number or a condition per surfel."""

    def __init__(self, source: _Source, node: ast.expr | None = None) -> None:
        """Check a syntax tree, or a part of it; raises InputError for what the language does not have."""
        self.source, self.node = source, node or source.tree
        names = _Names()
        self.is_condition = self.evaluate(names).dtype == bool  # else a number
        self.names = frozenset(names)  # that it needs values of

    def evaluate(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the value per surfel, (N,), or () if it has no names: bool or float64."""
        with np.errstate(all="ignore"):
            return np.asarray(self._value(self.node, values, 0))

    def _value(self, node: ast.expr, values: Mapping[str, np.ndarray], depth: int) -> Any:
        """Return the value of a node that `depth` others contain."""
        if depth > MAX_DEPTH:
            raise self.source.error(node, f"more than {MAX_DEPTH} operations within each other; simplify it")

        def numbers(*nodes: ast.expr) -> list[Any]:
            found = [self._value(each, values, depth + 1) for each in nodes]
            if any(value.dtype == bool for value in found):
                remedy = "a comparison is no number; put 'and' or 'or' between comparisons"
                raise self.source.error(node, remedy)
            return found

        def conditions(word: str, *nodes: ast.expr) -> list[Any]:
            found = [self._value(each, values, depth + 1) for each in nodes]
            if not all(value.dtype == bool for value in found):
                raise self.source.error(node, f"'{word}' needs comparisons; write them like metallic > 0.5")
            return found

        match node:
            case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
                if value > sys.float_info.max:
                    raise self.source.error(node, "the number is too large; give a smaller one")
                return np.float64(value)
            case ast.Name() | ast.Attribute():
                return values[ast.unparse(node)]
            case ast.BoolOp(op=ast.And()):
                return reduce(np.logical_and, conditions("and", *node.values))
            case ast.BoolOp():
                return reduce(np.logical_or, conditions("or", *node.values))
            case ast.UnaryOp(op=ast.Not()):
                return np.logical_not(*conditions("not", node.operand))
            case ast.UnaryOp():
                return OPERATORS[type(node.op)](*numbers(node.operand))
            case ast.BinOp():
                # a + b + … nests to the left as deep as it is long: a loop instead of recursion.
                chain = [node]
                while isinstance(chain[-1].left, ast.BinOp):
                    chain.append(chain[-1].left)
                found, *rest = numbers(chain[-1].left, *(each.right for each in reversed(chain)))
                for each, right in zip(reversed(chain), rest, strict=True):
                    found = OPERATORS[type(each.op)](found, right)
                return found
            case ast.Compare() if all(type(sign) in OPERATORS for sign in node.ops):
                found = numbers(node.left, *node.comparators)
                pairs = zip(node.ops, found, found[1:], strict=False)
                return reduce(np.logical_and, [OPERATORS[type(sign)](a, b) for sign, a, b in pairs])
            case ast.Call(func=ast.Name(id=name), args=[_, *more], keywords=[]):
                if name not in FUNCTIONS:
                    remedy = f"'{name}' is no function here; use one of {', '.join(FUNCTIONS)}"
                    raise self.source.error(node, remedy)
                if more and name in ("abs", "sqrt"):
                    raise self.source.error(node, f"'{name}' takes one argument; give one")
                return FUNCTIONS[name](*numbers(*node.args))
        raise self.source.error(
            node, "not understood; use numbers, names, + - * / **, comparisons, and or not"
        )


class SurfelValues(Mapping[str, np.ndarray]):
    """The activated attributes of a scene's surfels, (N,) float64 by name, computed when they are read.

    Names: single columns, such as `roughness`, `albedo.r`, `position.x` or `x`; `size`, the largest standard
    deviation (scene units); `normal.x` … `.z`, outwards as in `runs.relightable.outward`; `colour.r` … `.b`
    (COLOUR); `luminance` of the colour, or of the albedo where the diffuse term is computed from that; and
    each of the two, `colour.luminance` and `albedo.luminance`.
    """

    def __init__(self, scene: TrainedScene) -> None:
        self.scene, self.raw = scene, scene.surfels.to_numpy()
        self.columns: dict[str, tuple[str, list[int]]] = {}  # attribute, or COLOUR, and its columns by name
        for name, table in self.raw.items():
            declared, width = ATTRIBUTES[name], table.shape[1]
            if not declared.harmonics and declared.activation not in ("quaternion", "exp"):
                self._add(name, width, declared.aov.lower() if len(declared.aov) == width else AXES)
        self.columns |= {axis: ("position", [i]) for i, axis in enumerate(AXES)}
        if "radiance_sh" in self.raw:
            self._add(COLOUR, 3, "rgb")
        bright = [name for name in ("albedo", COLOUR) if name in self.columns]
        self.names = [
            *(name for name, (_, columns) in self.columns.items() if len(columns) == 1),
            *("size", *(f"normal.{axis}" for axis in AXES)),
            *(*(f"{name}.luminance" for name in bright), *(["luminance"] if bright else [])),
        ]

    def _add(self, of: str, width: int, letters: str) -> None:
        self.columns[of] = of, list(range(width))
        if width > 1:
            self.columns |= {f"{of}.{letter}": (of, [i]) for i, letter in enumerate(letters)}

    @cached_property
    def _normals(self) -> np.ndarray:
        return outward(self.scene.surfels, self.scene.mesh)[0].astype(np.float64)

    @property
    def settable(self) -> list[str]:
        """The names that can be given other values, of all columns of an attribute or of one."""
        return [
            n for n, (of, _) in self.columns.items() if of == COLOUR or ATTRIBUTES[of].activation == "sigmoid"
        ]

    def activated(self, name: str) -> np.ndarray:
        """Return an attribute with a linear or sigmoid activation, or the COLOUR, (N, D) float64."""
        if name == COLOUR:
            return 0.5 + SH_DC * self.raw["radiance_sh"][:, :3].astype(np.float64)
        values = self.raw[name].astype(np.float64)
        return sigmoid(values) if ATTRIBUTES[name].activation == "sigmoid" else values

    def require(self, names: frozenset[str], where: str) -> None:
        """Raise InputError, with `where` in the message, for names that the surfels have no values of."""
        for name in sorted(names - {*self}):
            raise InputError(
                f"{where}: {abbreviated(name)} is no value of these surfels; use one of {', '.join(self)}"
            )

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.names:
            raise KeyError(name)
        of, _, part = name.partition(".")
        if name in self.columns:
            of, columns = self.columns[name]
            return self.activated(of)[:, columns[0]]
        if name == "size":
            return self.scene.surfels.primitive.extent(self.raw)[1].max(axis=1).astype(float)
        if of == "normal":
            return self._normals[:, AXES.index(part)]
        if name == "luminance":
            fitted = "radiance_sh" in self.scene.shading.required_attributes and COLOUR in self.columns
            of = COLOUR if fitted else "albedo"
        return self.activated(of) @ LUMINANCE

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)
