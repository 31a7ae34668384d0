"""What the readers of camera paths share: intrinsics in a file of their own, and frames with poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ...errors import FormatError, InvalidInputError
from .lens import brown
from .poses import from_camera_to_world
from .records import Found, Record
from .values import Entry, Float, Rows, named, read_json

INTRINSICS = (
    "camera.txt", "intrinsics.txt", "intrinsic.txt", "camera_intrinsics.txt", "camera-intrinsics.txt", "K.txt", "calibration.txt",
    "calib.txt", "camera.json", "intrinsics.json", "cam_params.json", "camera_params.json",
)  # fmt: skip
"""Files that hold the intrinsics of a path's one camera."""

Lens = tuple[Float, list[float], int, int]
"""K, OpenCV's coefficients, width and height; a size of 0 is the image's."""


def find_intrinsics(*folders: Path) -> Path | None:
    """The first file of intrinsics in some folders."""
    return next((p for f in folders if (p := named(f, *INTRINSICS)) is not None), None)


def read_intrinsics(path: Path) -> Lens:
    """The intrinsics of one camera.

    Text: ``fx fy cx cy [k1 k2 p1 p2 [k3]]``, or K as 3 x 3 or 4 x 4. JSON: an object, or one in ``camera``, with fx fy cx cy, and w h or
    width height. Pixel centres are at integers.
    """
    if path.suffix.lower() == ".json":
        root = read_json(path)
        camera = root.get("camera") or root
        fx, fy, cx, cy = (camera.need(n).number() for n in ("fx", "fy", "cx", "cy"))
        size = [camera.get("w", "width"), camera.get("h", "height")]
        width, height = (0, 0) if None in size else (e.pixels() for e in size if e is not None)
        lens = [0.0 if (e := camera.get(n)) is None else e.number() for n in ("k1", "k2", "p1", "p2", "k3")]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), brown(*lens), width, height
    rows = Rows(path)
    values: list[float] = []
    for n, line in rows.content():
        words = line.replace(",", " ").split()
        values += rows.numbers(n, words if words[0][-1].isdigit() or words[0][-1] == "." else words[1:])
        if len(values) > 16:
            break
    if len(values) == 16 or values[6:] == [0.0, 0.0, 1.0]:
        side = 3 if len(values) == 9 else 4
        return np.reshape(values, (side, side))[:3, :3], [], 0, 0
    if len(values) not in (4, 8, 9):
        raise FormatError(f"{path}: expected fx fy cx cy [k1 k2 p1 p2 [k3]], or a 3 x 3 matrix, got {len(values)} numbers")
    fx, fy, cx, cy = values[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), brown(*values[4:]), 0, 0


def read_matrix(path: Path) -> Float | None:
    """A 4 x 4 or 3 x 4 matrix; None where a value is NaN or infinite, as tracking writes where it was lost."""
    rows = Rows(path)
    content = [(n, line.split()) for n, line in rows.content()]
    words = [w for _, line in content for w in line]
    if len(words) not in (12, 16):
        raise rows.fail(1, f"expected 4 x 4 numbers, got {len(words)}")
    if any(w.lower().lstrip("+-") in ("inf", "nan", "infinity") for w in words):
        return None
    return np.array([rows.numbers(n, line) for n, line in content]).reshape(-1, 4)


def record(source: str, pose: Float, image: Path, lens: Lens) -> Record:
    """A frame of a path with a camera-to-world pose in OpenCV's axes."""
    try:
        r, t = from_camera_to_world(pose)
    except InvalidInputError as error:
        raise FormatError(f"{source}: {error}") from None
    k, distortion, width, height = lens
    return Record(k, r, t, width, height, image, name=image.name, distortion=distortion)


def path_of(source: Path, frames: Sequence[tuple[str, Float | None, Path]], lens: Lens, lost: Callable[[int], str]) -> Found:
    """The frames (place of the pose, pose, image) that have a pose; ``lost`` words the warning about the others."""
    records = [record(where, pose, image, lens) for where, pose, image in frames if pose is not None]
    missing = len(frames) - len(records)
    if not records:
        raise Entry(None, source).fail("no poses")
    return Found(records, source, warnings=(lost(missing),) if missing else ())
