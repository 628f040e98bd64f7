"""Mutations of a file, decided by a seeded generator: the same seed makes the same file."""

import json
import math
import random
import re
import struct
from typing import Any

NUMBERS = (
    *"0 -1 1 2 255 65536 2147483647 4294967295 -2147483648 9223372036854775807 1e38 1e39 1e309".split(),
    *"-1e309 1e-45 1e-320 nan inf Infinity 0x10 1_000 +1 1.5 -0.0".split(),
    *("9" * 400, "9" * 5000, "0x" + "f" * 6000),
)
WORDS = (
    *". .. / ../../etc/passwd /etc/passwd a/../../b ./r_0.png %s%n {} vertex face nan true null".split(),
    *"file:///etc/passwd __class__ iteration k1 pixel".split(),
    *("", "a\x00b", "x" * 5000, "\ud800", "\n"),
)
VALUES = (None, True, 0, -1, 1.5, 3, 10**18, -(10**18), 10**400, 1e9, 1e308, 1e-320, -0.0, math.nan, math.inf)
INTEGERS = (0, 1, 2, 0x7F, 0x80, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 100_000, 1 << 28)


def mutate(data: bytes, others: list[bytes], is_json: bool, rng: random.Random) -> bytes:
    """Another file made of `data`, of `others` of its kind, and of nasty values."""
    if is_json and rng.random() < 0.67:
        return _json(data, rng)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 8))):
        data = _bytes(data, others, rng)
    return data


def _at(data: bytes, rng: random.Random) -> int:
    """A place; headers, which come first, are as likely as all the rest."""
    return rng.randrange(max(1, min(len(data), 600) if rng.random() < 0.5 else len(data)))


def _bytes(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """One change at a place of the file."""
    i = _at(data, rng)
    head, tail = data[:i], data[i:]
    match rng.randrange(10):
        case 0 | 1 if tail:
            return head + bytes([tail[0] ^ 1 << rng.randrange(8)]) + tail[1:]
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
            other = rng.choice(others)
            return head + other[_at(other, rng) :]
        case _:  # another number in the place of one that is written in digits
            found = list(re.finditer(rb"[-+]?\d[\d.e+-]*", data[:4096]))
            old = rng.choice(found) if found else None
            return data[: old.start()] + rng.choice(NUMBERS).encode() + data[old.end() :] if old else head


def _nasty(rng: random.Random, depth: int = 0) -> Any:
    """A value that nobody expects."""
    kind = rng.randrange(6 if depth < 3 else 4)
    if kind < 4:
        return rng.choice(VALUES if kind < 2 else WORDS)
    inner = [_nasty(rng, depth + 1) for _ in range(rng.randrange(5))]
    return inner if kind == 4 else {rng.choice(WORDS): value for value in inner}


def _json(data: bytes, rng: random.Random) -> bytes:
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
        match rng.randrange(5):
            case 0:
                del container[key]
            case 1 if isinstance(container, dict):
                container[rng.choice(WORDS)] = container.pop(key)
            case _:
                container[key] = _nasty(rng)
    return json.dumps(content, allow_nan=True).encode(errors="surrogatepass")
