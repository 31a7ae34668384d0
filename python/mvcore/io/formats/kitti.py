"""KITTI: ``calib.txt`` of the odometry and object sets (``P0: ..`` to ``P3: ..``) and ``calib_cam_to_cam.txt`` (``P_rect_00: ..``).

P is 3 x 4 from the rectified first camera to the pixels of each camera, x ~ P X: K [I | b], OpenCV axes, metres, pixel centres at
integers. Cameras 0 and 1 are grey, 2 and 3 colour: the colour ones are read where they have images. ``poses.txt`` (or the sequence's
file in ``poses``) holds the first camera's pose, camera to world, 3 x 4 a frame; without it only the first frame is read, for the car
moves.

Source: KITTI odometry development kit, readme.txt; Geiger et al., "Vision meets Robotics: The KITTI Dataset", 2013, section IV.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...errors import FormatError
from .records import Found, Record
from .trajectories import record
from .values import Float, Rows, head, images_in, known_file, named

LINE = re.compile(r"\s*P(?:_rect_0)?([0-3])\s*:")
NAMES = ("calib.txt", "calib_cam_to_cam.txt")
PAIRS = (("2", "3"), ("0", "1"))


def find(path: Path) -> Path | None:
    """A file with projection matrices, at the path or in the folder."""
    if path.is_dir():
        return known_file(path, NAMES, find)
    lines = head(path, 1 << 16).splitlines() if path.suffix.lower() == ".txt" else []
    return path if sum(LINE.match(line) is not None for line in lines) >= 2 else None


def read(path: Path) -> Found:
    """The cameras of each frame that has a pose, or of the first frame."""
    cameras = _cameras(path)
    folders = {n: _folder(path.parent, n) for n in cameras}
    files = {n: images_in(f) if f is not None else [] for n, f in folders.items()}
    single = path.stem if path.parent.name == "calib" else None  # the object set: one file a frame
    pair = next((p for p in PAIRS if all(files.get(n) for n in p)), None) or next((p for p in PAIRS if all(n in cameras for n in p)), ())
    if not pair:
        raise FormatError(f"{path}: expected P0 and P1, or P2 and P3")
    poses = _poses(path.parent)
    count = min((len(files[n]) for n in pair), default=0)
    warnings: tuple[str, ...] = ()
    if poses is None and count > 1 and single is None:
        warnings = (f"{path.name}: no poses.txt: only the first of {count} frames is read",)
    frames = range(count if poses is not None else 1)
    if poses is not None and len(poses) < count:
        raise FormatError(f"{path.parent}: expected {count} poses as there are images, got {len(poses)}")
    records = []
    for frame in frames:
        pose = np.eye(4)[:3] if poses is None else poses[frame]
        records += [_record(path, cameras[n], pose, _image(files[n], frame, single, path.parent / f"image_{n}")) for n in pair]
    return Found(records, path, warnings=warnings)


def _cameras(path: Path) -> dict[str, Float]:
    rows, out = Rows(path), {}
    for n, line in rows.content():
        if (start := LINE.match(line)) is not None:
            out[start[1]] = np.array(rows.numbers(n, line[start.end() :].split(), 12)).reshape(3, 4)
            if not out[start[1]][0, 0] > 0 or abs(out[start[1]][2, 2] - 1) > 1e-6:
                raise rows.fail(n, "expected a projection matrix K [I | b] with K[2, 2] = 1")
    return out


def _folder(base: Path, number: str) -> Path | None:
    for root in (base, base.parent, base / "training"):
        for name in (f"image_{number}", f"image_0{number}", f"image_0{number}/data"):
            if images_in(root / name):
                return root / name
    return None


def _poses(folder: Path) -> list[Float] | None:
    for file in (named(folder, "poses.txt"), named(folder.parent.parent / "poses", f"{folder.name}.txt")):
        if file is not None:
            rows = Rows(file)
            return [np.array(rows.numbers(n, line.split(), 12)).reshape(3, 4) for n, line in rows.content()]
    return None


def _image(files: list[Path], frame: int, stem: str | None, folder: Path) -> Path:
    if stem is not None:
        return next((f for f in files if f.stem == stem), folder / f"{stem}.png")
    return files[frame] if frame < len(files) else folder / f"{frame:06d}.png"


def _record(path: Path, projection: Float, pose: Float, image: Path) -> Record:
    k = projection[:, :3]
    offset = np.linalg.solve(k, projection[:, 3])
    world = np.column_stack([pose[:, :3], pose[:, 3] - pose[:, :3] @ offset])
    return record(str(path), world, image, (k, [], 0, 0))
