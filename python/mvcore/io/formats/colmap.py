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
from .records import Found, Lines, Record, image_in

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
}
COUNTS = dict(MODELS.values())

Intrinsics = tuple[str, int, int, list[float]]
"""Model, width, height, parameters."""


def find(path: Path) -> Path | None:
    """The folder of a model at a path or in its ``sparse`` folders."""
    if path.is_file() and path.name in ("cameras.txt", "cameras.bin", "images.txt", "images.bin"):
        path = path.parent
    for folder in (path, path / "sparse" / "0", path / "sparse"):
        if any((folder / f"cameras{s}").is_file() and (folder / f"images{s}").is_file() for s in (".bin", ".txt")):
            return folder
    return None


def read(folder: Path) -> Found:
    """The views of a model, sorted by image name."""
    if (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file():
        cameras, images = _cameras_binary(folder / "cameras.bin"), _images_binary(folder / "images.bin")
    else:
        cameras, images = _cameras_text(folder / "cameras.txt"), _images_text(folder / "images.txt")
    root = folder
    while root.name in ("0", "sparse"):
        root = root.parent
    records = []
    for name, quaternion, t, camera, line in sorted(images, key=lambda i: i[0]):
        where = f"{folder}/images:{line}" if line else f"{folder}/images.bin"
        if camera not in cameras:
            raise FormatError(f"{where}: image {name!r} names camera {camera}, which does not exist")
        matrix, distortion, fisheye = _intrinsics(folder, camera, cameras[camera])
        mask = next((m for m in (root / "masks" / f"{name}.png", root / "masks" / name) if m.is_file()), None)
        records.append(
            Record(
                K=matrix,
                R=quaternion_to_rotation(quaternion),
                t=t,
                width=cameras[camera][1],
                height=cameras[camera][2],
                image=image_in(root, name) or root / "images" / name,
                mask=mask,
                name=name,
                distortion=distortion,
                fisheye=fisheye,
                line=line,
            )
        )
    return Found(records, folder)


def quaternion_to_rotation(q: list[float]) -> NDArray[np.float64]:
    """Rotation of a Hamilton quaternion (w, x, y, z) of any length, (3, 3)."""
    w, x, y, z = np.asarray(q, float) / max(np.linalg.norm(q), 1e-300)
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
    model, _, _, p = camera
    if model.startswith(("SIMPLE",)) or model.startswith("RADIAL"):
        f, cx, cy, *rest = p
        focal = (f, f)
    else:
        fx, fy, cx, cy, *rest = p
        focal = (fx, fy)
    matrix = np.array([[focal[0], 0, cx - 0.5], [0, focal[1], cy - 0.5], [0, 0, 1]])
    if model in ("SIMPLE_PINHOLE", "PINHOLE"):
        return matrix, [], False
    if model in ("SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"):
        return matrix, (rest + [0.0] * 4)[:4], model.endswith("FISHEYE")
    if model in ("OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"):
        return matrix, rest, model == "OPENCV_FISHEYE"
    raise FormatError(f"{folder}: camera {number} has the model {model}, which OpenCV cannot undo; undistort with COLMAP first")


def _cameras_text(path: Path) -> dict[int, Intrinsics]:
    lines, cameras = Lines(path), {}
    for n, line in enumerate(lines.lines, 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 5 or words[1] not in COUNTS:
            raise lines.fail(n, f"expected 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS', got {line!r:.60}")
        number, width, height = lines_integers(lines, n, [words[0], words[2], words[3]])
        cameras[number] = (words[1], width, height, lines.numbers(n, COUNTS[words[1]], skip=4))
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
    lines, images = Lines(path), []
    n = 0
    while n < len(lines.lines):
        words = lines.lines[n].split()
        n += 1
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 10:
            raise lines.fail(n, f"expected 'IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME', got {len(words)} words")
        try:
            pose = [float(w) for w in words[1:8]]
            camera = int(words[8])
        except ValueError as error:
            raise lines.fail(n, f"expected numbers: {error}") from None
        images.append((" ".join(words[9:]), pose[:4], pose[4:], camera, n))
        n += 1  # the image's points, possibly an empty line
    return images


class _Binary:
    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self.path, self.stream = path, stream

    def take(self, layout: str) -> tuple:
        size = struct.calcsize("<" + layout)
        data = self.stream.read(size)
        if len(data) < size:
            raise FormatError(f"{self.path}: the file ends early, at byte {self.stream.tell()}")
        return struct.unpack("<" + layout, data)

    def count(self) -> int:
        (n,) = self.take("Q")
        if n > self.path.stat().st_size:
            raise FormatError(f"{self.path}: {n} entries cannot fit the file")
        return n


def _cameras_binary(path: Path) -> dict[int, Intrinsics]:
    cameras = {}
    with path.open("rb") as stream:
        data = _Binary(path, stream)
        for _ in range(data.count()):
            number, model, width, height = data.take("iiQQ")
            if model not in MODELS:
                raise FormatError(f"{path}: camera {number} has the unknown model {model}")
            name, count = MODELS[model]
            cameras[number] = (name, width, height, list(data.take(f"{count}d")))
    return cameras


def _images_binary(path: Path) -> list[Pose]:
    images = []
    with path.open("rb") as stream:
        data = _Binary(path, stream)
        for _ in range(data.count()):
            _, *pose, camera = data.take("i7di")
            name = bytearray()
            while (letter := data.take("c")[0]) != b"\0":
                name += letter
            points = data.count()
            stream.seek(24 * points, 1)
            images.append((name.decode("utf-8", "replace"), list(pose[:4]), list(pose[4:]), camera, 0))
    return images
