"""Replica as rendered for iMAP and NICE-SLAM: ``traj.txt``, ``results/frame000000.jpg`` and ``cam_params.json``.

Each line of ``traj.txt`` is a 4 x 4 camera-to-world matrix in rows, OpenCV axes, metres. ``cam_params.json`` lies in the folder or its
parent; pixel centres at integers.

Source: NICE-SLAM, src/utils/datasets.py (class Replica) and scripts/download_replica.sh.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import FormatError
from .records import Found
from .trajectories import find_intrinsics, path_of, read_intrinsics
from .values import Rows, head, images_in, named

NAME = "traj.txt"
FOLDERS = ("results", "rgb", "color", "images")


def find(path: Path) -> Path | None:
    """``traj.txt`` with lines of 16 numbers."""
    if path.is_dir():
        path = named(path, NAME) or path / NAME
    lines = head(path).splitlines() if path.name.lower() == NAME else []
    return path if lines and len(lines[0].split()) > 8 else None


def read(path: Path) -> Found:
    """The frames in natural order."""
    intrinsics = find_intrinsics(path.parent, path.parent.parent)
    if intrinsics is None:
        raise FormatError(f"{path}: expected the intrinsics in cam_params.json beside it or in the folder above")
    rows = Rows(path)
    poses = [(n, np.array(rows.numbers(n, line.split(), 16)).reshape(4, 4)) for n, line in rows.content()]
    folder = next((n for n in FOLDERS if _colours(path.parent / n)), FOLDERS[0])
    files = [Path(folder) / f.name for f in _colours(path.parent / folder)]
    if len(files) != len(poses):  # some are missing, or all
        files = [Path(folder) / f"frame{n:06d}" for n in range(len(poses))]
    frames = [(f"{path}:{n}", pose, file) for (n, pose), file in zip(poses, files, strict=True)]
    return path_of(path, frames, read_intrinsics(intrinsics), lambda n: f"{n} frames have no pose")


def _colours(folder: Path) -> list[Path]:
    """The images of a folder that are no depth maps."""
    return [f for f in images_in(folder) if not f.name.startswith("depth")]
