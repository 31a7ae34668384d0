"""Middlebury multi-view ``*_par.txt``: ``name k11 .. k33 r11 .. r33 t1 t2 t3``, P = K [R t]; the box stands in README.txt."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...types import Bounds
from .records import Found, Lines, Record

NUMBER = r"[-+]?\d*\.?\d+(?:[eE][-+]?\d+)?"
CORNER = re.compile(rf"^\s*\(\s*({NUMBER})\s+({NUMBER})\s+({NUMBER})\s*\)\s*$", re.MULTILINE)


def find(path: Path) -> Path | None:
    """The file, if the path is one or holds one."""
    if path.is_file():
        return path if path.name.endswith("_par.txt") else None
    return next(iter(sorted(path.glob("*_par.txt"))), None)


def read(path: Path) -> Found:
    """The views of a par file."""
    lines = Lines(path)
    (count,) = lines.numbers(1, 1)
    records = []
    for n in range(2, int(count) + 2):
        values = lines.numbers(n, 21, skip=1)
        name = lines.lines[n - 1].split()[0]
        k, r, t = np.reshape(values[:9], (3, 3)), np.reshape(values[9:18], (3, 3)), values[18:]
        records.append(Record(K=k, R=r, t=t, image=path.parent / name, name=name, line=n))
    return Found(records, path, _bounds(path.parent))


def _bounds(folder: Path) -> Bounds | None:
    for readme in sorted(folder.glob("README*")):
        corners = CORNER.findall(readme.read_text(errors="replace"))
        if len(corners) == 2:
            box = np.array(corners, np.float64)
            return np.stack([box.min(0), box.max(0)])
    return None
