"""Strecha's ``image.jpg.camera``: K, a row of zeros, R (camera to world), the camera centre, width and height."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..pairing import natural_order
from .records import Found, Lines, Record
from .values import files_in


def find(path: Path) -> Path | None:
    """The folder of ``.camera`` files."""
    if path.is_file():
        return path.parent if path.suffix.lower() == ".camera" else None
    folders = sorted(f for f in path.iterdir() if f.is_dir() and not f.name.startswith("."))
    return next((f for f in (path, path / "images", path / "cameras", *folders) if files_in(f, ".camera")), None)


def read(folder: Path) -> Found:
    """The views of a folder, by name."""
    return Found([_view(folder, path) for path in sorted(files_in(folder, ".camera"), key=natural_order)], folder)


def _view(folder: Path, path: Path) -> Record:
    lines = Lines(path)
    k = np.array([lines.numbers(n, 3) for n in (1, 2, 3)])
    lines.numbers(4, 3)
    rotation = np.array([lines.numbers(n, 3) for n in (5, 6, 7)]).T
    center = np.array(lines.numbers(8, 3))
    width, height = lines.numbers(9, 2)
    if not (width > 0 and height > 0):
        raise lines.fail(9, f"expected width and height above 0, got {width:g} {height:g}")
    name = path.stem
    # The centre stays, also where R is rounded (`Camera`).
    return Record(K=k, R=rotation, t=-rotation @ center, width=int(width), height=int(height), image=Path(name), name=name, line=1)
