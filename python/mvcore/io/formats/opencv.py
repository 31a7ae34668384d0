"""OpenCV FileStorage (YAML, XML or JSON): one file a camera, or a stereo calibration with M1, D1, M2, D2, R, T.

Of a camera file: ``camera_matrix`` (K), ``distortion_coefficients`` (D), ``rvec`` or ``R``, ``tvec`` (T), ``image_width`` and
``image_height`` and, if it is not the file's own name, ``image``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ...errors import FormatError
from .records import Found, Record, image_in

SUFFIXES = (".yml", ".yaml", ".xml")
KEYS = {
    "K": ("camera_matrix", "K", "cameraMatrix", "camera_Matrix", "M"),
    "D": ("distortion_coefficients", "D", "dist", "distCoeffs", "dist_coeffs"),
    "R": ("R", "rvec", "rotation_matrix", "rotation"),
    "t": ("tvec", "T", "t", "translation"),
    "image": ("image", "image_name", "filename"),
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
}


def find(path: Path) -> Path | None:
    """A storage file, or a folder of some."""
    if path.is_file():
        return path if path.suffix in SUFFIXES else None
    return path if _files(path) else None


def _files(folder: Path) -> list[Path]:
    return sorted(f for f in folder.iterdir() if f.suffix in SUFFIXES)


def read(path: Path) -> Found:
    """The cameras of a file or a folder, by name."""
    files = [path] if path.is_file() else _files(path)
    return Found([record for file in files for record in _file(file)], path)


def _file(path: Path) -> list[Record]:
    with open_storage(path) as storage:
        if not storage.getNode("M1").empty():
            return _stereo(path, storage)
        return [_camera(path, storage)]


@contextmanager
def open_storage(path: Path) -> Iterator[cv2.FileStorage]:
    """A storage to read from; closed at the end."""
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:
        raise FormatError(f"{path}: not an OpenCV FileStorage: {str(error).strip().splitlines()[-1]}") from None
    try:
        if not storage.isOpened():
            raise FormatError(f"{path}: not an OpenCV FileStorage")
        yield storage
    finally:
        storage.release()


def _value(path: Path, storage: cv2.FileStorage, key: str) -> Any:
    return storage_value(path, storage, KEYS.get(key, (key,)))


def storage_value(path: Path, storage: cv2.FileStorage, names: Sequence[str]) -> Any:
    """The text, number or float64 matrix of the first of the names that the storage holds; None where it holds none."""
    for name in names:
        node = storage.getNode(name)
        if node.empty():
            continue
        if node.isString():
            return node.string()
        if node.isReal() or node.isInt():
            return node.real()
        matrix = node.mat()
        if matrix is None:
            raise FormatError(f"{path}: {name}: expected a matrix")
        return np.asarray(matrix, np.float64)
    return None


def _size(path: Path, storage: cv2.FileStorage) -> tuple[int, int]:
    width, height = _value(path, storage, "width"), _value(path, storage, "height")
    return (int(width), int(height)) if width and height else (0, 0)


def _camera(path: Path, storage: cv2.FileStorage) -> Record:
    matrix, rotation, t = (_value(path, storage, k) for k in ("K", "R", "t"))
    if matrix is None or rotation is None or t is None:
        missing = [k for k, v in (("camera_matrix", matrix), ("R or rvec", rotation), ("tvec", t)) if v is None]
        raise FormatError(f"{path}: {', '.join(missing)} missing")
    if rotation.size == 3:
        rotation, _ = cv2.Rodrigues(rotation.reshape(3, 1))
    distortion = _value(path, storage, "D")
    width, height = _size(path, storage)
    name = _value(path, storage, "image") or path.stem
    return Record(
        K=matrix,
        R=rotation,
        t=t.reshape(-1),
        width=width,
        height=height,
        image=image_in(path.parent, name),
        name=name,
        distortion=_nonzero(distortion),
    )


def _nonzero(distortion: Any) -> list[float]:
    values = [] if distortion is None else np.asarray(distortion, float).reshape(-1).tolist()
    return values if any(values) else []


def _stereo(path: Path, storage: cv2.FileStorage) -> list[Record]:
    r, t = _value(path, storage, "R"), _value(path, storage, "t")
    if r is None or t is None:
        raise FormatError(f"{path}: R and T of the second camera missing")
    width, height = _size(path, storage)
    records = []
    for n, (rotation, shift) in enumerate(((np.eye(3), np.zeros(3)), (r, t.reshape(-1))), 1):
        matrix = _value(path, storage, f"M{n}")
        if matrix is None:
            raise FormatError(f"{path}: M{n} missing")
        image = next((i for s in (("left", "im0", "view1"), ("right", "im1", "view5"))[n - 1] if (i := image_in(path.parent, s))), None)
        records.append(
            Record(
                K=matrix,
                R=rotation,
                t=shift,
                width=width,
                height=height,
                image=image,
                name=image.name if image else ("left", "right")[n - 1],
                distortion=_nonzero(_value(path, storage, f"D{n}")),
            )
        )
    return records
