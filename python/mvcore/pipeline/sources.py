"""Where an image or a mask comes from: a file, an array, a frame of a clip. It is read where a task needs it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.cameras import Camera
from ..io.clips import Clip, Clips
from ..io.images import load_frame, load_mask
from ..types import Frame, Image
from .store import digest, file_digest


@lru_cache(maxsize=4096)
def _file_content(path: Path, _size: int, _changed: int) -> str:
    return file_digest(path)


def content_of(source: Any, number: int = 0) -> Any:
    """What names an image's content: the bytes of its file (and its number there), or its pixels."""
    if isinstance(source, np.ndarray):
        return digest(source)
    path = Path(source)
    status = path.stat()
    return [_file_content(path.absolute(), status.st_size, status.st_mtime_ns), number]


@dataclass(frozen=True, eq=False)
class Photograph:
    """An image or mask that a caller hands over: an array or a path, of its camera's size."""

    frame: Frame
    camera: Camera
    number: int

    def content(self) -> Any:
        """Names the image."""
        return content_of(self.frame)

    def image(self) -> Image:
        """(h, w, 3) uint8 RGB, as it was taken."""
        return load_frame(self.frame, self.camera, self.number)

    def mask(self) -> NDArray[np.uint8]:
        """(h, w) uint8 of 0 and 255, as it was drawn."""
        return load_mask(self.frame, self.camera, self.number)


@dataclass(frozen=True, eq=False)
class ClipFrame:
    """One frame of a clip."""

    clip: Clip
    number: int

    @classmethod
    def of(cls, clip: Clip, number: int) -> ClipFrame:
        """A frame; of a clip in memory it holds that frame alone."""
        if isinstance(clip.source, np.ndarray):
            part = clip.source[number : number + 1]
            return cls(Clip(clip.name, part, 1, clip.width, clip.height, clip.rate), 0)
        return cls(clip, number)

    def content(self) -> Any:
        """Names the image."""
        source = self.clip.source
        if isinstance(source, np.ndarray):
            return digest(source)
        if isinstance(source, Path):
            return [self.clip.turn, content_of(source, self.number)]
        return [self.clip.turn, content_of(source[self.number])]

    def image(self) -> Image:
        """(h, w, 3) uint8 RGB, as it decodes."""
        return np.ascontiguousarray(self.clip.frame(self.number))

    def mask(self) -> NDArray[np.uint8]:
        """(h, w) uint8 of 0 and 255, as it decodes."""
        return np.ascontiguousarray(self.clip.mask(self.number))


@dataclass(frozen=True, eq=False)
class Everything:
    """The mask of a view without one, among views with masks: it says nothing against any place."""

    camera: Camera

    def content(self) -> Any:
        """Names the mask."""
        return ["everything", self.camera.width, self.camera.height]

    def mask(self) -> NDArray[np.uint8]:
        """(h, w) uint8 of 255."""
        return np.full((self.camera.height, self.camera.width), 255, np.uint8)


Source = Photograph | ClipFrame
MaskSource = Photograph | ClipFrame | Everything


def clip_frames(clips: Clips, frame: int) -> list[ClipFrame]:
    """All cameras' images at a moment of the clips."""
    numbers = clips.numbers[frame]
    return [ClipFrame.of(c, int(n)) for c, n in zip(clips.clips, numbers, strict=True)]


def photographs(frames: Sequence[Frame], cameras: Sequence[Camera]) -> list[Photograph]:
    """A caller's images with their cameras."""
    pairs = zip(frames, cameras, strict=True)
    return [Photograph(f if isinstance(f, np.ndarray) else Path(f), c, n) for n, (f, c) in enumerate(pairs)]


def mask_sources(masks: Sequence[Frame | None], cameras: Sequence[Camera]) -> list[MaskSource]:
    """A caller's masks with their cameras; None where a view has none."""
    given = [
        c if m is None else Photograph(m if isinstance(m, np.ndarray) else Path(m), c, n) for n, (m, c) in enumerate(zip(masks, cameras))
    ]
    return [Everything(g) if isinstance(g, Camera) else g for g in given]
