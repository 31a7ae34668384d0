"""VisualSFM ``.nvm`` (NVM_V3).

A camera a line: file name, focal length, quaternion w x y z (world to camera, OpenCV axes), centre, radial coefficient, 0. The
coefficient belongs to the *measured* point relative to the image's middle and is normalised by the focal length: with m the measured
point over f, (1 + r |m|²) m = (X / Z, Y / Z). OpenCV's model runs the other way, so its rational model is fitted to the inverse
(`lens.measured`). ``NVM_V3 FixedK fx cx fy cy`` fixes K for all, in pixels from the corner. Only the first model is read.

Sources: VisualSFM documentation, "NVM format" (ccwu.me/vsfm/doc.html); Multicore Bundle Adjustment (PBA), util.h (LoadNVM) and
DataInterface.h (SetNormalizedMeasurementDistortion).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...errors import InvalidInputError
from ...geometry.cameras import rotation_from
from .lens import corner_radius, measured
from .poses import from_center, quaternion
from .records import Found, Record
from .values import Float, Rows, files_in, head

COUNTS = {"NVM_V3": 10, "NVM_V3_R9T": 15}
"""Numbers of a camera: focal length, quaternion and centre, or R (9) and t (3), radial term, 0."""
CAMERAS = {n: re.compile(rf'^(?:"(?P<quoted>[^"]*)"|(?P<name>.*\S))\s+(?P<numbers>(?:\S+\s+){{{n - 1}}}\S+)$') for n in COUNTS.values()}
"""A name, which may hold spaces, before so many numbers."""


def find(path: Path) -> Path | None:
    """An NVM file, or the only one in a folder."""
    if path.is_file():
        return path if head(path).startswith("NVM_V") else None
    files = [f for f in files_in(path, ".nvm") if find(f)]
    return files[0] if len(files) == 1 else None


def read(path: Path) -> Found:
    """The cameras of the first model, in its order."""
    rows = Rows(path)
    content = rows.content()
    line, first = next(content, (1, ""))
    words = first.split()
    if not words or words[0] not in COUNTS:
        raise rows.fail(line, f"expected NVM_V3, got {first!r:.30}")
    numbers = COUNTS[words[0]]
    fixed = _fixed(rows, line, words[1:])
    line, text = next(content, (len(rows.lines), ""))
    count = rows.numbers(line, text.split(), 1)[0]
    if not 0 < count <= len(rows.lines) or count != int(count):
        raise rows.fail(line, f"expected a number of cameras that the file can hold, got {text!r:.30}")
    cameras = [next(content, (len(rows.lines), "")) for _ in range(int(count))]
    return Found([_record(rows, at, camera, fixed, numbers) for at, camera in cameras], path)


def _fixed(rows: Rows, line: int, words: list[str]) -> Float | None:
    if not words or words[0] != "FixedK":
        return None
    fx, cx, fy, cy = rows.numbers(line, words[1:], 4)
    return np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])


def _record(rows: Rows, line: int, text: str, fixed: Float | None, count: int) -> Record:
    parts = CAMERAS[count].match(text)
    if parts is None:
        raise rows.fail(line, f"expected a file name and {count} numbers, got {text!r:.60}")
    name = parts["quoted"] or parts["name"].replace('"', " ")  # which stand for blanks
    f, *pose, radial, _ = rows.numbers(line, parts["numbers"].split(), count)
    if f <= 0:
        raise rows.fail(line, f"expected a positive focal length, got {f:g}")
    try:
        if len(pose) == 12:
            r, t = rotation_from(np.reshape(pose[:9], (3, 3))), np.array(pose[9:])
        else:
            r, t = from_center(quaternion(*pose[:4]), np.array(pose[4:]))
    except InvalidInputError as error:
        raise rows.fail(line, str(error)) from None

    def matrix(width: int, height: int) -> Float:
        return fixed if fixed is not None else np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]])

    def lens(width: int, height: int) -> list[float]:
        values = measured(radial, f, corner_radius(matrix(width, height), width, height))
        if values is None:
            raise rows.fail(line, f"the radial distortion {radial:g} turns back within the image")
        return values

    return Record(matrix, r, t, image=Path(name), name=name, distortion=lens if radial else (), line=line)
