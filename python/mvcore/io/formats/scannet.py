"""ScanNet's exported frames: ``color/N.jpg``, ``pose/N.txt`` and ``intrinsic/intrinsic_color.txt``.

A pose is camera to world, 4 x 4, OpenCV axes, metres; one with infinite values was lost by tracking and is left out. K is 4 x 4,
pixel centres at integers.

Source: ScanNet, SensReader/python/SensorData.py and its README ("Data Organization").
"""

from __future__ import annotations

from pathlib import Path

from ..pairing import natural_order
from .records import Found
from .trajectories import path_of, read_intrinsics, read_matrix
from .values import files_in, images_in, named

COLOURS = ("color", "rgb", "images")
INTRINSICS = ("intrinsic/intrinsic_color.txt", "intrinsics/intrinsic_color.txt", "intrinsic_color.txt", "intrinsics_color.txt",
              "intrinsic/intrinsics.txt")  # fmt: skip


def find(path: Path) -> Path | None:
    """The folder that holds ``pose`` and the intrinsics; a file in one of its folders stands for it."""
    if path.is_file():
        if path.suffix.lower() != ".txt" or path.parent.name not in ("pose", "intrinsic", "intrinsics"):
            return None
        path = path.parent.parent
    return path if _intrinsics(path) is not None and (path / "pose").is_dir() else None


def _intrinsics(path: Path) -> Path | None:
    return next((f for n in INTRINSICS if (f := named((path / n).parent, Path(n).name)) is not None), None)


def read(path: Path) -> Found:
    """The frames in natural order."""
    lens = read_intrinsics(_intrinsics(path) or path / INTRINSICS[0])
    folder = next((c for c in COLOURS if images_in(path / c)), COLOURS[0])
    poses = sorted(files_in(path / "pose", ".txt"), key=natural_order)
    frames = [(str(pose), read_matrix(pose), Path(folder) / pose.stem) for pose in poses]
    return path_of(path, frames, lens, lambda n: f"{n} of {len(frames)} frames have no pose and are left out")
