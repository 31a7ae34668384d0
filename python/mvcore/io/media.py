"""One camera's clip: a video file, or a folder of images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from ..types import Image
from .decode import read_header
from .formats.records import IMAGE_SUFFIXES, image_size
from .images import read_image, read_mask
from .pairing import natural_order
from .streams import open_stream, video_frame

VIDEO_SUFFIXES = (
    *(".mp4", ".m4v", ".mov", ".3gp", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ogv", ".wmv", ".flv", ".mxf"),
    *(".mts", ".m2ts", ".m2t", ".ts", ".mod", ".tod", ".dv"),  # camcorders: AVCHD, HDV, DV
)
"""Compared without case."""
PLATES = ("background", "clean", "plate", "empty")
"""Names, without their suffix, of an image without the target among a camera's frames."""
EXIF_TURNS = {3: 2, 6: 3, 8: 1}
"""Quarter turns, counter-clockwise, that show an image of that EXIF orientation upright."""


@dataclass(frozen=True)
class Clip:
    """One camera's frames.

    width, height : pixels of a frame as it is handed out. rate : frames a second, 0 where unknown. plate : an image without the target.
    turn : quarter turns, counter-clockwise, from the stored frames to those handed out.
    """

    name: str
    source: Any
    frames: int
    width: int
    height: int
    rate: float = 0.0
    plate: Path | None = None
    turn: int = 0

    def frame(self, number: int) -> Image:
        """Frame ``number``, (h, w, 3) uint8 RGB."""
        if isinstance(self.source, Path):
            return self._upright(video_frame(self.source, number), number)
        return self._upright(read_image(self.source[number]) if isinstance(self.source, tuple) else self.source[number], number)

    def mask(self, number: int) -> NDArray[np.uint8]:
        """Frame ``number`` of a clip of masks, (h, w) uint8 of 0 and 255: files as `read_mask` takes them, else where it is bright."""
        if isinstance(self.source, tuple):
            return self._upright(read_mask(self.source[number]), number)
        return np.where(self.frame(number).max(2) > 127, 255, 0).astype(np.uint8)

    def _upright(self, image: NDArray[np.uint8], number: int) -> NDArray[np.uint8]:
        if self.turn:
            image = np.ascontiguousarray(np.rot90(image, self.turn))
        if image.shape[:2] != (self.height, self.width):
            raise FormatError(
                f"{self.name}: frame {number} has {image.shape[1]} x {image.shape[0]} pixels, the first {self.width} x {self.height}"
            )
        return image


def is_video(path: Path) -> bool:
    """Whether a file's suffix is a video's; hidden files, which file managers leave, are none."""
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.name.startswith(".") and path.is_file()


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


def frame_files(folder: Path) -> list[Path]:
    """A folder's images in natural order, without a clean plate."""
    files = [f for f in folder.iterdir() if _is_image(f) and f.stem.lower() not in PLATES]
    return sorted(files, key=natural_order)


def plate_in(folder: Path) -> Path | None:
    """A folder's clean plate."""
    return next((f for f in sorted(folder.iterdir()) if f.stem.lower() in PLATES and _is_image(f)), None)


def image_turn(path: Path) -> int:
    """Quarter turns, counter-clockwise, that an image's EXIF block asks for; 0 without one."""
    return EXIF_TURNS.get(read_header(path).orientation, 0)


def media_size(folder: Path, name: str) -> tuple[int, int]:
    """(width, height) of a camera's ``images/NAME`` folder or ``videos/NAME`` file; (0, 0) where there is neither."""
    frames, videos = folder / "images" / name, folder / "videos"
    if frames.is_dir() and (files := frame_files(frames)):
        return image_size(files[0])
    for file in sorted(videos.iterdir()) if videos.is_dir() else ():
        if file.stem == name and is_video(file):
            stream = open_stream(file)
            return stream.width, stream.height
    return 0, 0
