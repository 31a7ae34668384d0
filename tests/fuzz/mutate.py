"""Seeded mutations of a file's bytes: bits, spans, tokens, splices, ends."""

from __future__ import annotations

import random
import re

NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
WORD = re.compile(rb"[A-Za-z_][A-Za-z_0-9]*")
VALUES = (
    *(b"0", b"-1", b"1", b"nan", b"inf", b"-inf", b"1e308", b"1e-320", b"2147483648", b"4294967296", b"9223372036854775808"),
    b"9" * 25,
    b"9" * 5000,
    b"1e5",
    b"1.5",
    b"00",
    b"null",
    b"true",
    b"{}",
    b"[]",
    b'""',
    b"x",
    b"../../../etc/passwd",
    b"/dev/zero",
    b"\xff",
    b"\x00",
)
TOKENS = (
    b"[",
    b"]",
    b"{",
    b"}",
    b"(",
    b"<",
    b">",
    b"&a",
    b"*a",
    b"!!",
    b": ",
    b"- ",
    b",",
    b'"',
    b"'",
    b"\n",
    b"\t",
    b"#",
    b"\\",
    b"%",
    b"\n\n\n",
)
INTEGERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x7FFFFFFFFFFFFFFF, 0xFFFFFFFFFFFFFFFF)


def mutated(data: bytes, other: bytes, random: random.Random) -> bytes:
    """One to four mutations of ``data``; splices take parts of ``other``."""
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        data = random.choice(MUTATIONS)(data, other, random)[: 1 << 20]
    return data


def _span(data: bytes, random: random.Random, longest: int = 64) -> tuple[int, int]:
    start = random.randrange(len(data) + 1)
    return start, min(len(data), start + random.randrange(1, longest))


def _bits(data: bytes, _: bytes, random: random.Random) -> bytes:
    out = bytearray(data)
    for _ in range(random.choice((1, 1, 3, 10)) if out else 0):
        out[random.randrange(len(out))] ^= 1 << random.randrange(8)
    return bytes(out)


def _byte(data: bytes, _: bytes, random: random.Random) -> bytes:
    start, _ = _span(data, random)
    return data[:start] + bytes([random.randrange(256)]) + data[start + 1 :]


def _cut(data: bytes, _: bytes, random: random.Random) -> bytes:
    start, end = _span(data, random)
    return data[:start] + data[end:]


def _end(data: bytes, _: bytes, random: random.Random) -> bytes:
    return data[: random.randrange(len(data) + 1)]


def _repeated(data: bytes, _: bytes, random: random.Random) -> bytes:
    start, end = _span(data, random)
    return data[:end] + data[start:end] * random.choice((1, 2, 100, 5000)) + data[end:]


def _integer(data: bytes, _: bytes, random: random.Random) -> bytes:
    width = random.choice((1, 2, 4, 8))
    start = random.randrange(max(1, len(data) - width))
    value = random.choice(INTEGERS) & (1 << 8 * width) - 1
    return data[:start] + value.to_bytes(width, random.choice(("little", "big"))) + data[start + width :]


def _replaced(pattern: re.Pattern[bytes]):
    def mutation(data: bytes, _: bytes, random: random.Random) -> bytes:
        places = list(pattern.finditer(data[:200_000]))
        if not places:
            return data
        place = random.choice(places)
        with_ = random.choice(places)[0] if random.random() < 0.4 else random.choice(VALUES)
        return data[: place.start()] + with_ + data[place.end() :]

    return mutation


def _token(data: bytes, _: bytes, random: random.Random) -> bytes:
    start, _ = _span(data, random)
    return data[:start] + random.choice(TOKENS) * random.choice((1,) * 12 + (2, 2, 200, 200, 2000, 20_000)) + data[start:]


def _line(data: bytes, _: bytes, random: random.Random) -> bytes:
    lines = data.split(b"\n")
    at, to = random.randrange(len(lines)), random.randrange(len(lines))
    line = lines[at]
    if random.random() < 0.5:
        del lines[at]
    lines.insert(to, line)
    return b"\n".join(lines)


def _splice(data: bytes, other: bytes, random: random.Random) -> bytes:
    return data[: random.randrange(len(data) + 1)] + other[random.randrange(len(other) + 1) :]


MUTATIONS = (_bits, _byte, _cut, _end, _repeated, _integer, _replaced(NUMBER), _replaced(NUMBER), _replaced(WORD), _token, _line, _splice)
