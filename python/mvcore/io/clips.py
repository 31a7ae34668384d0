"""Multi-view video: one clip a camera, instants that all of them show."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError, InvalidInputError, MvcoreError, require
from ..geometry.cameras import Calibration, Camera
from ..types import Image
from .clip_cameras import fitted, matched, turned
from .formats.detect import load
from .formats.records import image_size
from .images import undistort
from .media import Clip, frame_files, is_video, plate_in
from .pairing import natural_order
from .selection import select_views
from .streams import open_stream
from .timeline import timeline

Source = str | Path | Sequence[str | Path] | NDArray[np.uint8]
"""A video file, a folder of images, their paths in order, or an array (frames, h, w, 3)."""


@dataclass(frozen=True)
class Instant:
    """All cameras' frames at one time. ``number`` counts instants from 0, ``time`` is in seconds (or instants where rates are unknown)."""

    number: int
    time: float
    frames: tuple[Image, ...]


@dataclass(frozen=True)
class Clips:
    """Synchronised clips with their calibration; what `load_video` returns.

    calib : the cameras of the frames as they decode. numbers : (instants, cameras) the frame of each camera at each instant.
    times : seconds of each instant after the first camera's start, or frame numbers where no rate is known.
    timeline : as ``numbers``, of all that the clips show together, also what start, stop and stride leave out.
    warnings : what does not fit: sizes, frame counts, rates.
    """

    clips: tuple[Clip, ...]
    calib: Calibration
    numbers: NDArray[np.int64]
    times: NDArray[np.float64]
    timeline: NDArray[np.int64]
    warnings: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.numbers)

    def frame(self, camera: int, instant: int) -> Image:
        """One camera's frame at an instant, as it decodes."""
        return self.clips[camera].frame(int(self.numbers[instant, camera]))

    def undistorted(self, camera: int, instant: int) -> Image:
        """The frame that a pinhole with the camera's K would have taken."""
        return self.undistorted_frame(camera, int(self.numbers[instant, camera]))

    def undistorted_frame(self, camera: int, number: int) -> Image:
        """The same of a frame by its number in the clip."""
        return undistort(np.ascontiguousarray(self.clips[camera].frame(number)), self.calib[camera])

    def __iter__(self) -> Iterator[Instant]:
        """The instants in order; a thread reads ahead, at most `AHEAD` of them are held."""
        waiting: queue.Queue[Instant | BaseException | None] = queue.Queue(AHEAD)
        stopped = threading.Event()

        def put(item: Instant | BaseException | None) -> bool:
            while not stopped.is_set():
                try:
                    waiting.put(item, timeout=0.1)
                    return True
                except queue.Full:
                    continue
            return False

        def read() -> None:
            try:
                for n in range(len(self)):
                    frames = tuple(self.frame(c, n) for c in range(len(self.clips)))
                    if not put(Instant(n, float(self.times[n]), frames)):
                        return
                put(None)
            except BaseException as error:
                put(error)

        thread = threading.Thread(target=read, name="mvcore-read-ahead", daemon=True)
        thread.start()
        try:
            while (item := waiting.get()) is not None:
                if isinstance(item, BaseException):
                    raise item
                yield item
        finally:
            stopped.set()
            thread.join()


AHEAD = 2


def load_video(
    path: str | Path | Mapping[str, Source],
    calib: Calibration | Sequence[Camera] | str | Path | None = None,
    *,
    offsets: Mapping[str, float] | None = None,
    rates: Mapping[str, float] | float | None = None,
    rotation: str | int | Mapping[str, str | int] = "auto",
    start: int = 0,
    stop: int | None = None,
    stride: int = 1,
    only: str | None = None,
    exclude: str | None = None,
    allow_outside: bool = False,
) -> Clips:
    """Open synchronised clips; no frame is kept.

    Parameters
    ----------
    path : a folder (video files, or a folder of images a camera, in it or in its ``videos`` or ``images``), or {camera: source}.
    calib : cameras, or a path that `mvcore.load` reads; by default what lies in the folder. They belong to the clips of their names;
        cameras without names to the clips in order.
    offsets : seconds that must be added to the common time to get a camera's own, by camera name.
    rates : frames a second, of all cameras or by name, where files do not say or are wrong.
    rotation : degrees clockwise (0, 90, 180, 270) by which stored frames are turned, of all cameras or by name; ``auto`` turns them as the
        file says where the calibration's size allows it.
    start, stop, stride : instants to take, as in ``range``; instants are the frames of the slowest camera.
    only, exclude : cameras by name, pattern or number, as on the command line: ``"cam*,0-3"``.
    allow_outside : follow paths in the calibration that lead out of its folder.

    Raises
    ------
    FileNotFoundError, FormatError
        Nothing that can be read, or clips whose size cannot be the calibrated cameras'.
    InvalidInputError
        Clips and cameras that do not belong together, or no instant left.

    Examples
    --------
    >>> frames = np.zeros((3, 48, 64, 3), np.uint8)
    >>> camera = Camera(K=[[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]], R=np.eye(3), t=[0, 0, 2], width=64, height=48)
    >>> len(load_video({"a": frames, "b": frames}, [camera, camera]))
    3
    """
    if not isinstance(path, Mapping):
        find_sources(Path(path))  # a folder without clips is named before its calibration is
    if calib is None:
        require(not isinstance(path, Mapping), "calib", "cameras for the given clips", None)
        calib = path  # type: ignore[assignment]
    if isinstance(calib, str | Path):
        calib = load(calib, images=False, allow_outside=allow_outside).calib
    source, mirrored = (calib.source, calib.mirrored) if isinstance(calib, Calibration) else ("", False)
    clips, cameras = _matched(path, list(calib), only, exclude)  # type: ignore[arg-type]
    warnings: list[str] = []
    clips = turned(clips, cameras, rotation, warnings)
    warnings += [f"{c.name}: frames are interlaced: moving edges have teeth" for c in clips if _interlaced(c)]
    cameras = [fitted(clip, camera, warnings) for clip, camera in zip(clips, cameras, strict=True)]
    numbers, times = timeline(clips, offsets or {}, rates, warnings)
    index = _taken(len(numbers), start, stop, stride)
    return Clips(tuple(clips), Calibration(tuple(cameras), source, mirrored), numbers[index], times[index], numbers, tuple(warnings))


def _taken(count: int, start: int, stop: int | None, stride: int) -> NDArray[np.int64]:
    require(stride >= 1, "stride", "at least 1", stride)
    chosen = np.arange(count)[start:stop:stride]
    if not len(chosen):
        raise InvalidInputError(f"start, stop: expected instants of 0 .. {count}, got {start} .. {stop}")
    return chosen


def _matched(
    path: str | Path | Mapping[str, Source], cameras: list[Camera], only: str | None, exclude: str | None
) -> tuple[list[Clip], list[Camera]]:
    """The cameras and their clips, of the first place in the folder whose clips are the cameras'."""
    reason: MvcoreError | None = None
    for sources in [dict(path)] if isinstance(path, Mapping) else _places(Path(path)):
        try:
            clips, chosen = _selected([_clip(name, source) for name, source in sources.items()], cameras, only, exclude)
            return matched(clips, chosen), chosen
        except MvcoreError as error:
            reason = reason or error
    raise reason or InvalidInputError("path: expected clips, got none")


def _selected(clips: list[Clip], cameras: list[Camera], only: str | None, exclude: str | None) -> tuple[list[Clip], list[Camera]]:
    """What ``only`` and ``exclude`` leave; of cameras with names the clips are matched afterwards."""
    if only is None and exclude is None:
        return clips, cameras
    named = any(c.name for c in cameras)
    kept = select_views([c.name for c in (cameras if named else clips)], only, exclude)
    return clips if named else [clips[n] for n in kept], [cameras[n] for n in kept]


def _interlaced(clip: Clip) -> bool:
    return isinstance(clip.source, Path) and open_stream(clip.source).interlaced


def find_sources(folder: Path) -> dict[str, Source]:
    """The cameras' clips below a folder, by name; of several places that may hold them the surest."""
    found = next(_places(folder), None)
    if found is None:
        raise FormatError(
            f"{folder}: expected video files or a folder of images a camera, in it or in its 'videos' or 'images'; for images of one "
            "moment use 'mvcore reconstruct'"
        )
    return found


def _places(folder: Path) -> Iterator[dict[str, Source]]:
    """The clips of each place below a folder that holds some."""
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of clips")
    reason: FormatError | None = None
    for base in (folder, folder / "videos", folder / "images"):
        if not base.is_dir():
            continue
        try:
            if videos := sorted((f for f in base.iterdir() if is_video(f)), key=natural_order):
                yield _by_stem(videos)
        except FormatError as error:  # two files of a camera, which matters where there is no other place
            reason = reason or error
        folders = [f for f in base.iterdir() if f.is_dir() and f.name not in NO_CAMERAS and not f.name.startswith(".") and frame_files(f)]
        if folders:
            reason = None
            yield {f.name: f for f in sorted(folders, key=natural_order)}
    if reason is not None:
        raise reason


NO_CAMERAS = ("masks", "depth", "videos", "images")
"""Folders that are no camera's."""


def _by_stem(videos: Sequence[Path]) -> dict[str, Source]:
    found: dict[str, Source] = {}
    for file in videos:
        if file.stem in found:
            raise FormatError(f"{file}: expected one clip a camera, got {Path(str(found[file.stem])).name} as well")
        found[file.stem] = file
    return found


def _clip(name: str, source: Source) -> Clip:
    if isinstance(source, str | Path) and not Path(source).is_dir():
        path = Path(source).absolute()
        stream = open_stream(path)
        return Clip(name, path, len(stream), stream.width, stream.height, stream.rate)
    plate = None
    if isinstance(source, str | Path):
        plate = plate_in(Path(source).absolute())
        source = [f.absolute() for f in frame_files(Path(source))]
    if isinstance(source, Sequence):
        files = tuple(Path(f).absolute() for f in source)
        require(len(files) > 0, f"clip {name!r}", "at least one frame", "none")
        width, height = image_size(files[0])
        return Clip(name, files, len(files), width, height, plate=plate)
    array = np.asarray(source)
    good = array.ndim == 4 and array.shape[3] == 3 and array.dtype == np.uint8 and len(array)
    require(good, f"clip {name!r}", "(frames, h, w, 3) uint8", f"{array.shape} {array.dtype}")
    return Clip(name, array, len(array), array.shape[2], array.shape[1])
