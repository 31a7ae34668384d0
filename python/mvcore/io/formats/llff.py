"""LLFF's ``poses_bounds.npy``: 17 numbers an image, in the order of the images' names.

The first 15 are a 3 x 5 matrix: camera to world with the camera's axes down, right and back as columns, the centre, and height, width
and focal length in pixels; then the nearest and farthest depth. The principal point is the image's middle. The images are those of
the folder whose size fits: ``images``, or a reduced one such as ``images_4``.

Source: Fyusion/LLFF README, "Using your own poses without running COLMAP"; nerf's load_llff.py.
"""

from __future__ import annotations

import tokenize
from pathlib import Path

import numpy as np

from ...errors import FormatError, InvalidInputError
from ..limits import MOST_SIDE
from ..pairing import natural_order
from .places import images_below, named
from .poses import from_center
from .records import Found, Record, image_size
from .values import Float, images_in

NAME = "poses_bounds.npy"
MOST_BYTES = 64 << 20


def find(path: Path) -> Path | None:
    """The file at the path, or in the folder."""
    if path.is_dir():
        path = named(path, NAME) or path / NAME
    return path if path.name.lower() == NAME and path.is_file() else None


def read(path: Path, images: Path | None = None) -> Found:
    """The views in the order of the images' names."""
    rows = _rows(path)
    files = _images(path, images, (int(rows[0, 9]), int(rows[0, 4])))
    if len(files) != len(rows):
        raise FormatError(f"{path}: expected {len(rows)} images as there are poses, got {len(files)} in {files[0].parent}")
    return Found([_record(path, n, row, file) for n, (row, file) in enumerate(zip(rows, files, strict=True))], path)


def _rows(path: Path) -> Float:
    if path.stat().st_size > MOST_BYTES:
        raise FormatError(f"{path}: expected at most {MOST_BYTES >> 20} MiB")
    try:
        rows = np.load(path, allow_pickle=False, mmap_mode="r")  # a declared size beyond the file's is refused, not allocated
    except (ValueError, EOFError, TypeError, OverflowError, SyntaxError, tokenize.TokenError) as error:
        raise FormatError(f"{path}: not a NumPy file of numbers: {error!s:.120}") from None
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != 17 or not len(rows) or rows.dtype.kind not in "fiu":
        raise FormatError(f"{path}: expected n x 17 numbers, got {getattr(rows, 'shape', type(rows).__name__)}")
    rows = np.array(rows, np.float64)
    if not np.isfinite(rows[:, :15]).all():
        raise FormatError(f"{path}: NaN or infinity among the poses")
    sizes = rows[:, [4, 9, 14]]
    if not ((sizes > 0) & (sizes <= MOST_SIDE)).all():
        raise FormatError(f"{path}: expected heights, widths and focal lengths of 1 .. {MOST_SIDE} pixels")
    return rows


def _images(path: Path, given: Path | None, size: tuple[int, int]) -> list[Path]:
    """The images of the folder whose first one has the size; else of the first folder with some."""
    if given is not None:
        files = images_below(given)
    else:
        usual = [path.parent / "images", path.parent]
        folders = [*usual, *sorted(path.parent.glob("images_*"), key=natural_order)]
        sets = [found for f in folders if (found := images_in(f))]
        files = next((s for s in sets if image_size(s[0]) == size), sets[0] if sets else [])
    if not files:
        raise FormatError(f"{path}: no images beside it in images, images_2 ..")
    return files


def _record(path: Path, n: int, row: Float, image: Path) -> Record:
    matrix = row[:15].reshape(3, 5)
    down, right, back, center = matrix[:, :4].T
    try:
        r, t = from_center(np.stack([right, down, -back]), center)
    except InvalidInputError as error:
        raise FormatError(f"{path}: pose {n}: {error}") from None
    height, width, f = matrix[:, 4]
    k = [[f, 0, (int(width) - 1) / 2], [0, f, (int(height) - 1) / 2], [0, 0, 1]]
    return Record(k, r, t, int(width), int(height), image, name=image.name)
