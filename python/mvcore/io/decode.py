"""Image files as arrays: what the header declares, the stored values, and eight bits of them."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage
from PIL import TiffImagePlugin

from ..errors import FormatError, MvcoreError
from .pairing import natural_order

HEIC = (".heic", ".heif")
SAMPLES = 32
"""Files of a folder that tell how bright its images can be."""
DEPTHS = (8, 10, 12, 14, 16)
"""Bits of sensors whose values are stored in 16."""
BRIGHT = 99.5
"""Percentile of a linear image that becomes white; lamps and reflections lie above."""
EXIF_ORIENTATION = 0x0112
WIDTH, LENGTH = 256, 257  # TIFF tags


@dataclass(frozen=True)
class Header:
    """What a file declares: its stored size in pixels, the EXIF orientation (1 = as stored), whether it has an alpha channel."""

    width: int
    height: int
    orientation: int = 1
    alpha: bool = False

    @property
    def turned(self) -> tuple[int, int]:
        """(width, height) as viewers show it."""
        return (self.height, self.width) if self.orientation >= 5 else (self.width, self.height)


def read_header(path: str | Path) -> Header:
    """Size, orientation and alpha of an image, without decoding it.

    Raises
    ------
    FileNotFoundError, FormatError
        No such file, no image, or one that declares more pixels than Pillow's limit against decompression bombs.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such image")
    if path.suffix.lower() == ".exr":
        return _exr_header(path)
    try:
        opened = _open(path)
    except FormatError:
        if path.suffix.lower() not in (".tif", ".tiff"):
            raise
        return _tiff_header(path)
    with opened as image:
        try:
            orientation = int(image.getexif().get(EXIF_ORIENTATION, 1))
        except Exception:
            orientation = 1  # a broken EXIF block says nothing about the pixels
        alpha = image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info
        return Header(*image.size, orientation if 1 <= orientation <= 8 else 1, alpha)


def decode(path: str | Path) -> NDArray[Any]:
    """The stored values: (h, w), or (h, w, 3 or 4) as RGB(A); uint8, uint16 or float32. EXIF orientation is not applied.

    Raises
    ------
    FileNotFoundError, FormatError
        As `read_header`, or a file that cannot be decoded.
    """
    path = Path(path)
    read_header(path)
    if path.suffix.lower() == ".exr":
        return _exr(path)
    array = None
    if path.suffix.lower() not in HEIC:
        try:
            array = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
        except cv2.error:
            array = None
    if array is None:
        return _pillow(path)
    if array.ndim == 3:
        array = array[..., 0] if array.shape[2] == 1 else np.ascontiguousarray(array[..., [2, 1, 0, *range(3, array.shape[2])]])
    if array.dtype in (np.uint8, np.uint16):
        return array
    return array.astype(np.float32)


def eight_bits(path: str | Path, array: NDArray[Any]) -> NDArray[np.uint8]:
    """Values as uint8. Of more bits white is what the images of the file's folder can reach, so that all are scaled alike.

    16-bit files often hold 10, 12 or 14 bits of a sensor: the smallest depth that holds the folder's maximum counts. Float
    files are taken as linear light in EXR (white is a high percentile, then sRGB's curve), else as 0 .. 1 or 0 .. 255.
    """
    if array.dtype == np.uint8:
        return array
    path = Path(path)
    white = _white(path.parent, path.suffix.lower(), array.dtype.char, path.parent.stat().st_mtime_ns)
    if array.dtype == np.uint16:
        return (np.arange(65536) * (255 / white) + 0.5).clip(0, 255).astype(np.uint8)[array]
    value = np.nan_to_num(array / np.float32(white), nan=0.0).clip(0, 1)
    if path.suffix.lower() == ".exr":
        value = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return (value * 255 + 0.5).astype(np.uint8)


def turn(image: NDArray[Any], orientation: int) -> NDArray[Any]:
    """An image as its EXIF orientation (1 .. 8) says that it is to be shown."""
    if orientation >= 5:
        image = image.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    return np.ascontiguousarray(image)


@lru_cache(maxsize=256)
def _white(folder: Path, suffix: str, kind: str, _changed: int) -> float:
    """The value of white in a folder's images of one suffix and dtype."""
    files = sorted((f for f in folder.iterdir() if f.suffix.lower() == suffix), key=natural_order)
    chosen = [files[n] for n in np.unique(np.linspace(0, len(files) - 1, SAMPLES).astype(int))]
    most = 0.0
    for file in chosen:
        try:
            array = decode(file)
        except FormatError:
            continue  # it is named when its own turn comes
        if array.dtype.char == kind:
            colours = array[..., :3] if array.ndim == 3 else array
            most = max(most, float(np.nanpercentile(colours, BRIGHT)) if suffix == ".exr" else float(np.nanmax(colours)))
    if kind == "H":
        return float(next(2**bits - 1 for bits in DEPTHS if most < 2**bits))
    if suffix == ".exr":
        return most if most > 0 else 1.0
    return next((w for w in (1.0, 255.0, 65535.0) if most <= w), most)


def _open(path: Path) -> PillowImage.Image:
    if path.suffix.lower() in HEIC:
        _register_heif(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PillowImage.DecompressionBombWarning)
            return PillowImage.open(path)
    except PillowImage.DecompressionBombError as error:
        raise FormatError(f"{path}: declares too many pixels: {error}") from None
    except Exception as error:  # Pillow's plugins raise all kinds on malformed files
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise FormatError(f"{path}: not an image that can be read") from None


def _tiff_header(path: Path) -> Header:
    """The size in a TIFF of a kind that Pillow has no mode for: float colours, more than four channels."""
    try:
        with path.open("rb") as stream:
            tags = TiffImagePlugin.ImageFileDirectory_v2(stream.read(8))
            stream.seek(tags.next)
            tags.load(stream)
        width, height = int(tags[WIDTH]), int(tags[LENGTH])
    except Exception:
        raise FormatError(f"{path}: not an image that can be read") from None
    _check_size(path, width, height)
    return Header(width, height)


def _check_size(path: Path, width: int, height: int) -> None:
    most = 2 * (PillowImage.MAX_IMAGE_PIXELS or 2**27)
    if width < 1 or height < 1 or width * height > most:
        raise FormatError(f"{path}: declares {width} x {height} pixels, expected at most {most} in all")


def _register_heif(path: Path) -> None:
    try:
        import pillow_heif
    except ImportError:
        raise FormatError(f"{path}: HEIC images need the package pillow-heif: pip install 'mvcore[heic]', or convert them") from None
    pillow_heif.register_heif_opener()


def _pillow(path: Path) -> NDArray[Any]:
    """What OpenCV does not decode."""
    try:
        with _open(path) as image:
            if image.mode in ("I;16", "I;16B", "I;16L"):
                return np.asarray(image).astype(np.uint16)
            if image.mode in ("F", "I"):
                return np.asarray(image).astype(np.float32)
            alpha = image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info
            return np.asarray(image.convert("RGBA" if alpha else "RGB"))
    except FormatError:
        raise
    except Exception as error:
        raise FormatError(f"{path}: cannot be decoded: {' '.join(str(error).split()) or type(error).__name__}") from None


@contextmanager
def _reading_exr(path: Path) -> Iterator[None]:
    """OpenEXR's errors, some of which come only when parts and channels are asked for, as ours."""
    try:
        yield
    except (MvcoreError, MemoryError):
        raise
    except Exception as error:
        raise FormatError(f"{path}: not an EXR image that can be read: {' '.join(str(error).split())}") from None


def _exr_header(path: Path) -> Header:
    import OpenEXR

    with _reading_exr(path):
        file = OpenEXR.File(str(path), separate_channels=True, header_only=True)
        low, high = (np.asarray(corner, np.int64) for corner in file.header()["dataWindow"])
        width, height = (int(v) for v in high - low + 1)
        names = {c.name for c in file.header()["channels"]}
    _check_size(path, width, height)
    return Header(width, height, 1, "A" in names)


def _exr(path: Path) -> NDArray[Any]:
    import OpenEXR

    with _reading_exr(path), OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: np.asarray(c.pixels, np.float32) for name, c in file.channels().items()}
    grey = channels.get("Y", next(iter(channels.values()), None) if len(channels) == 1 else None)
    colour = [channels[n] for n in ("R", "G", "B", "A") if n in channels]
    chosen = colour if {"R", "G", "B"} <= set(channels) else [] if grey is None else [grey]
    if not chosen:
        raise FormatError(f"{path}: expected channels R, G, B or Y, got {', '.join(channels) or 'none'}")
    if any(c.ndim != 2 or c.shape != chosen[0].shape for c in chosen):
        raise FormatError(f"{path}: expected channels of one size, got {', '.join(str(c.shape) for c in chosen)}")
    return np.stack(chosen, -1) if len(chosen) > 1 else chosen[0]
