"""Video files: how many frames they hold, when each is shown, and any one of them.

What a file's header says of its length and rate is not used: packets are counted. A file whose first or last pictures do not decode
as its packets announce (cut streams, fields, invisible pictures) is decoded once from end to end instead.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from ..types import Image

HEAD = 16
"""Frames at a file's start that are decoded to see whether packets tell what is shown."""
NEAR = 48
"""Frames that are skipped by decoding rather than by searching."""
BACK = (0, 1, 3, 8)
"""Key frames further back at which a stream is entered where it cannot be at the nearest."""
OPEN = 16
"""Videos held open in a process."""
JITTER = 0.25
"""Share of a frame's time by which timestamps may be off at a constant rate: containers round them, to milliseconds in WebM."""
MOST_PIXELS = 1 << 27
"""Pixels of a frame above which a file is refused: 16k by 8k."""
INVISIBLE = ("vp8",)
"""Codecs some of whose packets are references that are never shown."""


@dataclass(frozen=True)
class Stream:
    """What a video file holds.

    width, height : pixels as they are stored. turn : quarter turns, counter-clockwise, that the file asks for to be shown upright.
    rate : frames a second, in the mean where it varies; 0 where the file has no times.
    times : seconds of each frame after the first, (frames,); evenly spaced where the rate is constant. interlaced : frames are two fields.
    pts : timestamp of each frame in the stream's units, or None where frames have none. keys : those from which decoding can begin.
    """

    width: int
    height: int
    turn: int
    rate: float
    steady: bool
    interlaced: bool
    times: NDArray[np.float64]
    pts: NDArray[np.int64] | None
    keys: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.times)


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """FFmpeg's errors as ours, with the path."""
    try:
        yield
    except (av.FFmpegError, ValueError, IndexError) as error:  # PyAV looks up streams that damaged packets name
        if isinstance(error, FormatError):
            raise
        reason = getattr(error, "strerror", None) or str(error)
        raise FormatError(f"{path}: not a video that FFmpeg decodes: {reason}") from None


def _open(path: Path) -> tuple[Any, Any]:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such video")
    with _reading(path):
        container = av.open(str(path), metadata_errors="replace")
        stream = next((s for s in container.streams.video if not s.disposition & av.stream.Disposition.attached_pic), None)
        if stream is None or stream.codec_context is None:
            container.close()
            raise FormatError(f"{path}: holds no video of a codec that FFmpeg knows")
        size = (stream.codec_context.width, stream.codec_context.height)
        if size[0] * size[1] > MOST_PIXELS:
            container.close()
            raise FormatError(f"{path}: expected frames of at most {MOST_PIXELS >> 20} megapixels, got {size[0]} x {size[1]}")
        return container, stream


def _frames(container: Any, stream: Any) -> Iterator[Any]:
    """Decoded frames in the order in which they are shown; a damaged end is an end."""
    try:
        yield from container.decode(stream)
    except (av.FFmpegError, IndexError):
        return


def open_stream(path: Path) -> Stream:
    """What a video file holds; kept until the file changes.

    Raises
    ------
    FileNotFoundError, FormatError
        No such file, or none of which a frame can be decoded.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such video")
    status = path.stat()
    return _index(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=256)
def _index(path: Path, _modified: int, _size: int) -> Stream:
    container, stream = _open(path)
    with _reading(path), container:
        base, codec = float(stream.time_base or 0), stream.codec_context.name
        said = float(stream.average_rate or stream.guessed_rate or 0)
        packets = _packets(container, stream)
    first, shown = _head(path)
    pts = None
    if packets is not None and codec not in INVISIBLE:
        pts = _trusted(path, packets, shown)
    keys = np.zeros(0, np.int64) if packets is None else packets[1]
    count = 0 if pts is None else len(pts)
    if pts is None:
        pts, count = _counted(path)
    seconds, rate, steady = np.arange(count) / (said or 1.0), said, True
    if pts is not None and base:
        rate, steady = _rate((pts - pts[0]) * base, said)
        seconds = np.arange(count) / (rate or 1.0) if steady else (pts - pts[0]) * base
    turn, interlaced = round(first.rotation / 90) % 4, bool(first.interlaced_frame)
    return Stream(first.width, first.height, turn, rate, steady, interlaced, seconds, pts, keys)


def _packets(container: Any, stream: Any) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
    """Timestamps of a stream's packets in the order in which they are shown, and those of its key frames; None where some have none."""
    shown, keys = [], []
    try:
        for packet in container.demux(stream):
            if packet.size == 0 or packet.is_discard:
                continue
            if packet.pts is None:
                return None
            shown.append(packet.pts)
            if packet.is_keyframe:
                keys.append(packet.pts)
    except (av.FFmpegError, IndexError):
        pass  # a damaged end: what came before counts
    if not keys or len(set(shown)) < len(shown):
        return None
    return np.sort(np.array(shown, np.int64)), np.sort(np.array(keys, np.int64))


def _head(path: Path) -> tuple[Any, list[int | None]]:
    """The first frame, and the timestamps of the first few."""
    container, stream = _open(path)
    with _reading(path), container:
        first, shown = None, []
        for frame in _frames(container, stream):
            first = first or frame
            shown.append(frame.pts)
            if len(shown) == HEAD:
                break
    if first is None:
        raise FormatError(f"{path}: no frame of this video can be decoded")
    return first, shown


def _trusted(path: Path, packets: tuple[NDArray[np.int64], NDArray[np.int64]], head: list[int | None]) -> NDArray[np.int64] | None:
    """The timestamps of the frames that packets announce, if the first and the last ones decode so; packets before and after them go."""
    pts, keys = packets
    begin = int(np.searchsorted(pts, head[0])) if head[0] is not None else len(pts)
    if pts[begin : begin + len(head)].tolist() != head:
        return None
    tail = _tail(path, keys)
    if not tail or None in tail:
        return None
    start, end = (int(np.searchsorted(pts, t)) for t in (tail[0], tail[-1]))
    return pts[begin : end + 1] if pts[start : end + 1].tolist() == tail and end >= begin else None


def _tail(path: Path, keys: NDArray[np.int64]) -> list[int | None]:
    """Timestamps of the frames from the last key frame on; none where the stream cannot be entered near its end."""
    for back in BACK:
        if back >= len(keys):
            break
        container, stream = _open(path)
        with _reading(path), container:
            container.seek(int(keys[-1 - back]), stream=stream, backward=True)
            tail = [frame.pts for frame in _frames(container, stream)]
        if tail and None not in tail and tail[0] <= keys[-1]:
            return [t for t in tail if t >= keys[-1]]
    return []


def _counted(path: Path) -> tuple[NDArray[np.int64] | None, int]:
    """Timestamps of all frames that decode, or None where some have none; and their number."""
    container, stream = _open(path)
    with _reading(path), container:
        shown = [frame.pts for frame in _frames(container, stream)]
    known = None not in shown and all(a < b for a, b in pairwise(shown))
    return (np.array(shown, np.int64) if known else None), len(shown)


def _rate(seconds: NDArray[np.float64], said: float) -> tuple[float, bool]:
    """Frames a second, and whether all are evenly spaced: as the file says if that fits its timestamps, else in their mean."""
    if len(seconds) < 2:
        return said, True
    count = np.arange(len(seconds))
    mean = float((len(seconds) - 1) / seconds[-1])
    for rate in (said, mean):
        if rate and np.abs(seconds * rate - count).max() < JITTER:
            return rate, True
    return mean, False


class _Reader:
    """An open video and the number of the frame that it decodes next."""

    def __init__(self, path: Path) -> None:
        self.path, self.lock, self.stream = path, threading.Lock(), open_stream(path)
        self.container: Any = None
        self._restart()

    def _restart(self) -> None:
        if self.container is not None:
            self.container.close()
        self.container, self.video = _open(self.path)
        self.frames, self.next = _frames(self.container, self.video), 0

    def frame(self, number: int) -> Image:
        with self.lock, _reading(self.path):
            if not 0 <= number < len(self.stream):
                raise FormatError(f"{self.path}: ends after {len(self.stream)} frames, before frame {number}")
            found = self._by_order(number) if self.stream.pts is None else self._by_time(number)
            if found is None:
                raise FormatError(f"{self.path}: frame {number} cannot be decoded")
            return found.to_ndarray(format="rgb24")

    def _by_order(self, number: int) -> Any:
        if number < self.next:
            self._restart()
        for frame in self.frames:
            self.next += 1
            if self.next > number:
                return frame
        return None

    def _by_time(self, number: int) -> Any:
        pts, keys = self.stream.pts, self.stream.keys
        assert pts is not None
        target = int(pts[number])
        near = number <= self.next + NEAR or not ((keys > pts[self.next]) & (keys <= target)).any()
        if self.next <= number and near and (found := self._forward(target)) is not None:
            return found
        # Some streams cannot be entered at each key frame: then at an earlier one, at last at their start.
        before = keys[keys <= target][::-1]
        for back in BACK:
            if back >= len(before):
                break
            self.container.seek(int(before[back]), stream=self.video, backward=True)
            self.frames = _frames(self.container, self.video)
            if (found := self._forward(target)) is not None:
                return found
        self._restart()
        return self._forward(target)

    def _forward(self, target: int) -> Any:
        """The frame at a timestamp, decoding on; None where the stream passes it by."""
        for frame in self.frames:
            if frame.pts is not None and frame.pts >= target:
                self.next = int(np.searchsorted(self.stream.pts, frame.pts)) + 1  # type: ignore[arg-type]
                return frame if frame.pts == target else None
        self.next = len(self.stream)
        return None


_readers: OrderedDict[Path, _Reader] = OrderedDict()
_readers_lock = threading.Lock()


def video_frame(path: Path, number: int) -> Image:
    """Frame ``number`` of a video as it is stored, (h, w, 3) uint8 RGB; fast where frames are asked for in order.

    Raises
    ------
    FileNotFoundError, FormatError
        No such file, no such frame, or one that cannot be decoded.
    """
    with _readers_lock:
        reader = _readers.pop(path, None) or _Reader(path)
        _readers[path] = reader
        while len(_readers) > OPEN:
            _readers.popitem(last=False)
    return reader.frame(number)
