"""Images and masks from files and arrays, undistorted and reduced."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError, InvalidInputError, require
from ..geometry.cameras import Camera
from ..types import Frame, Image
from .formats.records import IMAGE_SUFFIXES, find_mask


def read_image(path: str | Path) -> Image:
    """(h, w, 3) uint8 RGB; EXIF orientation is not applied, as calibrations do not know it."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such image")
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise FormatError(f"{path}: not an image that OpenCV reads")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_mask(path: str | Path) -> NDArray[np.uint8]:
    """(h, w) uint8, 255 on the target: where the file is brighter than half."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such mask")
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise FormatError(f"{path}: not an image that OpenCV reads")
    if image.ndim == 3:
        image = image[..., 3] if image.shape[2] == 4 else image.max(2)
    return np.where(image > np.iinfo(image.dtype).max // 2, 255, 0).astype(np.uint8)


def find_masks(folder: str | Path, frames: Sequence[Frame]) -> list[Path]:
    """The mask file of each frame in a folder.

    Raises
    ------
    FormatError
        A frame without one.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of masks")
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p.suffix.lower() in (".png", ".jpg", ".bmp", ".tif"))
    found: list[Path | None] = [find_mask(folder, Path(f)) if isinstance(f, str | Path) else None for f in frames]
    if all(f is None for f in found) and len(files) == len(frames):
        return files  # named otherwise, but one a frame: taken in order
    missing = [str(frame) for frame, mask in zip(frames, found, strict=True) if mask is None]
    if missing:
        raise FormatError(f"{folder}: no mask for {missing[0]} ({len(missing)} of {len(frames)} frames have none)")
    return [f for f in found if f is not None]


def find_pictures(folder: str | Path, names: Sequence[str]) -> dict[str, Path]:
    """One picture a camera in a folder: ``NAME.png`` (any image suffix), or the first, by name, in a folder ``NAME``.

    Raises
    ------
    FileNotFoundError, FormatError
        No such folder, or a camera without one.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of pictures")
    found = {}
    for name in names:
        inner = sorted((folder / name).iterdir()) if (folder / name).is_dir() else []
        files = [f for f in [*sorted(folder.glob(f"{name}.*")), *inner] if f.suffix.lower() in IMAGE_SUFFIXES]
        if not files:
            raise FormatError(f"{folder}: no picture of camera {name}")
        found[name] = files[0]
    return found


def load_frame(frame: Frame, camera: Camera, index: int) -> Image:
    """A frame as an image of its camera's size.

    Raises
    ------
    InvalidInputError
        Another dtype, shape or size.
    """
    name = f"frames[{index}]"
    if isinstance(frame, str | Path):
        image = read_image(frame)
        name = f"{name} ({Path(frame).name})"
    else:
        image = np.asarray(frame)
    require(image.dtype == np.uint8, name, "uint8 values", image.dtype)
    require(image.ndim == 3 and image.shape[2] == 3, name, "shape (h, w, 3)", image.shape)
    size = (image.shape[1], image.shape[0])
    if size != (camera.width, camera.height):
        raise InvalidInputError(f"{name}: expected {camera.width} x {camera.height} pixels as its camera, got {size[0]} x {size[1]}")
    return np.ascontiguousarray(image)


def load_mask(mask: Frame, camera: Camera, index: int) -> NDArray[np.uint8]:
    """A mask, (h, w) uint8 or bool or a path, as 0 and 255."""
    name = f"masks[{index}]"
    if isinstance(mask, str | Path):
        array = read_mask(mask)
    else:
        given = np.asarray(mask)
        require(
            given.ndim == 2 and given.dtype in (np.uint8, np.bool_),
            name,
            "(h, w) of uint8 or bool",
            f"{given.shape} of {given.dtype}",
        )
        array = np.where(given > (0 if given.dtype == np.bool_ or given.max(initial=0) <= 1 else 127), 255, 0).astype(np.uint8)
    require(array.shape == (camera.height, camera.width), name, f"shape {(camera.height, camera.width)}", array.shape)
    return array


def undistort(image: NDArray[np.uint8], camera: Camera, nearest: bool = False) -> NDArray[np.uint8]:
    """The image that a pinhole with the same K would have taken (OpenCV); masks with ``nearest``."""
    if not camera.distortion.size or not camera.distortion.any():
        return image
    size = (camera.width, camera.height)
    build = cv2.fisheye.initUndistortRectifyMap if camera.fisheye else cv2.initUndistortRectifyMap
    x, y = build(camera.K, camera.distortion, np.eye(3), camera.K, size, cv2.CV_32FC1)
    return cv2.remap(image, x, y, cv2.INTER_NEAREST if nearest else cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT)


def reduce(image: NDArray[np.uint8], camera: Camera, limit: int, nearest: bool = False) -> tuple[NDArray[np.uint8], Camera]:
    """The image and its camera with the longer side at most ``limit`` pixels."""
    longer = max(camera.width, camera.height)
    if longer <= limit:
        return image, camera
    size = (max(2, round(camera.width * limit / longer)), max(2, round(camera.height * limit / longer)))
    return cv2.resize(image, size, interpolation=cv2.INTER_NEAREST if nearest else cv2.INTER_AREA), camera.resized(*size)
