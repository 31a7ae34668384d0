"""What every reader returns, and the checks that turn it into a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as PillowImage
from PIL import UnidentifiedImageError

from ...errors import FormatError, InvalidInputError
from ...geometry.cameras import Calibration, Camera
from ...types import Bounds
from ..scene import Scene

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".ppm")


@dataclass(frozen=True)
class Record:
    """One view as a file describes it. ``image`` is an absolute path; a size of 0 is taken from the image."""

    K: Any
    R: Any
    t: Any
    width: int = 0
    height: int = 0
    image: Path | None = None
    mask: Path | None = None
    name: str = ""
    distortion: Sequence[float] = ()
    fisheye: bool = False
    line: int = 0


@dataclass(frozen=True)
class Found:
    """A file's views, with the box of the target where it names one."""

    records: list[Record]
    source: Path
    bounds: Bounds | None = None
    format: str = ""
    masks: bool = field(default=False)


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from an image file's header."""
    try:
        with PillowImage.open(path) as image:
            return image.size
    except UnidentifiedImageError:
        raise FormatError(f"{path}: not an image that can be read") from None


def image_in(folder: Path, stem: str) -> Path | None:
    """The image ``stem`` with any known suffix in a folder, its ``images`` or its ``image`` folder."""
    for base in (folder, folder / "images", folder / "image"):
        for candidate in (base / stem, *(base / f"{stem}{s}" for s in IMAGE_SUFFIXES)):
            if candidate.suffix.lower() in IMAGE_SUFFIXES and candidate.is_file():
                return candidate
    return None


def _mask_of(record: Record, folder: Path) -> Path | None:
    if record.mask is not None or record.image is None:
        return record.mask
    for root in (folder / "masks", folder / "mask"):
        if root.is_dir() and (found := find_mask(root, record.image)):
            return found
    return None


def find_mask(masks: Path, image: Path) -> Path | None:
    """The mask of an image in a folder of masks.

    Names tried: the image's own (any suffix), ``name.jpg.png``, and the image's path from its ``images`` folder on.
    """
    parts = image.parts
    inner = Path(*parts[parts.index("images") + 1 :]) if "images" in parts else Path(image.name)
    for base in (masks / inner, masks / image.name):
        for candidate in (base, base.with_name(base.name + ".png"), *(base.with_suffix(s) for s in IMAGE_SUFFIXES)):
            if candidate.is_file():
                return candidate
    return None


def to_scene(found: Found, need_images: bool = True) -> Scene:
    """Checked cameras and frames.

    Raises
    ------
    FormatError
        No views, a missing image, an image of another size, or values that make no camera; with path and line.
    """
    if not found.records:
        raise FormatError(f"{found.source}: no views")
    cameras, frames, masks = [], [], []
    for record in found.records:
        where = f"{found.source}:{record.line}" if record.line else str(found.source)
        record = _with_size(record, where, need_images)
        try:
            cameras.append(
                Camera(
                    K=record.K,
                    R=record.R,
                    t=record.t,
                    width=record.width,
                    height=record.height,
                    distortion=np.asarray(record.distortion, np.float64),
                    fisheye=record.fisheye,
                    name=record.name or (record.image.name if record.image else ""),
                )
            )
        except InvalidInputError as error:
            raise FormatError(f"{where}: {error}") from None
        frames.append(record.image)
        masks.append(_mask_of(record, found.source if found.source.is_dir() else found.source.parent))
    calib = Calibration(tuple(cameras), str(found.source))
    return Scene(
        frames=tuple(f for f in frames if f is not None),
        calib=calib,
        masks=tuple(masks) if any(masks) else None,
        bounds=found.bounds,
        format=found.format,
    )


def _with_size(record: Record, where: str, need_images: bool) -> Record:
    if record.width and not need_images:
        return record
    if record.image is None or not record.image.is_file():
        if need_images:
            raise FormatError(f"{where}: image {str(record.image or record.name)!r} does not exist")
        if not record.width:
            raise FormatError(f"{where}: the image size is not in the file, and image {record.name!r} does not exist")
        return record
    width, height = image_size(record.image)
    if record.width and (width, height) != (record.width, record.height):
        raise FormatError(f"{where}: image {record.image.name} has {width} x {height} pixels, its camera {record.width} x {record.height}")
    return replace(record, width=width, height=height)


class Lines:
    """A text file's lines, with errors that name path and line."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.lines = path.read_text(encoding="utf-8", errors="strict").splitlines()
        except UnicodeDecodeError:
            raise FormatError(f"{path}:1: not a text file") from None

    def fail(self, number: int, message: str) -> FormatError:
        """An error at a line (counted from 1)."""
        return FormatError(f"{self.path}:{number}: {message}")

    def numbers(self, number: int, count: int | None = None, skip: int = 0) -> list[float]:
        """The numbers of a line, ``count`` of them, after ``skip`` words."""
        if number > len(self.lines):
            raise self.fail(len(self.lines), f"the file ends before line {number}")
        words = self.lines[number - 1].split()[skip:]
        try:
            values = [float(w) for w in words]
        except ValueError as error:
            raise self.fail(number, f"expected numbers: {error}") from None
        if count is not None and len(values) != count:
            raise self.fail(number, f"expected {count} numbers, got {len(values)}")
        if not np.isfinite(values).all():
            raise self.fail(number, "NaN or infinity")
        return values
