"""Middlebury's stereo sets of 2014 on (and ETH3D's two-view set): ``calib.txt`` with ``cam0``, ``cam1``, ``doffs``, ``baseline``.

Rectified: the second camera stands ``baseline`` (mm) to the right of the first; its principal point is ``doffs`` pixels farther right.
Images ``im0`` and ``im1``, pixel centres at integers.

Source: vision.middlebury.edu/stereo/data/scenes2014 ("Calibration file format").
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from .records import Found, Record
from .values import Entry, Float, Rows, head, known_file

NAMES = ("calib.txt", "calib_gray.txt")
LINE = re.compile(r"\s*(\w+)\s*=\s*(.*?)\s*$")


def find(path: Path) -> Path | None:
    """A file with ``cam0=[..]``, at the path or in the folder."""
    if path.is_dir():
        return known_file(path, NAMES, find)
    return path if path.suffix.lower() == ".txt" and re.match(r"\s*cam0\s*=", head(path)) else None


def read(path: Path) -> Found:
    """The left and the right view."""
    rows, values = Rows(path), {}
    for n, line in rows.content():
        if (parts := LINE.match(line)) is None:
            raise rows.fail(n, f"expected name=value, got {line!r:.40}")
        values[parts[1]] = Entry(parts[2], f"{path}:{n}", parts[1])
    root = Entry({k: v.value for k, v in values.items()}, path)
    for name in ("cam0", "cam1", "baseline"):
        root.need(name)
    baseline = values["baseline"].number()
    if not baseline > 0:
        raise values["baseline"].fail(f"expected a positive number of mm, got {baseline:g}")
    size = [values[n].pixels() if n in values else 0 for n in ("width", "height")]
    records = []
    for n, t in enumerate((0.0, -baseline)):
        image = Path(f"im{n}")
        records.append(Record(_matrix(values[f"cam{n}"]), np.eye(3), [t, 0, 0], *size, image=image, name=image.name))
    return Found(records, path)


def _matrix(entry: Entry) -> Float:
    return Entry(entry.text().strip("[]").replace(";", " ").split(), entry.source, entry.key).array(3, 3)
