"""MVSNet / DTU: one ``*_cam.txt`` a view (4x4 world-to-camera, 3x3 intrinsics, depth range) and ``pair.txt``.

Its authors do not say where pixel centres are; mvcore takes them at integers.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import FormatError
from .places import IMAGE_FOLDERS, IMAGE_SUFFIXES, images_below
from .records import Found, Lines, Record

CAMERA = re.compile(r"^(\d+)_cam\.txt$", re.IGNORECASE)
FOLDERS = ("cams", "cams_1", "Cameras", "cameras", ".")


def find(path: Path) -> Path | None:
    """The scene's folder, if a folder of ``*_cam.txt`` is at the path."""
    if path.is_file():
        path = path.parent if CAMERA.match(path.name) or path.name.lower() == "pair.txt" else Path()
    if not path.is_dir() or path == Path():
        return None
    if path.name in FOLDERS and _cameras(path) and _cameras(path.parent):
        return path.parent
    return path if _cameras(path) else None


def _cameras(folder: Path) -> list[Path]:
    for name in FOLDERS:
        files = [f for f in (folder / name).iterdir() if CAMERA.match(f.name)] if (folder / name).is_dir() else []
        if files:
            return sorted(files, key=_number)
    return []


def _number(path: Path) -> int:
    return int(path.name.partition("_")[0])


def read(folder: Path) -> Found:
    """The views of a folder, by number; images have the same numbers, however many zeros lead them."""
    cameras = _cameras(folder)
    images = _images(folder, {_number(p) for p in cameras})
    records = []
    for path in cameras:
        name = path.name.partition("_")[0]
        records.append(replace(read_camera(path), image=images.get(_number(path)), name=name))
    return Found(records, folder)


def read_camera(path: Path) -> Record:
    """One ``*_cam.txt``, without its image. The last line, a depth range, may be missing."""
    lines = Lines(path)
    words = [n for n, line in enumerate(lines.lines, 1) if line.strip()]
    if len(words) < 9 or lines.lines[words[0] - 1].strip().lower() != "extrinsic":
        raise lines.fail(words[0] if words else 1, "expected 'extrinsic', four rows, 'intrinsic', three rows, a depth range")
    pose = np.array([lines.numbers(n, 4) for n in words[1:5]])
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise lines.fail(words[4], f"expected '0 0 0 1', got {lines.lines[words[4] - 1].strip():.60}")
    if lines.lines[words[5] - 1].strip().lower() != "intrinsic":
        raise lines.fail(words[5], "expected 'intrinsic'")
    matrix = np.array([lines.numbers(n, 3) for n in words[6:9]])
    if len(words) > 9 and len(lines.numbers(words[9])) not in (2, 3, 4):
        raise lines.fail(words[9], "expected 'DEPTH_MIN DEPTH_INTERVAL [DEPTH_NUM DEPTH_MAX]'")
    return Record(K=matrix, R=pose[:3, :3], t=pose[:3, 3], name=path.stem, line=words[0])


def _images(folder: Path, numbers: set[int]) -> dict[int, Path]:
    """Images by the number that is their whole name, of the first usual folder that has some of the numbers."""
    for name in (*IMAGE_FOLDERS, "."):
        files = images_below(folder / name) if name != "." else [f for f in folder.iterdir() if f.is_file()]
        by_number = {int(f.stem): f for f in reversed(files) if f.stem.isdecimal() and f.suffix.lower() in IMAGE_SUFFIXES}
        if numbers & set(by_number):
            return by_number
    return {}


def read_pairs(path: Path) -> list[list[tuple[int, float]]]:
    """``pair.txt``: for each view its sources with their scores, best first."""
    lines = Lines(path)
    (count,) = lines.numbers(1, 1)
    if not 0 <= count == int(count) or 2 * count + 1 > len(lines.lines):
        raise lines.fail(1, f"expected a number of views with two lines each, got {count:g} views and {len(lines.lines)} lines")
    pairs: list[list[tuple[int, float]]] = [[] for _ in range(int(count))]
    for n in range(int(count)):
        (view,) = lines.numbers(2 * n + 2, 1)
        row = lines.numbers(2 * n + 3)
        if not 0 <= int(view) < int(count) or not row or len(row) != 2 * int(row[0]) + 1:
            raise FormatError(f"{path}:{2 * n + 3}: expected 'N id score id score ..' for an existing view")
        pairs[int(view)] = [(int(row[1 + 2 * k]), row[2 + 2 * k]) for k in range(int(row[0]))]
    return pairs
