"""IDR / NeuS ``cameras*.npz``: ``world_mat_i`` = K [R | t], ``scale_mat_i`` takes the unit sphere to the target."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from ...errors import FormatError, InvalidInputError
from ...geometry.cameras import Camera
from .records import IMAGE_SUFFIXES, Found, Record

NAMES = ("cameras_sphere.npz", "cameras_large.npz", "cameras.npz")


def find(path: Path) -> Path | None:
    """The archive, if the path is one or holds one."""
    if path.is_file():
        return path if path.suffix == ".npz" else None
    return next((path / n for n in NAMES if (path / n).is_file()), None)


def read(path: Path) -> Found:
    """The views of an archive; images are taken in the order of their names."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {k: archive[k] for k in archive.files if k.startswith(("world_mat_", "scale_mat_"))}
    except (ValueError, OSError, zipfile.BadZipFile) as error:
        raise FormatError(f"{path}: {error}") from None
    count = 0
    while f"world_mat_{count}" in arrays:
        count += 1
    images = _images(path.parent)
    if images and len(images) != count:
        raise FormatError(f"{path}: {count} cameras, but {len(images)} images beside it")
    records = []
    for n in range(count):
        try:
            # Size 1 x 1: the decomposition does not need it, the image's header gives it.
            camera = Camera.from_projection(arrays[f"world_mat_{n}"][:3, :4], 1, 1)
        except (InvalidInputError, IndexError) as error:
            raise FormatError(f"{path}: world_mat_{n}: {error}") from None
        image = images[n] if images else None
        records.append(Record(K=camera.K, R=camera.R, t=camera.t, image=image, name=image.name if image else f"{n:06d}"))
    return Found(records, path, _bounds(arrays.get("scale_mat_0")))


def _images(folder: Path) -> list[Path]:
    for base in (folder / "image", folder / "images", folder):
        files = sorted(f for f in base.glob("*") if f.suffix.lower() in IMAGE_SUFFIXES) if base.is_dir() else []
        if files:
            return files
    return []


def _bounds(scale: np.ndarray | None) -> np.ndarray | None:
    if scale is None or scale.shape != (4, 4):
        return None
    centre, radius = scale[:3, 3], np.abs(np.diag(scale)[:3])
    return np.stack([centre - radius, centre + radius]).astype(np.float64)
