"""Bundler v0.3 ``bundle.out`` with the list of its images (also of VisualSFM, Pix4D, RealityCapture and COLMAP exports).

World-to-camera, the camera looks along -z, y up: p = -P / P_z and p' = f (1 + k1 |p|² + k2 |p|⁴) p, with the origin in the image's
middle, x right and y up. So the y and z rows of R and t change sign, and k1, k2 are OpenCV's. Cameras with f = 0 were not
reconstructed and are left out. Image sizes come from the images.

Source: Bundler v0.4 User's Manual, "Output format and scene representation".
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...errors import FormatError, InvalidInputError
from ...geometry.cameras import rotation_from
from ..limits import read_text
from .lens import brown
from .places import images_below
from .poses import OPENGL
from .records import Found, Record
from .values import Float, Rows, files_in, head, images_in

FIRST = re.compile(r"\s*#\s*Bundle file v0\.[0-9]+")
LIST_LINE = re.compile(r"^(.*?\S)(?:[ \t]+0[ \t]+[0-9.eE+-]+)?$")
"""A name, and for some images ``0`` and the focal length of their EXIF data."""
MOST_CAMERAS = 1_000_000


def find(path: Path) -> Path | None:
    """A bundle file, or the only one in a folder or its ``bundle`` folder."""
    if path.is_file():
        return path if FIRST.match(head(path)) else None
    for folder in (path, path / "bundle"):
        files = [f for f in files_in(folder, ".out") if FIRST.match(head(f))]
        named = [f for f in files if f.name.lower() in ("bundle.out", "bundle.rd.out")]
        if len(named or files) == 1 or named:
            return (named or files)[0]
    return None


def read(path: Path, images: Path | None = None) -> Found:
    """The reconstructed cameras in the list's order."""
    rows = Rows(path)
    content = rows.content()
    line, first = next(content, (1, ""))
    count = int(rows.numbers(line, first.split(), 2)[0])
    if not 0 < count <= min(MOST_CAMERAS, len(rows.lines)):
        raise rows.fail(line, f"expected a number of cameras that the file can hold, got {count}")
    names, warnings = _names(path, count, images)
    records = []
    for n in range(count):
        lines = [next(content, (len(rows.lines), "")) for _ in range(5)]
        f, k1, k2 = rows.numbers(lines[0][0], lines[0][1].split(), 3)
        matrix = np.array([rows.numbers(at, text.split(), 3) for at, text in lines[1:4]])
        t = np.array(rows.numbers(lines[4][0], lines[4][1].split(), 3))
        if f:
            records.append(_record(rows, lines[0][0], names[n], (f, k1, k2), matrix, t))
    if len(records) < count:
        warnings.append(f"{path.name}: {count - len(records)} of {count} images are not reconstructed and left out")
    return Found(records, path, warnings=tuple(warnings))


def _record(rows: Rows, line: int, name: str, lens: tuple[float, ...], matrix: Float, t: Float) -> Record:
    f, k1, k2 = lens
    if f < 0:
        raise rows.fail(line, f"expected a positive focal length, got {f:g}")
    try:
        r = OPENGL @ rotation_from(matrix)
    except InvalidInputError as error:
        raise rows.fail(line + 1, str(error)) from None

    def k(width: int, height: int) -> Float:
        return np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]])

    return Record(k, r, OPENGL @ t, image=Path(name), name=name, distortion=brown(k1, k2), line=line)


def _names(path: Path, count: int, images: Path | None) -> tuple[list[str], list[str]]:
    """The image names, from a list beside the file or, in order, the images themselves; and warnings."""
    beside = [path.with_name(path.name + ".list.txt"), path.with_name(path.stem + ".list.txt")]
    for folder in (path.parent, path.parent.parent):
        beside += [folder / n for n in ("list.txt", "imagelist.txt", "image_list.txt", "list_focal.txt", "pictures.txt")]
        beside += [f for f in files_in(folder, ".txt") if "list" in f.name.lower()]
    for file in beside:
        if file.is_file():
            lines = [LIST_LINE.match(line.strip())[1] for line in read_text(file).splitlines() if line.strip()]  # type: ignore[index]
            if len(lines) == count:
                return lines, []
    files = images_below(images) if images is not None else images_in(path.parent / "images") or images_in(path.parent)
    if len(files) != count:
        raise FormatError(f"{path}: expected a list of its {count} images beside it (list.txt), or {count} images, found {len(files)}")
    warning = f"{path.name}: no list.txt: its {count} cameras take the images in order of their names"
    return [str(f) for f in files], [warning]
