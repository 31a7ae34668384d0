"""RealityCapture and RealityScan: CSV of "Internal/External camera parameters".

``#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2``; a template may leave out columns from px on. x, y, alt is the centre;
camera-to-world is Rz(-heading) Rx(pitch) Ry(roll) in degrees, camera axes x right, y up, z back. f is the 35 mm equivalent focal
length: f / 36 times the longer side is in pixels; px and py are offsets of the principal point from the image's centre in longer
sides. k1 .. k4 are Brown's radial terms (r² .. r⁸), t1 and t2 are OpenCV's p1 and p2. Image sizes come from the images.

Sources: nerfstudio's realitycapture_utils.py (with its pull request 3131 on px and py); "RealityCapture XMP Camera Math", whose image
coordinates run over the longer side; Brush's formats/reality_capture.rs.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from ...errors import FormatError
from ..limits import read_text
from .lens import corner_radius, polynomial
from .poses import OPENGL, from_center
from .records import Found, Record
from .values import Entry, Float, files_in, head

NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
FILM = 36.0
"""Width of a 35 mm film in mm."""


def find(path: Path) -> Path | None:
    """A CSV file with these columns, or the only one in a folder."""
    if path.is_file():
        return path if path.suffix.lower() in (".csv", ".txt") and _columns(head(path)) else None
    files = [f for f in files_in(path, ".csv") if find(f)]
    return files[0] if len(files) == 1 else None


def _columns(text: str) -> list[str]:
    """The columns that the first line with them names; none where there is no such line."""
    for line in text.splitlines()[:5]:
        names = [n.strip().lstrip("#").strip().lower() for n in next(csv.reader([line], delimiter=_delimiter(line)), [])]
        if set(NEEDED) <= set(names):
            return names
    return []


def _delimiter(line: str) -> str:
    return max(",;\t", key=line.count)


def read(path: Path) -> Found:
    """The cameras in the file's order."""
    text = read_text(path)
    names = _columns(text)
    if not names:
        raise FormatError(f"{path}:1: expected the columns {', '.join(NEEDED)}")
    records = []
    for n, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#") or _columns(line):
            continue
        try:
            words = next(csv.reader([line], delimiter=_delimiter(line)))
        except csv.Error as error:
            raise FormatError(f"{path}:{n}: not CSV: {error}") from None
        if len(words) < len(names):
            raise FormatError(f"{path}:{n}: expected {len(names)} columns, got {len(words)}")
        records.append(_record(path, n, dict(zip(names, words, strict=False))))
    return Found(records, path)


def _record(path: Path, line: int, row: dict[str, str]) -> Record:
    def v(name: str) -> float:
        return Entry(row[name].strip(), f"{path}:{line}", name).number() if row.get(name, "").strip() else 0.0

    for name in NEEDED[1:]:
        Entry(row[name].strip(), f"{path}:{line}", name).number()
    name = row["name"].strip()
    r, t = from_center(_rotation(v("heading"), v("pitch"), v("roll")), np.array([v("x"), v("y"), v("alt")]))
    if v("f") <= 0:
        raise FormatError(f"{path}:{line}: f: expected a positive focal length, got {v('f'):g}")

    def matrix(width: int, height: int) -> Float:
        longer = max(width, height)
        f = v("f") / FILM * longer
        return np.array([[f, 0, width / 2 + v("px") * longer - 0.5], [0, f, height / 2 + v("py") * longer - 0.5], [0, 0, 1]])

    def lens(width: int, height: int) -> list[float]:
        k = matrix(width, height)
        values = polynomial([v(f"k{n}") for n in range(1, 5)], v("t1"), v("t2"), k[0, 0], corner_radius(k, width, height))
        if values is None:
            raise FormatError(f"{path}:{line}: the distortion with k4 = {v('k4'):g} turns back within the image")
        return values

    return Record(matrix, r, t, image=Path(name), name=name, distortion=lens, line=line)


def _rotation(heading: float, pitch: float, roll: float) -> Float:
    """World to camera (OpenCV axes) from degrees."""
    (sz, sx, sy), (cz, cx, cy) = (f(np.radians([-heading, pitch, roll])) for f in (np.sin, np.cos))
    z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return OPENGL @ (z @ x @ y).T
