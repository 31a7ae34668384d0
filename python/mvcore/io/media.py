"""Video files and folders of frames: what they hold, and single frames of them."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

import cv2

from ..errors import FormatError
from ..types import Image
from .formats.records import IMAGE_SUFFIXES, image_size
from .pairing import natural_order

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")
PLATES = ("background", "clean", "plate", "empty")
"""Names, without their suffix, of a picture without the target among a camera's frames."""


@dataclass(frozen=True)
class Media:
    """What a video file holds. ``rate`` is frames a second; 0 where the file does not say."""

    width: int
    height: int
    frames: int
    rate: float


def frame_files(folder: Path) -> list[Path]:
    """A folder's images in natural order, without a clean plate."""
    files = [f for f in folder.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES and f.stem.lower() not in PLATES]
    return sorted(files, key=natural_order)


def plate_in(folder: Path) -> Path | None:
    """A folder's clean plate."""
    return next((f for f in sorted(folder.iterdir()) if f.stem.lower() in PLATES and f.suffix.lower() in IMAGE_SUFFIXES), None)


def probe(path: Path) -> Media:
    """What a video file holds, as its first frame decodes.

    Raises
    ------
    FileNotFoundError, FormatError
        No such file, or none that OpenCV decodes.
    """
    capture = _open(path)
    try:
        done, frame = capture.read()
        if not done:
            raise FormatError(f"{path}: no frame of this video can be decoded")
        count, rate = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), float(capture.get(cv2.CAP_PROP_FPS))
        return Media(frame.shape[1], frame.shape[0], count, rate if 0 < rate < 1e5 else 0.0)
    finally:
        capture.release()


def _open(path: Path) -> cv2.VideoCapture:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such video")
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise FormatError(f"{path}: not a video that OpenCV reads")
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # calibrations know the sensor's rows
    return capture


def media_size(folder: Path, name: str) -> tuple[int, int]:
    """(width, height) of a camera's ``images/NAME`` folder or ``videos/NAME`` file; (0, 0) where there is neither."""
    frames = folder / "images" / name
    if frames.is_dir() and (files := frame_files(frames)):
        return image_size(files[0])
    for suffix in VIDEO_SUFFIXES:
        if (file := folder / "videos" / f"{name}{suffix}").is_file():
            found = probe(file)
            return found.width, found.height
    return 0, 0


class _Reader:
    """An open video and the number of its next frame."""

    def __init__(self, path: Path) -> None:
        self.path, self.lock = path, threading.Lock()
        self.capture, self.next = _open(path), 0

    def frame(self, number: int) -> Image:
        with self.lock:
            if not self.next <= number <= self.next + NEAR:
                # Files are searched from a key frame on; where a backend lands elsewhere, decoding from the start never does.
                if not (self.capture.set(cv2.CAP_PROP_POS_FRAMES, number) and round(self.capture.get(cv2.CAP_PROP_POS_FRAMES)) == number):
                    self.capture.release()
                    self.capture, self.next = _open(self.path), 0
                else:
                    self.next = number
            while self.next < number:
                if not self.capture.grab():
                    raise FormatError(f"{self.path}: ends after {self.next} frames, before frame {number}")
                self.next += 1
            done, frame = self.capture.read()
            if not done:
                raise FormatError(f"{self.path}: frame {number} cannot be decoded")
            self.next += 1
            return cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)


NEAR = 48
"""Frames that are skipped by decoding rather than by searching."""
OPEN = 16
"""Videos held open in a process."""
_readers: OrderedDict[Path, _Reader] = OrderedDict()
_readers_lock = threading.Lock()


def video_frame(path: Path, number: int) -> Image:
    """Frame ``number`` of a video, (h, w, 3) uint8 RGB; fast where frames are asked for in order."""
    with _readers_lock:
        reader = _readers.pop(path, None) or _Reader(path)
        _readers[path] = reader
        while len(_readers) > OPEN:
            _readers.popitem(last=False)
    return reader.frame(number)
