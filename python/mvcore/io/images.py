"""Images and masks from files and arrays, undistorted and reduced."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FormatError, InvalidInputError, require
from ..geometry.cameras import Camera, same_shape
from ..types import Frame, Image
from .decode import decode, eight_bits, read_header, turn
from .formats.places import IMAGE_SUFFIXES, images_below
from .limits import MOST_SIDE
from .pairing import pair_by_name

LABELS = 64
"""Most values of a label image; a soft mask has more."""
FEW = 8
"""Values of an image that surely holds labels, also where some are close to 0."""
BETWEEN = 0.05
"""Share of a mask's non-zero pixels that are flat and between dark and bright from which it is a label image, not a soft mask."""
NOISE = 32
"""Grey levels that JPEG adds to a black mask, of 255."""
PART = 8192
"""Pixels a side of the parts in which larger images than OpenCV takes are undistorted."""
MARGIN = 4
"""Pixels around a part that its interpolation reads."""
INVERTED = 0.15
"""By how much the border must exceed the inside, as shares of target pixels, for a mask to look inverted."""


def read_image(path: str | Path) -> Image:
    """(h, w, 3) uint8 RGB of a grey, colour, 16-bit or float image; black where it is transparent.

    More than eight bits are scaled alike for all images of a folder (`eight_bits`). EXIF orientation is not applied, as
    calibrations do not know it; `load_frame` does where the camera's size says so.

    Raises
    ------
    FileNotFoundError, FormatError
        No such file, or none that can be read.
    """
    array = decode(path)
    image = eight_bits(path, array[..., :3] if array.ndim == 3 else array)
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, 2)
    if array.shape[2] == 4:
        image = np.where(array[..., 3:] > 0, image, 0).astype(np.uint8)
    return np.ascontiguousarray(image)


def read_mask(path: str | Path) -> NDArray[np.uint8]:
    """(h, w) uint8, 255 on the target: its alpha if that is transparent somewhere, else what is bright or has a label.

    Masks of two values (0 and 1, 0 and 255, 16-bit) and soft masks count as target above half of their largest value; label
    images (few values, many of them in between) where the label is not 0.
    """
    array = decode(path)
    if array.ndim == 3:
        opaque = array.shape[2] < 4 or (array[..., 3] == array[..., 3].max(initial=0)).all()
        array = array[..., :3].max(2) if opaque else array[..., 3]
    lossy = Path(path).suffix.lower() in (".jpg", ".jpeg", ".webp")
    return np.where(_target(array, lossy), 255, 0).astype(np.uint8)


def _target(mask: NDArray[Any], lossy: bool = False) -> NDArray[np.bool_]:
    most = float(mask.max(initial=0))
    if not most > 0 or (lossy and mask.dtype == np.uint8 and most < NOISE):
        return np.zeros(mask.shape, bool)
    inside = mask > 0
    values = 0 if lossy else len(np.unique(mask))
    if 2 < values <= LABELS:
        square = np.ones((3, 3), np.uint8)
        flat = cv2.erode(mask, square) == cv2.dilate(mask, square)
        edge = most / 8
        between = flat & inside & (mask < most - edge) & ((mask > edge) | (values <= FEW))
        if between.sum() > BETWEEN * inside.sum():
            return inside
    return mask > most / 2


def find_masks(folder: str | Path, frames: Sequence[Frame]) -> list[Path | None]:
    """The mask file of each frame in a folder, by name (`pair_by_name`); None for frames without one.

    Raises
    ------
    FileNotFoundError, FormatError
        No such folder, no mask for any frame, or names that are ambiguous.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of masks")
    names = [f if isinstance(f, str | Path) else f"{n:06d}" for n, f in enumerate(frames)]
    files = images_below(folder)
    if not files:
        raise FormatError(f"{folder}: no mask for {names[0] if names else 'any frame'} (the folder holds no images)")
    try:
        return pair_by_name(names, files, "mask", partial=True)
    except FormatError as error:
        raise FormatError(f"{folder}: {error}") from None


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
        files = [
            f for f in [*sorted(folder.glob(f"{name}.*")), *inner] if f.suffix.lower() in IMAGE_SUFFIXES and not f.name.startswith(".")
        ]
        if not files:
            raise FormatError(f"{folder}: no picture of camera {name}")
        found[name] = files[0]
    return found


def load_frame(frame: Frame, camera: Camera, index: int) -> Image:
    """A frame as an image of its camera's size; a file's EXIF turn is applied where only then the size fits.

    Raises
    ------
    InvalidInputError
        Another dtype, shape or size.
    """
    name = f"frames[{index}]"
    if isinstance(frame, str | Path):
        image = _turned(read_image(frame), frame, camera)
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
    """A mask, (h, w) uint8 or bool or a path, as 0 and 255 at its camera's size.

    A mask of the same shape at another size is scaled.

    Raises
    ------
    InvalidInputError
        Another dtype, or a size of another shape than the camera's.
    """
    name = f"masks[{index}]"
    if isinstance(mask, str | Path):
        name = f"{name} ({Path(mask).name})"
        array = _turned(read_mask(mask), mask, camera)
    else:
        values = np.asarray(mask)
        good = values.ndim == 2 and values.dtype in (np.uint8, np.bool_)
        require(good, name, "(h, w) of uint8 or bool", f"{values.shape} of {values.dtype}")
        array = np.where(_target(values), 255, 0).astype(np.uint8)
    height, width = array.shape
    if (width, height) == (camera.width, camera.height):
        return array
    if not same_shape((width, height), (camera.width, camera.height)):
        raise InvalidInputError(f"{name}: expected {camera.width} x {camera.height} pixels as its camera, got {width} x {height}")
    method = cv2.INTER_AREA if width > camera.width else cv2.INTER_LINEAR
    return np.where(cv2.resize(array, (camera.width, camera.height), interpolation=method) > 127, 255, 0).astype(np.uint8)


def _turned(image: NDArray[np.uint8], path: str | Path, camera: Camera) -> NDArray[np.uint8]:
    size = (image.shape[1], image.shape[0])
    if size == (camera.width, camera.height) or size[::-1] != (camera.width, camera.height):
        return image
    return turn(image, read_header(path).orientation)


def mask_warnings(masks: Sequence[NDArray[np.uint8] | None]) -> list[str]:
    """What is suspicious about masks (255 on the target): views without one, empty ones, and ones that look inverted.

    A target seldom fills the image's border more than its inside: if most masks do, they are bright where it is not.
    """
    messages = []
    present = [(n, m > 127) for n, m in enumerate(masks) if m is not None and not (m > 127).all()]
    if len(present) < len(masks):
        missing = sorted(set(range(len(masks))) - {n for n, _ in present})
        messages.append(f"masks: {len(missing)} of {len(masks)} views have none, or one that is all target ({_some(missing)})")
    if empty := [n for n, m in present if not m.any()]:
        messages.append(f"masks: {len(empty)} of {len(masks)} are empty ({_some(empty)})")
    excess = [_border(m) - float(m.mean()) for _, m in present if m.any()]
    if excess and np.median(excess) > INVERTED:
        messages.append("masks: they look inverted: they fill the images' borders more than their inside; the target must be bright")
    return messages


def _border(mask: NDArray[np.bool_]) -> float:
    return float(np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean())


def _some(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers[:5])) + (" .." if len(numbers) > 5 else "")


def distorted_pixels(camera: Camera, pixels: ArrayLike) -> NDArray[np.float64]:
    """Where the lens shows what a pinhole with the same K shows at some pixels, (N, 2) to (N, 2); OpenCV's models."""
    x = np.asarray(pixels, np.float64).reshape(-1, 2)
    if not camera.distorted:
        return x.copy()
    rays = np.column_stack([x, np.ones(len(x))]) @ np.linalg.inv(camera.K).T
    project = cv2.fisheye.projectPoints if camera.fisheye else cv2.projectPoints
    plane = project((rays / rays[:, 2:]).reshape(-1, 1, 3), np.zeros(3), np.zeros(3), np.eye(3), camera.distortion)[0]
    return np.asarray(plane.reshape(-1, 2) @ camera.K[:2, :2].T + camera.K[:2, 2], np.float64)


def undistort(image: NDArray[np.uint8], camera: Camera, nearest: bool = False) -> NDArray[np.uint8]:
    """The image that a pinhole with the same K would have taken (OpenCV); masks with ``nearest``."""
    if not camera.distorted:
        return image
    method = cv2.INTER_NEAREST if nearest else cv2.INTER_CUBIC
    x, y = _distorted_maps(camera)
    if max(image.shape[:2]) <= MOST_SIDE and max(x.shape) <= MOST_SIDE:
        return cv2.remap(image, x, y, method, borderMode=cv2.BORDER_CONSTANT)
    out = np.zeros((*x.shape, *image.shape[2:]), image.dtype)
    for top in range(0, x.shape[0], PART):
        for left in range(0, x.shape[1], PART):
            part = np.s_[top : top + PART, left : left + PART]
            out[part] = _remapped(image, x[part], y[part], method)
    return out


def _distorted_maps(camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where the lens shows what a pinhole shows at each pixel."""
    size = (camera.width, camera.height)
    build = cv2.fisheye.initUndistortRectifyMap if camera.fisheye else cv2.initUndistortRectifyMap
    k = camera.K
    if not k[0, 1]:
        return build(k, camera.distortion, np.eye(3), k, size, cv2.CV_32FC1)
    # OpenCV leaves skew out of the distorted side
    x, y = build(np.eye(3), camera.distortion, np.eye(3), k, size, cv2.CV_32FC1)
    return (k[0, 0] * x + k[0, 1] * y + k[0, 2]).astype(np.float32), (k[1, 1] * y + k[1, 2]).astype(np.float32)


def _remapped(image: NDArray[np.uint8], x: NDArray[np.float32], y: NDArray[np.float32], method: int) -> NDArray[np.uint8]:
    """A part of `undistort`, from the part of the image that it shows: cv2.remap takes sides of at most `MOST_SIDE` pixels.

    Raises
    ------
    InvalidInputError
        A lens that shows more than that in the part.
    """
    height, width = image.shape[:2]
    near = (x > -MARGIN) & (x < width + MARGIN) & (y > -MARGIN) & (y < height + MARGIN)
    if not near.any():
        return np.zeros((*x.shape, *image.shape[2:]), image.dtype)
    left, top = (max(0, int(v[near].min()) - MARGIN) for v in (x, y))
    right, bottom = int(x[near].max()) + MARGIN + 1, int(y[near].max()) + MARGIN + 1
    source = np.ascontiguousarray(image[top:bottom, left:right])
    require(
        max(source.shape[:2]) <= MOST_SIDE, "image", f"parts of at most {MOST_SIDE} pixels a side", f"{source.shape[1]} x {source.shape[0]}"
    )
    x, y = np.where(near, x - left, -2 * MARGIN), np.where(near, y - top, -2 * MARGIN)
    return cv2.remap(source, x.astype(np.float32), y.astype(np.float32), method, borderMode=cv2.BORDER_CONSTANT)


def reduce(image: NDArray[np.uint8], camera: Camera, limit: int, nearest: bool = False) -> tuple[NDArray[np.uint8], Camera]:
    """The image and its camera with the longer side at most ``limit`` pixels."""
    longer = max(camera.width, camera.height)
    if longer <= limit:
        return image, camera
    size = (max(2, round(camera.width * limit / longer)), max(2, round(camera.height * limit / longer)))
    return cv2.resize(image, size, interpolation=cv2.INTER_NEAREST if nearest else cv2.INTER_AREA), camera.resized(*size)
