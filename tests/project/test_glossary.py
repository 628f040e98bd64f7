"""Words that the project does not use, and what to write instead: the field's term, one for each thing.

Checked are docstrings, comments and sentences in strings of Python files (error messages, help texts), the
comments of TOML files, and the text of the pages and notebooks. Code is not: names, values, and text between
backticks.
"""

from __future__ import annotations

import ast
import io
import json
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers import ROOT

UNIT = (
    "(?:pixel|channel|step|surfel|ray|view|image|point|texel|vertex|frame|colour|sample|direction|tile|level)"
)
COUNTED = (
    "(?:samples?|rays?|bytes|ms|milliseconds|seconds|minutes|µs|launches|kernels|values?|numbers?|floats|rows|"
    "directions|bounces|images|surfels|pixels|pairs|gathers|scatters|lookups?|factors?|scales?|gains?|rates?|times?|"
    "once|twice|one|kB|MB|GB|%|dB|hits|points|weights?|colours?|errors?|draws?|levels?|texels?)"
)
WORDS: dict[str, str] = {
    r"pictures?": "image; photograph, where it is one",
    rf"{COUNTED} an? {UNIT}": "per pixel, per channel, per step, …",
    r"seams?": "interface",
    r"planted mistakes?": "mutant",
    r"mistakes? planted": "mutant",
    r"lids?": "cap; a cavity that stays closed",
    r"hollows?": "cavity, concave region",
    r"(?<!spherical )harmonics": "spherical harmonics, SH",
    r"(?<!ground )(?<!ground-)truth": "ground truth",
    r"oracles?": "float64 reference",
    r"processor time": "CPU time",
    r"by the clock": "wall time",
    r"rays of the lobe": "specular-lobe samples",
    r"rays that follow|blocked rays follow": "traced bounces",
    r"held out of training": "validation views",
    r"whoever(?: looks)?|people|a person": "user",
    r"carry|carries|carried|carrying": "contain, have, include",
    r"owes?|owed|owing": "require; not measured, target not met",
    r"earns?|earned": "improve, raise",
    r"pays?(?! attention)|paid": "cost, improve",
    r"asks|asked of": "require, request",
    r"knows": "contain, store, know no more than a name says",
    r"holds(?! (?:for|if|when|where|in|at|to)\b)": "contain, store, keep",
    r"stands?(?! (?:for|out|in for)\b)": "is, is placed, appears",
    r"serves": "is used for",
    r"brings": "add, install, include",
    r"(?:takes?|taken|took|taking|falls?|fell|fallen) apart": "decompose",
    r"(?:tells?|told|telling) (?:\w+ ){0,3}apart": "distinguish, separate",
    r"(?:tells?|told) of": "report",
    r"goes back to|go back to": "return to",
    r"mend(?:s|ed|ing)?": "fix, correct",
    r"wanders?": "vary",
    r"till": "until",
    r"to and fro": "back and forth",
    r"without a word": "silently",
    r"half there": "incomplete; files are written atomically",
    r"likewise": "also, in the same way",
}
"""Regular expression of a word → what to write instead."""
BEGINNINGS = {
    r"Of (?!course\b)\S+(?: \S+)?": "subject first: no sentence begins with a genitive",
    r"For (?:people|whoever)\b": "a fragment: say what it is",
}
"""The same at the beginning of a sentence."""

PROPER_USES: dict[str, str] = {
    "map's seam": "where the last column of a lat-long map meets the first",
    "seam of the map": "where the last column of a lat-long map meets the first",
    "seams of a texture": "where its charts are cut",
}
"""Uses that are meant → why."""


def files() -> list[Path]:
    """Python files, methods and pages, but for this file and those that quote or list others' words."""
    found = [
        path
        for folder in ("mi_refgs", "benchmarks", "docs", "scenes", "tests", "variants")
        for ending in ("py", "toml", "md", "ipynb")
        for path in (ROOT / folder).rglob(f"*.{ending}")
        if not (ending == "toml" and folder != "variants")
    ]
    own = Path(__file__).resolve()
    return sorted(path for path in [*found, *ROOT.glob("*.md")] if path not in (own, ROOT / "CHANGELOG.md"))


def prose(path: Path) -> Iterator[tuple[int, str]]:
    """Line numbers and texts of what a file says to its readers."""
    text = path.read_text()
    if path.suffix == ".ipynb":
        for number, cell in enumerate(json.loads(text)["cells"]):
            source = "".join(cell["source"])
            lines = python_prose(re.sub(r"^%.*", "", source, flags=re.MULTILINE))
            yield from lines if cell["cell_type"] == "code" else [(number, source)]
    elif path.suffix == ".py":
        yield from python_prose(text)
    elif path.suffix == ".toml":
        yield from ((i, line) for i, line in enumerate(text.splitlines(), 1) if "#" in line)
    else:
        fenced = False
        for i, line in enumerate(text.splitlines(), 1):
            fenced ^= line.lstrip().startswith("```")
            if not fenced and not line.startswith("    "):
                yield i, re.sub(r"\]\([^)]*\)|<[^>]*>|\{\{\w+\}\}", "]", line)


def python_prose(text: str) -> Iterator[tuple[int, str]]:
    """Comments, docstrings, and sentences: other strings that have at least two blanks."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string.lstrip("#: ")
    tree = ast.parse(text)
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            if id(node) in docstrings or node.value.count(" ") >= 2:
                for offset, line in enumerate(node.value.splitlines()):
                    yield node.lineno + offset, line.strip()


def findings(path: Path) -> list[str]:
    """`file:line: words → replacement` of every word that is not used."""
    found = []
    name = path.relative_to(ROOT) if path.is_relative_to(ROOT) else path.name
    for line, text in prose(path):
        plain = re.sub(r"`[^`]*`", "` `", text)
        for phrase in PROPER_USES:
            plain = plain.replace(phrase, "")
        for pattern, instead in WORDS.items():
            for match in re.finditer(rf"(?<![\w./-])(?:{pattern})(?![\w]|\.\w|_)", plain, re.IGNORECASE):
                found.append(f"{name}:{line}: {match.group()!r} → {instead}")
        for pattern, instead in BEGINNINGS.items():
            for match in re.finditer(rf"(?:^|[.;:] ){pattern}", plain):
                found.append(f"{name}:{line}: {match.group()!r} → {instead}")
    return found


# ---------- The words ----------


def test_files_do_not_use_other_words() -> None:
    found = [finding for path in files() for finding in findings(path)]
    assert not found, "\n".join(found)


# ---------- What is found, and what is not ----------


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ('"""A picture."""', ["'picture'"]),
        ("x = 1  # two samples a pixel", ["'samples a pixel'"]),
        ('"""Short.\n\nOf a miss, nothing.\n"""', ["'Of a miss,'"]),
        ('def f(k):\n    raise ValueError(f"{k}: the seam of {k} is open")', ["'seam'"]),
        ('"""Look at the truth. Ground truth."""', ["'truth'"]),
        ("x = 1  # tells the two poles apart", ["'tells the two poles apart'"]),
        ('picture = load("picture.png")  # `picture` is a pixel, see picture.png and picture_store', []),
        ('"""The figure stands for nothing; the law holds for all."""', []),
        ('"""It is a pixel, has a step; of course."""', []),
    ],
)
def test_forbidden_words_are_found(source: str, words: list[str], tmp_path: Path) -> None:
    path = tmp_path / "text.py"
    path.write_text(source)
    found = findings(path)
    assert len(found) == len(words), found
    assert all(word in line for word, line in zip(words, found, strict=True)), found


def test_code_of_pages_is_not_prose(tmp_path: Path) -> None:
    path = tmp_path / "page.md"
    path.write_text(
        "# Images\n\n```python\npicture = 1\n```\n\n    picture\n\nA `picture` ([text](picture.md)).\n"
    )
    assert findings(path) == []
    path.write_text("# Pictures\n")
    assert [line.partition(": ")[0].rpartition(":")[2] for line in findings(path)] == ["1"]
