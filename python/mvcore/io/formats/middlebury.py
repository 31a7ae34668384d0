"""Middlebury multi-view ``*_par.txt``: ``name k11 .. k33 r11 .. r33 t1 t2 t3``, P = K [R t]; the box stands in README.txt."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...types import Bounds
from .records import Found, Lines, Record
from .values import files_in

# Digits are limited: the time to refuse a line of them alone would grow with the square of its length.
NUMBER = r"([-+]?(?:\d{1,40}(?:\.\d{0,40})?|\.\d{1,40})(?:[eE][-+]?\d{1,4})?)"
CORNER = re.compile(rf"^[ \t]*\([ \t]*{NUMBER}[ \t]+{NUMBER}[ \t]+{NUMBER}[ \t]*\)[ \t\r]*$", re.MULTILINE)
README = 1 << 20
"""Characters of a README in which the box is sought."""
NAME = re.compile(r'\s*(?:"([^"]+)"|(\S+))\s+(.*)')
"""A name, quoted where it has spaces, and the rest of a line."""


def find(path: Path) -> Path | None:
    """The file, if the path is one or holds one."""
    if path.is_file():
        return path if path.name.lower().endswith("_par.txt") else None
    return next((f for f in files_in(path, ".txt") if f.name.lower().endswith("_par.txt")), None)


def read(path: Path) -> Found:
    """The views of a par file."""
    lines = Lines(path)
    rows = [n for n, line in enumerate(lines.lines, 1) if line.strip()]
    (count,) = lines.numbers(rows[0] if rows else 1, 1)
    if not 0 <= count == int(count):
        raise lines.fail(rows[0], f"expected a number of views, got {count:g}")
    if len(rows) - 1 < count:
        raise lines.fail(len(lines.lines), f"expected {count:g} views, got {len(rows) - 1}")
    records = []
    for n in rows[1 : int(count) + 1]:
        match = NAME.match(lines.lines[n - 1])
        if match is None:
            raise lines.fail(n, "expected 'name k11 .. k33 r11 .. r33 t1 t2 t3'")
        name = match[1] or match[2]
        values = lines.numbers(n, 21, text=match[3])
        k, r, t = np.reshape(values[:9], (3, 3)), np.reshape(values[9:18], (3, 3)), values[18:]
        records.append(Record(K=k, R=r, t=t, image=Path(name), name=name, line=n))
    return Found(records, path, _bounds(path.parent))


def _bounds(folder: Path) -> Bounds | None:
    for readme in sorted(folder.glob("README*")):
        corners = CORNER.findall(_start(readme))
        if len(corners) == 2:
            box = np.array(corners, np.float64)
            return np.stack([box.min(0), box.max(0)])
    return None


def _start(path: Path) -> str:
    if not path.is_file():
        return ""
    with path.open(encoding="utf-8", errors="replace") as stream:
        return stream.read(README)
