"""Mutations of a file, decided by a seeded generator: the same seed makes the same file."""

from __future__ import annotations

import json
import random
import re
import struct
from typing import Any

NUMBERS = (
    *"0 -1 1 2 3 255 256 65535 65536 2147483647 2147483648 4294967295 -2147483648 1000000000000".split(),
    *"9223372036854775807 18446744073709551616 1e9 1e38 1e39 1e308 1e309 -1e309 1e-45 1e-320 nan".split(),
    *"inf -inf NaN Infinity -Infinity 0x10 1_000 +1 007 1.5 -0.0".split(),
    *("9" * 400, "9" * 5000, "0x" + "f" * 6000),
)
WORDS = (
    *". .. / ../x ../../etc/passwd /etc/passwd a/../../b ./r_0.png ~ %s%n {} vertex face RGB nan".split(),
    *"true null http://127.0.0.1/x file:///etc/passwd C:\\x con __class__ iteration k1 pixel".split(),
    *("", "a\x00b", "x" * 5000, "ä" * 300, "\ud800", "\x1b[2J", "\n"),
)
INTEGERS = (0, 1, 2, 0x7F, 0x80, 0xFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 100_000, 1 << 28)
TOML_VALUES = (
    *(*NUMBERS, *map(json.dumps, WORDS)),
    *("[]", "{}", "true", "[1, 2]", "1979-05-27", "[" * 5000, "{ a = { b = 1 } }", '"""x', "[[[1]]]"),
    "{ start = 0, until = 1, every = 0 }",
)
XML_VALUES = (*NUMBERS, *WORDS, "1, 2, 3", "pixel", "surfel", "radiance", "n:normal, n:depth", "&g;")
XML_TYPES = "string float integer boolean rgb vector spectrum ref transform".split()
XML_NAMES = (
    "light opacity background mesh terms aovs occlusion diffuse x filename traced_bounces visibility_rays "
    "to_world id scale"
).split()


def mutate(data: bytes, others: list[bytes], kind: str, rng: random.Random) -> bytes:
    """Another file made of `data`, of `others` of its kind, and of nasty values.

    `kind` names the structure: "json", "xml" and "toml" are changed by their values two times in three.
    """
    change = {"json": _json, "xml": _xml, "toml": _toml}.get(kind)
    if change is not None and rng.random() < 0.67:
        return change(data, rng)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 8))):
        data = _bytes(data, others, rng)
    return data


# ---------------- bytes ----------------


def _at(data: bytes, rng: random.Random) -> int:
    """A place; headers, which come first, are as likely as all the rest."""
    return rng.randrange(max(1, min(len(data), 600) if rng.random() < 0.5 else len(data)))


def _bytes(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """One change at a place of the file: flipped, set, cut, removed, repeated, inserted, spliced, a number or
    a line."""
    i = _at(data, rng)
    head, tail = data[:i], data[i:]
    match rng.randrange(12):
        case 0 | 1:
            return head + bytes([tail[0] ^ 1 << rng.randrange(8)]) + tail[1:] if tail else data
        case 2 | 3:
            value, real = rng.choice(INTEGERS), float(rng.choice(("nan", "inf", "1e38")))
            formats = (("<B", value & 255), ("<I", value), (">I", value), ("<Q", value << 16), ("<f", real))
            word = struct.pack(*rng.choice(formats))
            return head + word + tail[len(word) :]
        case 4:
            return head
        case 5:
            return head + tail[rng.choice((1, 2, 4, 16, 100)) :]
        case 6:
            return head + tail[: rng.choice((1, 4, 30, 200))] * rng.choice((2, 3, 50)) + tail
        case 7:
            return head + rng.randbytes(rng.choice((1, 2, 8, 64))) + tail
        case 8:
            other = rng.choice(others)
            return head + other[_at(other, rng) :]
        case 9 | 10:
            return _number(data, rng)
        case _:
            return _line(data, rng)


def _number(data: bytes, rng: random.Random) -> bytes:
    """Another number in the place of one that is written in digits."""
    found = list(re.finditer(rb"[-+]?\d[\d.e+-]*", data[:4096]))
    if not found:
        return data
    old = rng.choice(found)
    return data[: old.start()] + rng.choice(NUMBERS).encode() + data[old.end() :]


def _line(data: bytes, rng: random.Random) -> bytes:
    """Remove, repeat or move a line of text."""
    lines = data.split(b"\n")
    line = lines.pop(rng.randrange(min(len(lines), 40)))
    for _ in range(rng.choice((0, 1, 1, 2))):
        lines.insert(rng.randrange(min(len(lines), 40) + 1), line)
    return b"\n".join(lines)


# ---------------- structures ----------------


def _nasty(rng: random.Random, depth: int = 0) -> Any:
    """A value that nobody expects."""
    match rng.randrange(9 if depth < 3 else 6):
        case 0:
            return rng.choice((None, True, False, 0, 1, -1, 1.5, 10**18, 10**400, -(10**18)))
        case 1 | 2:
            return rng.choice((float("nan"), float("inf"), -float("inf"), 1e308, 1e-320, 1e9, -0.0, 3))
        case 3 | 4 | 5:
            return rng.choice(WORDS)
        case 6:
            return [_nasty(rng, depth + 1) for _ in range(rng.randrange(5))]
        case 7:
            return {rng.choice(WORDS): _nasty(rng, depth + 1) for _ in range(rng.randrange(4))}
        case _:
            return [[_nasty(rng, 3)] * 4] * 4


def _json(data: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.05:
        deep = rng.choice(("[", '{"a":', '{"frames":[', '[[{"a":['))
        return (deep * rng.choice((500, 2000, 100_000)) + rng.choice(("", "1", "]"))).encode()
    content = json.loads(data.split(b"\n{")[0])
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        value, place = content, None
        # A walk from the top: an inner value is as likely as a leaf.
        while isinstance(value, dict | list) and value and (place is None or rng.random() < 0.6):
            key = rng.choice(list(value)) if isinstance(value, dict) else rng.randrange(len(value))
            place, value = (value, key), value[key]
        if place is None:
            break
        container, key = place
        match rng.randrange(6):
            case 0:
                del container[key]
            case 1 if isinstance(container, dict):
                container[rng.choice(WORDS)] = container.pop(key)
            case 2 if isinstance(container, list):
                container.insert(key, rng.choice((container[key], _nasty(rng))))
            case _:
                container[key] = _nasty(rng)
    return json.dumps(content, allow_nan=True).encode(errors="surrogatepass")


def _toml(data: bytes, rng: random.Random) -> bytes:
    lines = data.decode().split("\n")
    for _ in range(rng.choice((1, 1, 2, 4))):
        i = rng.randrange(len(lines))
        assigned = f"{lines[i].partition('=')[0]}= {rng.choice(TOML_VALUES)}"
        dropped, table = f"drop = {rng.choice(TOML_VALUES)}", f"[{rng.choice(WORDS)}]"
        lines[i] = rng.choice((assigned, assigned, table, "", lines[i] * 2, dropped))
        if rng.random() < 0.2:
            lines.insert(0, rng.choice((f"extends = {rng.choice(TOML_VALUES)}", "a." * 3000 + "a = 1")))
    return "\n".join(lines).encode(errors="surrogatepass")


def _xml(data: bytes, rng: random.Random) -> bytes:
    text = data.decode()
    for _ in range(rng.choice((1, 1, 2, 4))):
        value = re.sub('["<\0]', "", rng.choice(XML_VALUES))
        old = rng.choice(list(re.finditer(r'"([^"]*)"', text)))
        text = text[: old.start(1)] + value + text[old.end(1) :]
        if rng.random() < 0.3:
            added = f'<{rng.choice(XML_TYPES)} name="{rng.choice(XML_NAMES)}" value="{value}"/>'
            text = text.replace("</integrator>", f"{added}</integrator>")
    if rng.random() < 0.1:
        bomb = "".join(f'<!ENTITY {b} "{f"&{a};" * 50}">' for a, b in zip("abcdef", "bcdefg", strict=True))
        text = f'<!DOCTYPE x [<!ENTITY a "aaaa">{bomb}<!ENTITY f SYSTEM "file:///etc/passwd">]>' + text
    return text.encode(errors="surrogatepass")
