"""IDR / NeuS ``cameras*.npz``: ``world_mat_i`` = K [R | t], ``scale_mat_i`` takes the unit sphere to the target."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import FormatError, InvalidInputError
from ...geometry.cameras import Camera
from ...geometry.projections import cameras_from_projections
from ..limits import read_npz
from ..media import frame_files
from .places import named
from .records import Found, Record

NAMES = ("cameras_sphere.npz", "cameras_large.npz", "cameras.npz")
KEY = re.compile(r"(?:world|scale)_mat_[0-9]{1,9}")
NUMBER = re.compile(r"[0-9]{1,9}")
MOST = 64 << 20
"""Bytes of the matrices of an archive."""


def find(path: Path) -> Path | None:
    """The archive, if the path is one or holds one."""
    if path.is_file():
        return path if path.suffix.lower() == ".npz" else None
    return named(path, *NAMES)


def read(path: Path) -> Found:
    """The views of an archive by number, each with the image of that number, or images in the order of their names."""
    arrays = read_npz(path, lambda name: KEY.fullmatch(name) is not None, MOST)
    numbers = sorted(int(name.removeprefix("world_mat_")) for name in arrays if name.startswith("world_mat_"))
    images = _images(path, numbers)
    records = []
    for n in numbers:
        matrix = arrays[f"world_mat_{n}"]
        if matrix.shape not in ((3, 4), (4, 4)):
            raise FormatError(f"{path}: world_mat_{n}: expected 4 x 4 numbers, got shape {matrix.shape}")
        try:
            # Size 1 x 1: the decomposition does not need it, the image's header gives it.
            camera = Camera.from_projection(matrix[:3].astype(np.float64), 1, 1)
        except (InvalidInputError, np.linalg.LinAlgError) as error:
            raise FormatError(f"{path}: world_mat_{n}: {error}") from None
        image = images.get(n)
        records.append(Record(K=camera.K, R=camera.R, t=camera.t, image=image, name=image.name if image else f"{n:06d}"))
    cameras, mirrored = cameras_from_projections([arrays[f"world_mat_{n}"][:3] for n in numbers], [(1, 1)] * len(numbers))
    records = [replace(r, K=c.K, R=c.R, t=c.t) for r, c in zip(records, cameras, strict=True)]
    bounds = _bounds(arrays.get(f"scale_mat_{numbers[0]}")) if numbers else None
    return Found(records, path, bounds, mirrored=mirrored)


def _images(path: Path, numbers: list[int]) -> dict[int, Path]:
    """An image for each number, or none at all where there are no images."""
    folder = path.parent
    for base in (folder / "image", folder / "images", folder):
        files = frame_files(base) if base.is_dir() else []
        if not files:
            continue
        by_number = {int(f.stem): f for f in files if NUMBER.fullmatch(f.stem)}
        if all(n in by_number for n in numbers):
            return {n: by_number[n] for n in numbers}
        if len(files) == len(numbers):
            return dict(zip(numbers, files, strict=True))
        raise FormatError(f"{path}: {len(numbers)} cameras, but {len(files)} images beside it, and not of the same numbers")
    return {}


def _bounds(scale: np.ndarray | None) -> np.ndarray | None:
    if scale is None or scale.shape != (4, 4) or not np.isfinite(scale).all():
        return None
    scale = scale.astype(np.float64)
    centre, radius = scale[:3, 3], np.abs(np.diag(scale)[:3])
    return np.stack([centre - radius, centre + radius]) if radius.min() > 0 else None
