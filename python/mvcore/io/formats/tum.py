"""TUM RGB-D: ``groundtruth.txt`` (or another trajectory) and images by time, in ``rgb.txt`` or named by it.

``timestamp tx ty tz qx qy qz qw``: camera to world, OpenCV axes, metres. An image takes the pose nearest in time, at most `APART`
seconds away, as the benchmark's associate.py does; others are left out. The intrinsics come from a file beside it (see
`trajectories.read_intrinsics`) or, in a folder named after a sequence, from the benchmark's table. Pixel centres at integers.

Source: "Useful tools for the RGB-D benchmark" and "File formats" (vision.in.tum.de/data/datasets/rgbd-dataset).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...errors import FormatError, InvalidInputError
from .poses import quaternion
from .records import Found
from .trajectories import Lens, find_intrinsics, path_of, read_intrinsics
from .values import Float, Rows, head, images_in, known_file, named

NAMES = ("groundtruth.txt", "trajectory.txt", "CameraTrajectory.txt", "KeyFrameTrajectory.txt", "poses.txt", "traj.txt")
FOLDERS = ("rgb", "color", "images")
APART = 0.02
"""Seconds between an image and its pose."""
BENCHMARK = {
    "freiburg1": ((517.3, 516.5, 318.6, 255.3), [0.2624, -0.9531, -0.0054, 0.0026, 1.1633]),
    "freiburg2": ((520.9, 521.0, 325.1, 249.7), [0.2312, -0.7849, -0.0033, -0.0001, 0.9172]),
    "freiburg3": ((535.4, 539.2, 320.1, 247.6), []),
}
"""fx fy cx cy and k1 k2 p1 p2 k3 of the benchmark's cameras."""


def find(path: Path) -> Path | None:
    """A trajectory of eight numbers a line, at the path or in the folder."""
    if path.is_dir():
        return known_file(path, NAMES, find)
    lines = [line.split() for line in head(path).splitlines() if line.strip()] if path.suffix.lower() == ".txt" else []
    data = [line for line in lines if not line[0].startswith("#")]
    titled = any("qx" in line and "tx" in line for line in lines)
    fits = any(len(line) == 8 and all(_time(word) is not None for word in line) for line in data)
    return path if fits or (titled and not data) else None


def _time(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


def read(path: Path, images: Path | None = None) -> Found:
    """The images that have a pose, by time."""
    rows = Rows(path)
    times, poses = [], []
    for n, line in rows.content():
        time, tx, ty, tz, qx, qy, qz, qw = rows.numbers(n, line.split(), 8)
        try:
            pose = np.column_stack([quaternion(qw, qx, qy, qz), [tx, ty, tz]])
        except InvalidInputError as error:
            raise rows.fail(n, str(error)) from None
        times.append(time)
        poses.append((f"{path}:{n}", pose))
    if not poses:
        raise FormatError(f"{path}: no poses: expected lines 'timestamp tx ty tz qx qy qz qw'")
    order = np.argsort(times, kind="stable")
    known, frames = np.array(times)[order], []
    for time, image in sorted(_timed_images(path.parent, images)):
        at = int(np.clip(np.searchsorted(known, time), 1, len(known) - 1)) if len(known) > 1 else 0
        nearest = min({max(at - 1, 0), at}, key=lambda i: abs(known[i] - time))
        where, pose = poses[order[nearest]]
        near = abs(known[nearest] - time) <= APART
        frames.append((where, pose if near else None, image))
    if not frames:
        raise FormatError(f"{path}: no images named by their time, and no rgb.txt that lists them")
    return path_of(path, frames, _lens(path.parent), lambda n: f"{n} of {len(frames)} images have no pose within {APART} s")


def _timed_images(folder: Path, images: Path | None) -> list[tuple[float, Path]]:
    listed = named(folder, "rgb.txt")
    if listed is not None:
        rows = Rows(listed)
        found = [(rows.numbers(n, line.split()[:1])[0], line.split(None, 1)[1:]) for n, line in rows.content()]
        return [(time, Path(name[0])) for time, name in found if name]
    files = images_in(images) if images is not None else next((f for n in FOLDERS if (f := images_in(folder / n))), [])
    return [(time, Path(f.parent.name) / f.name) for f in files if (time := _time(f.stem)) is not None]


def _lens(folder: Path) -> Lens:
    if (file := find_intrinsics(folder)) is not None:
        return read_intrinsics(file)
    sequence = re.search("freiburg[123]", folder.name)
    if sequence is None:
        raise FormatError(f"{folder}: camera intrinsics missing: expected camera.txt with fx fy cx cy [k1 k2 p1 p2 k3]")
    (fx, fy, cx, cy), lens = BENCHMARK[sequence[0]]
    k: Float = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return k, lens, 640, 480
