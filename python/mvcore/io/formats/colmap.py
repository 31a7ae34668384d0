"""COLMAP models, text and binary (https://colmap.github.io/format.html).

World-to-camera, Hamilton quaternions; COLMAP puts the top-left corner at (0, 0), so principal points move by half a pixel.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError
from ..pairing import natural_order
from .places import dataset_root, named, places
from .records import Found, Lines, Record

MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
"""Name and number of parameters of each model id (COLMAP 4)."""
COUNTS = dict(MODELS.values())
SUPPORTED = {
    "SIMPLE_PINHOLE": (1, False),
    "PINHOLE": (2, False),
    "SIMPLE_RADIAL": (1, False),
    "RADIAL": (1, False),
    "OPENCV": (2, False),
    "FULL_OPENCV": (2, False),
    "SIMPLE_FISHEYE": (1, True),
    "FISHEYE": (2, True),
    "SIMPLE_RADIAL_FISHEYE": (1, True),
    "RADIAL_FISHEYE": (1, True),
    "OPENCV_FISHEYE": (2, True),
}
"""Number of focal lengths, and whether OpenCV's fisheye model is meant, of the models that OpenCV can undo."""
MOST_PIXELS = 1_000_000
"""Largest width or height."""
LEVELS = ("", "sparse", "colmap/sparse", "colmap", "dense", "distorted/sparse")
"""Where models lie in a data set, in themselves or in numbered folders; and the same in ``dense/0``."""

Intrinsics = tuple[str, int, int, list[float]]
"""Model, width, height, parameters."""


def find(path: Path) -> Path | None:
    """The folder of a model at a path or in its ``sparse`` folders; of several the one with the most images."""
    if path.is_file():
        return path.parent if path.name.lower() in ("cameras.txt", "cameras.bin", "images.txt", "images.bin") else None
    return max(models_in(path), key=lambda f: (image_count(f), -len(f.parts)), default=None)


def models_in(path: Path) -> list[Path]:
    """All models of one place: the first of the usual places that has any."""
    for start in (path, *_numbered(path / "dense")):
        for level in LEVELS:
            folder = start / level
            models = [f for f in (folder, *_numbered(folder)) if _is_model(f)]
            if models:
                return models[:1] if models[0] == folder else models
    return []


def _numbered(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted((f for f in folder.iterdir() if f.name.isdecimal() and f.is_dir()), key=natural_order)


def _is_model(folder: Path) -> bool:
    return _files(folder) is not None


def _files(folder: Path) -> tuple[Path, Path] | None:
    """The files of a model's cameras and images, binary ones first; None where it lacks one."""
    for suffix in (".bin", ".txt"):
        cameras, images = named(folder, f"cameras{suffix}"), named(folder, f"images{suffix}")
        if cameras is not None and images is not None:
            return cameras, images
    return None


def _is_binary(file: Path) -> bool:
    return file.suffix.lower() == ".bin"


def image_count(folder: Path) -> int:
    """Number of a model's images, at a glance; a file that does not say is read in full later, with its errors."""
    files = _files(folder)
    if files is None:
        return 0
    if _is_binary(files[1]):
        with files[1].open("rb") as stream:
            data = stream.read(8)
        return int.from_bytes(data, "little") if len(data) == 8 else 0
    try:
        return len(_images_text(files[1]))
    except FormatError:
        return 0


def read(folder: Path) -> Found:
    """The views of a model, sorted by image name."""
    files = _files(folder)
    if files is None:
        raise FormatError(f"{folder}: expected cameras and images of one model, cameras.bin and images.bin or cameras.txt and images.txt")
    if _is_binary(files[0]):
        cameras, images = _cameras_binary(files[0]), _images_binary(files[1])
    else:
        cameras, images = _cameras_text(files[0]), _images_text(files[1])
    root = dataset_root(folder)
    base = next((f for level in places(folder).levels if (f := level / "images").is_dir()), root / "images")
    records = []
    for name, quaternion, t, camera, line in sorted(images, key=lambda i: i[0]):
        where = f"{files[1]}:{line}" if line else str(files[1])
        if camera not in cameras:
            raise FormatError(f"{where}: image {name!r} names camera {camera}, which does not exist")
        if not np.linalg.norm(quaternion) > 0:
            raise FormatError(f"{where}: image {name!r}: expected a quaternion, got {quaternion}")
        matrix, distortion, fisheye = _intrinsics(folder, camera, cameras[camera])
        mask = next((m for m in (root / "masks" / f"{name}.png", root / "masks" / name) if _exists(m)), None)
        records.append(
            Record(
                K=matrix,
                R=quaternion_to_rotation(quaternion),
                t=t,
                width=cameras[camera][1],
                height=cameras[camera][2],
                image=base / name,
                mask=mask,
                name=name,
                distortion=distortion,
                fisheye=fisheye,
                line=line,
            )
        )
    return Found(records, folder, warnings=_largest(folder))


def _exists(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _largest(folder: Path) -> tuple[str, ...]:
    """What to say where there are several models."""
    if not folder.name.isdecimal():
        return ()
    models = [f for f in _numbered(folder.parent) if _is_model(f)]
    if len(models) < 2:
        return ()
    counts = ", ".join(f"{f.name}: {image_count(f)}" for f in models)
    return (f"{folder.parent} holds {len(models)} models (images of each: {counts}); {folder.name} is read",)


def quaternion_to_rotation(q: list[float]) -> NDArray[np.float64]:
    """Rotation of a Hamilton quaternion (w, x, y, z) of any length, (3, 3)."""
    w, x, y, z = np.asarray(q, float) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_to_quaternion(r: NDArray[np.float64]) -> NDArray[np.float64]:
    """(w, x, y, z) with w >= 0, by the eigenvector of Bar-Itzhack (2000): stable for every rotation."""
    (a, b, c), (d, e, f), (g, h, i) = r
    k = np.array([[a - e - i, 0, 0, 0], [d + b, e - a - i, 0, 0], [g + c, h + f, i - a - e, 0], [h - f, c - g, d - b, a + e + i]])
    x, y, z, w = np.linalg.eigh(k / 3)[1][:, -1]
    q = np.array([w, x, y, z])
    return q if q[0] >= 0 else -q


def _intrinsics(folder: Path, number: int, camera: Intrinsics) -> tuple[NDArray[np.float64], list[float], bool]:
    model, _, _, parameters = camera
    if model not in SUPPORTED:
        raise FormatError(f"{folder}: camera {number} has the model {model}, which OpenCV cannot undo; undistort with COLMAP first")
    focals, fisheye = SUPPORTED[model]
    fx, fy = parameters[0], parameters[focals - 1]
    cx, cy, *rest = parameters[focals:]
    matrix = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    if model in ("SIMPLE_PINHOLE", "PINHOLE"):
        return matrix, [], False
    return matrix, rest + [0.0] * (4 - len(rest)), fisheye


def _cameras_text(path: Path) -> dict[int, Intrinsics]:
    lines, cameras = Lines(path), {}
    for n, line in enumerate(lines.lines, 1):
        words = line.split(None, 4)
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 5:
            raise lines.fail(n, f"expected 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS', got {line!r:.60}")
        if words[1] not in COUNTS:
            raise lines.fail(n, f"camera {words[0]:.20} has the unknown model {words[1]!r:.40}; known are {', '.join(COUNTS)}")
        number, width, height = lines_integers(lines, n, [words[0], words[2], words[3]])
        if not (0 < width <= MOST_PIXELS and 0 < height <= MOST_PIXELS):
            raise lines.fail(n, f"expected a size of 1 .. {MOST_PIXELS} pixels, got {width} x {height}")
        cameras[number] = (words[1], width, height, lines.numbers(n, COUNTS[words[1]], text=words[4]))
    return cameras


def lines_integers(lines: Lines, n: int, words: list[str]) -> list[int]:
    """Words as integers."""
    try:
        return [int(w) for w in words]
    except ValueError as error:
        raise lines.fail(n, f"expected integers: {error}") from None


Pose = tuple[str, list[float], list[float], int, int]
"""Name, quaternion, t, camera, line."""


def _images_text(path: Path) -> list[Pose]:
    """Two lines an image, the second with its points; other tools leave it out where there are none."""
    lines, images = Lines(path), []
    n = 0
    while n < len(lines.lines):
        words = lines.lines[n].split(None, 9)
        n += 1
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 10:
            raise lines.fail(n, f"expected 'IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME', got {len(words)} words")
        pose = lines.numbers(n, 7, text=" ".join(words[1:8]))
        (camera,) = lines_integers(lines, n, words[8:9])
        images.append((words[9].strip(), pose[:4], pose[4:], camera, n))
        if n < len(lines.lines) and _is_points(lines.lines[n]):
            n += 1
    return images


def _is_points(line: str) -> bool:
    """Whether a line is empty or the points of an image: triples of x, y and a point's id."""
    words = line.split(None, 12)
    if not words:
        return True
    try:
        return len(line.split()) % 3 == 0 and all(np.isfinite(float(w)) for w in words[:12])
    except ValueError:
        return False


class _Binary:
    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self.path, self.stream = path, stream

    def take(self, layout: str) -> tuple:
        size = struct.calcsize("<" + layout)
        data = self.stream.read(size)
        if len(data) < size:
            raise FormatError(f"{self.path}: the file ends early, at byte {self.stream.tell()}")
        return struct.unpack("<" + layout, data)

    def count(self, size: int) -> int:
        """A number of entries of at least ``size`` bytes each, checked against what is left of the file."""
        (n,) = self.take("Q")
        left = self.path.stat().st_size - self.stream.tell()
        if n * size > left:
            raise FormatError(f"{self.path}: {n} entries of {size} bytes, but the file has {left} left: it ends early or is damaged")
        return n

    def text(self) -> str:
        """A text that ends with a zero byte."""
        start, parts = self.stream.tell(), []
        while True:
            part = self.stream.read(NAME_BYTES)
            end = part.find(b"\0")
            parts.append(part[: end if end >= 0 else len(part)])
            size = sum(map(len, parts))
            if end >= 0 and size <= NAME_BYTES:
                self.stream.seek(start + size + 1)
                return b"".join(parts).decode("utf-8", "replace")
            if not part or size > NAME_BYTES:
                raise FormatError(f"{self.path}: expected an image's name at byte {start}: the file ends early or is damaged")


NAME_BYTES = 4096
"""Longest path of an image."""


def _cameras_binary(path: Path) -> dict[int, Intrinsics]:
    cameras = {}
    with path.open("rb") as stream:
        data = _Binary(path, stream)
        for _ in range(data.count(48)):
            number, model, width, height = data.take("iiQQ")
            if model not in MODELS:
                raise FormatError(f"{path}: camera {number} has the unknown model {model}")
            if not (0 < width <= MOST_PIXELS and 0 < height <= MOST_PIXELS):
                raise FormatError(f"{path}: camera {number}: expected a size of 1 .. {MOST_PIXELS} pixels, got {width} x {height}")
            name, count = MODELS[model]
            cameras[number] = (name, width, height, list(data.take(f"{count}d")))
    return cameras


def _images_binary(path: Path) -> list[Pose]:
    images = []
    with path.open("rb") as stream:
        data = _Binary(path, stream)
        for _ in range(data.count(73)):
            _, *pose, camera = data.take("i7di")
            name = data.text()
            stream.seek(24 * data.count(24), 1)
            if not np.isfinite(pose).all():
                raise FormatError(f"{path}: image {name!r}: expected a finite pose, got {pose}")
            images.append((name, list(pose[:4]), list(pose[4:]), camera, 0))
    return images
