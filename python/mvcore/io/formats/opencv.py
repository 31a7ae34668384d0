"""OpenCV FileStorage (YAML, XML or JSON), one file a camera (two in one: `stereo`).

Of a camera file: ``camera_matrix`` (K), ``distortion_coefficients`` (D), ``rvec`` or ``R``, ``tvec`` (T), ``image_width`` and
``image_height`` and, if it is not the file's own name, ``image``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError
from ..limits import MOST_SIDE
from .filestorage import read_filestorage
from .records import Found, Record, image_in
from .values import files_in, head

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

SNIFF = 1 << 16
"""Bytes that are searched for the name of the camera matrix."""
MATRIX = re.compile(rf"""^[ \t]*["<]?(?:{"|".join(KEYS["K"])})["> \t:]""", re.MULTILINE)


def find(path: Path) -> Path | None:
    """A storage file, or a folder of some."""
    if path.is_file():
        return path if path.suffix.lower() in SUFFIXES else None
    return path if _files(path) else None


def _files(folder: Path) -> list[Path]:
    return files_in(folder, *SUFFIXES)


def read(path: Path) -> Found:
    """The cameras of a file or a folder, by name."""
    if path.is_file():
        return Found([_camera(path, read_filestorage(path))], path)
    files = _files(path)
    cameras = [f for f in files if MATRIX.search(head(f, SNIFF))] or files
    others = [f.name for f in files if f not in cameras]
    warnings = (f"{len(others)} files without a camera matrix left out: {', '.join(others[:5])}",) if others else ()
    return Found([_camera(f, read_filestorage(f)) for f in cameras], path, warnings=warnings)


def storage_value(path: Path, storage: dict[str, Any], names: Sequence[str]) -> Any:
    """The text, number or float64 matrix of the first of the names that the storage holds; None where it holds none.

    A sequence of numbers is a column.

    Raises
    ------
    FormatError
        The value is something else.
    """
    for name in names:
        value = storage.get(name)
        if isinstance(value, list) and value and all(type(v) in (int, float) for v in value):
            value = np.array(value, np.float64).reshape(-1, 1)
        if isinstance(value, str | int | float | np.ndarray):
            return value
        if value is not None:
            raise FormatError(f"{path}: {name}: expected a matrix, a number or a text")
    return None


def storage_matrix(path: Path, storage: dict[str, Any], names: Sequence[str], sizes: Sequence[int]) -> Any:
    """A float64 matrix of one of the ``sizes`` (numbers in it) under the first of the names, None where there is none.

    Raises
    ------
    FormatError
        Another kind of value, another size, or NaN or infinity.
    """
    value = storage_value(path, storage, names)
    if value is None:
        return None
    count = value.size if isinstance(value, np.ndarray) else 0
    if count not in sizes or not np.isfinite(value).all():
        got = f"{count} of them" if count else repr(value)[:80]
        raise FormatError(f"{path}: {names[0]}: expected {' or '.join(map(str, sizes))} finite numbers, got {got}")
    return value


def storage_size(path: Path, storage: dict[str, Any], width: Sequence[str], height: Sequence[str]) -> tuple[int, int]:
    """Width and height in pixels, (0, 0) where either is missing or 0.

    Raises
    ------
    FormatError
        No whole numbers from 0 to `mvcore.io.limits.MOST_SIDE`.
    """
    sizes = []
    for names in (width, height):
        value = storage_value(path, storage, names)
        number = value if isinstance(value, int | float) else 0 if value is None else math.nan
        if not 0 <= number <= MOST_SIDE or number != int(number):
            raise FormatError(f"{path}: {names[0]}: expected a number of pixels, got {value!r:.80}")
        sizes.append(int(number))
    return (sizes[0], sizes[1]) if all(sizes) else (0, 0)


def rotation_of(value: NDArray[np.float64]) -> NDArray[np.float64]:
    """A rotation matrix from itself or from a Rodrigues vector of finite numbers."""
    return cv2.Rodrigues(value.reshape(3, 1))[0] if value.size == 3 else value.reshape(3, 3)


def _camera(path: Path, storage: dict[str, Any]) -> Record:
    sizes = {"K": (9,), "R": (3, 9), "t": (3,)}
    matrix, rotation, t = (storage_matrix(path, storage, KEYS[k], n) for k, n in sizes.items())
    if matrix is None or rotation is None or t is None:
        missing = [k for k, v in (("camera_matrix", matrix), ("R or rvec", rotation), ("tvec", t)) if v is None]
        raise FormatError(f"{path}: {', '.join(missing)} missing")
    width, height = storage_size(path, storage, KEYS["width"], KEYS["height"])
    name = str(storage_value(path, storage, KEYS["image"]) or path.stem)
    return Record(
        K=matrix.reshape(3, 3),
        R=rotation_of(rotation),
        t=t.reshape(-1),
        width=width,
        height=height,
        image=image_in(path.parent, name),
        name=name,
        distortion=storage_distortion(path, storage, KEYS["D"]),
    )


def storage_distortion(path: Path, storage: dict[str, Any], names: Sequence[str]) -> list[float]:
    """Distortion coefficients, none where all are zero."""
    distortion = storage_matrix(path, storage, names, (0, 1, 2, 4, 5, 8, 12, 14))
    values = [] if distortion is None else distortion.reshape(-1).tolist()
    return [*values, *[0.0] * (4 - len(values))] if any(values) else []
