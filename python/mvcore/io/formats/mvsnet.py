"""MVSNet / DTU: one ``*_cam.txt`` a view (4x4 world-to-camera, 3x3 intrinsics, depth range) and ``pair.txt``.

Its authors do not say where pixel centres are; mvcore takes them at integers.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import FormatError
from .records import IMAGE_SUFFIXES, Found, Lines, Record

CAMERA = re.compile(r"^(\d+)_cam\.txt$")
FOLDERS = ("cams", "cams_1", "Cameras", "cameras", ".")


def find(path: Path) -> Path | None:
    """The scene's folder, if a folder of ``*_cam.txt`` is at the path."""
    if path.is_file():
        path = path.parent if CAMERA.match(path.name) or path.name == "pair.txt" else Path()
    if not path.is_dir() or path == Path():
        return None
    return path if _cameras(path) else (path.parent if path.name in FOLDERS and _cameras(path.parent) else None)


def _cameras(folder: Path) -> list[Path]:
    for name in FOLDERS:
        files = [f for f in (folder / name).glob("*_cam.txt") if CAMERA.match(f.name)] if (folder / name).is_dir() else []
        if files:
            return sorted(files)
    return []


def read(folder: Path) -> Found:
    """The views of a folder, by number."""
    return Found([_view(folder, path) for path in _cameras(folder)], folder)


def _view(folder: Path, path: Path) -> Record:
    record = read_camera(path)
    stem = path.name.removesuffix("_cam.txt")
    return replace(record, image=_image(folder, stem) or folder / "images" / f"{stem}.jpg", name=stem)


def read_camera(path: Path) -> Record:
    """One ``*_cam.txt``, without its image."""
    lines = Lines(path)
    words = [n for n, line in enumerate(lines.lines, 1) if line.strip()]
    if len(words) < 10 or lines.lines[words[0] - 1].strip() != "extrinsic":
        raise lines.fail(words[0] if words else 1, "expected 'extrinsic', four rows, 'intrinsic', three rows, a depth range")
    pose = np.array([lines.numbers(n, 4) for n in words[1:5]])
    if lines.lines[words[5] - 1].strip() != "intrinsic":
        raise lines.fail(words[5], "expected 'intrinsic'")
    matrix = np.array([lines.numbers(n, 3) for n in words[6:9]])
    if len(lines.numbers(words[9])) not in (2, 3, 4):
        raise lines.fail(words[9], "expected 'DEPTH_MIN DEPTH_INTERVAL [DEPTH_NUM DEPTH_MAX]'")
    return Record(K=matrix, R=pose[:3, :3], t=pose[:3, 3], name=path.stem, line=words[0])


def _image(folder: Path, stem: str) -> Path | None:
    for base in (folder / "images", folder / "blended_images", folder / "image", folder):
        for suffix in IMAGE_SUFFIXES:
            for name in (stem, f"{int(stem):06d}", f"{int(stem):04d}"):
                if (base / f"{name}{suffix}").is_file():
                    return base / f"{name}{suffix}"
    return None


def read_pairs(path: Path) -> list[list[tuple[int, float]]]:
    """``pair.txt``: for each view its sources with their scores, best first."""
    lines = Lines(path)
    (count,) = lines.numbers(1, 1)
    pairs: list[list[tuple[int, float]]] = [[] for _ in range(int(count))]
    for n in range(int(count)):
        (view,) = lines.numbers(2 * n + 2, 1)
        row = lines.numbers(2 * n + 3)
        if not 0 <= int(view) < int(count) or not row or len(row) != 2 * int(row[0]) + 1:
            raise FormatError(f"{path}:{2 * n + 3}: expected 'N id score id score ..' for an existing view")
        pairs[int(view)] = [(int(row[1 + 2 * k]), row[2 + 2 * k]) for k in range(int(row[0]))]
    return pairs
