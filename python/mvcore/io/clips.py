"""Multi-view video: one clip a camera, instants that all of them show."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError, InvalidInputError, require
from ..geometry.cameras import Calibration, Camera
from ..types import Image
from .formats.detect import load
from .formats.records import image_size
from .images import read_image, undistort
from .media import VIDEO_SUFFIXES, frame_files, plate_in, probe, video_frame
from .pairing import natural_order

Source = str | Path | Sequence[str | Path] | NDArray[np.uint8]
"""A video file, a folder of images, their paths in order, or an array (frames, h, w, 3)."""

CROP = 0.02
"""Share of a side that a codec may have cut off: sides are padded to multiples of 16 or so."""
SAME_SHAPE = 0.005
"""Relative difference of two images' proportions that still is the same picture at another size."""


@dataclass(frozen=True)
class Clip:
    """One camera's frames. ``rate`` is frames a second, 0 where unknown; ``plate`` a picture without the target."""

    name: str
    source: Any
    frames: int
    width: int
    height: int
    rate: float = 0.0
    plate: Path | None = None

    def frame(self, number: int) -> Image:
        """Frame ``number``, (h, w, 3) uint8 RGB."""
        if isinstance(self.source, Path):
            image = video_frame(self.source, number)
        elif isinstance(self.source, tuple):
            image = read_image(self.source[number])
        else:
            image = self.source[number]
        if image.shape[:2] != (self.height, self.width):
            raise FormatError(
                f"{self.name}: frame {number} has {image.shape[1]} x {image.shape[0]} pixels, the first {self.width} x {self.height}"
            )
        return image


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
    start: int = 0,
    stop: int | None = None,
    stride: int = 1,
) -> Clips:
    """Open synchronised clips; no frame is kept.

    Parameters
    ----------
    path : a folder (video files, or a folder of images a camera, in it or in its ``videos`` or ``images``), or {camera: source}.
    calib : cameras, or a path that `mvcore.load` reads; by default what lies in the folder. Matched with clips by name, else in order.
    offsets : seconds that must be added to the common time to get a camera's own, by camera name.
    rates : frames a second, of all cameras or by name, where files do not say or are wrong.
    start, stop, stride : instants to take, as in ``range``; instants are the frames of the slowest camera.

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
    sources = dict(path) if isinstance(path, Mapping) else _find_sources(Path(path))
    clips = [_clip(name, source) for name, source in sources.items()]
    if calib is None:
        require(not isinstance(path, Mapping), "calib", "cameras for the given clips", None)
        calib = load(path, images=False).calib  # type: ignore[arg-type]
    elif isinstance(calib, str | Path):
        calib = load(calib, images=False).calib
    cameras = list(calib)
    clips = _matched(clips, cameras)
    warnings: list[str] = []
    cameras = [_fitted(clip, camera, warnings) for clip, camera in zip(clips, cameras, strict=True)]
    numbers, times = _timeline(clips, offsets or {}, rates, warnings)
    require(stride >= 1, "stride", "at least 1", stride)
    chosen = range(len(numbers))[start:stop:stride]
    if not len(chosen):
        raise InvalidInputError(f"start, stop: expected instants of 0 .. {len(numbers)}, got {start} .. {stop}")
    index = np.array(chosen)
    return Clips(tuple(clips), Calibration(tuple(cameras)), numbers[index], times[index], numbers, tuple(warnings))


def _find_sources(folder: Path) -> dict[str, Source]:
    """The cameras' clips below a folder, by name."""
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of clips")
    for base in (folder, folder / "videos", folder / "images"):
        if not base.is_dir():
            continue
        videos = [f for f in base.iterdir() if f.suffix.lower() in VIDEO_SUFFIXES]
        if videos:
            return {f.stem: f for f in sorted(videos, key=natural_order)}
        folders = [f for f in base.iterdir() if f.is_dir() and f.name not in ("masks", "depth", "videos", "images") and frame_files(f)]
        if folders:
            return {f.name: f for f in sorted(folders, key=natural_order)}
    raise FormatError(f"{folder}: expected video files or a folder of images a camera, in it or in its 'videos' or 'images'")


def _clip(name: str, source: Source) -> Clip:
    if isinstance(source, str | Path) and not Path(source).is_dir():
        path = Path(source).absolute()
        found = probe(path)
        return Clip(name, path, found.frames, found.width, found.height, found.rate)
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


def _keys(camera: Camera) -> list[str]:
    """What a camera's clip may be called: the camera's own name, its file's or its folder's."""
    path = Path(camera.name)
    return [camera.name, path.stem, path.parent.name]


def _matched(clips: Sequence[Clip], cameras: Sequence[Camera]) -> list[Clip]:
    """The clips in the cameras' order."""
    by_name = {c.name: c for c in clips}
    for n in range(3):
        names = [_keys(c)[n] for c in cameras]
        if len(set(names)) == len(names) and set(names) <= set(by_name):
            return [by_name[name] for name in names]
    named, mine = ", ".join(by_name), ", ".join(c.name for c in cameras)
    require(len(clips) == len(cameras), "clips", f"one a camera ({mine})", f"{len(clips)} ({named})")
    return list(clips)


def _fitted(clip: Clip, camera: Camera, warnings: list[str]) -> Camera:
    """The camera of the frames as they decode, with a warning where that is not what was calibrated."""
    camera = replace(camera, name=clip.name)
    have, want = (clip.width, clip.height), (camera.width, camera.height)
    if have == want:
        return camera
    said = f"{clip.name}: frames have {have[0]} x {have[1]} pixels, the calibration {want[0]} x {want[1]}"
    if all(w * (1 - CROP) <= h <= w for h, w in zip(have, want, strict=True)):
        warnings.append(f"{said}; taken as cut off at the right and bottom, as codecs do")
        return replace(camera, width=have[0], height=have[1])
    if abs(have[0] * want[1] / (have[1] * want[0]) - 1) < SAME_SHAPE:
        warnings.append(f"{said}; taken as the same picture at another size")
        return camera.resized(*have)
    raise FormatError(f"{said}: neither cut by a few pixels nor at another size")


def _timeline(
    clips: Sequence[Clip], offsets: Mapping[str, float], rates: Mapping[str, float] | float | None, warnings: list[str]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Frame numbers (instants, cameras) and times."""
    names = {c.name for c in clips}
    given = dict.fromkeys(names, rates) if isinstance(rates, int | float) else dict(rates or {})
    for label, mapping in (("offsets", offsets), ("rates", given)):
        unknown = sorted(set(mapping) - names)
        require(not unknown, label, f"camera names ({', '.join(sorted(names))})", ", ".join(unknown))
    for clip in clips:
        told = given.get(clip.name)
        require(told is None or told > 0, "rates", "frames a second above 0", told)
        if told and clip.rate and abs(told / clip.rate - 1) > 0.01:
            warnings.append(f"{clip.name}: the file says {clip.rate:g} frames a second, {told:g} were given and are used")
    rate = np.array([given.get(c.name) or c.rate for c in clips], float)
    shift = np.array([offsets.get(c.name, 0.0) for c in clips], float)
    if (rate == 0).any():
        if rate.any() and (rate == 0).sum():
            silent = ", ".join(c.name for c, r in zip(clips, rate, strict=True) if r == 0)
            warnings.append(f"no frame rate is known of {silent}: frames are taken one by one")
        require(not shift.any(), "rates", "frames a second of every camera, as offsets are in seconds", None)
        rate = np.ones(len(clips))
    elif np.ptp(rate) > 0.01 * rate.min():
        told_rates = ", ".join(f"{c.name} {r:g}" for c, r in zip(clips, rate, strict=True))
        warnings.append(f"frame rates differ ({told_rates}): the nearest frame of each camera is taken")
    counts = np.array([c.frames for c in clips])
    if len(set(counts.tolist())) > 1:
        told_counts = ", ".join(f"{c.name} {n}" for c, n in zip(clips, counts, strict=True))
        warnings.append(f"frame counts differ ({told_counts}): the common instants are used")
    slowest = rate.min()
    first = int(np.ceil(max(0.0, float((-shift).max())) * slowest - 1e-6))
    last = int(np.floor(float(((counts - 0.5) / rate - shift).min()) * slowest + 1e-6))
    times = np.arange(first, last + 1) / slowest
    numbers = np.rint((times[:, None] + shift) * rate).astype(np.int64)
    inside = ((numbers >= 0) & (numbers < counts)).all(1)
    if not inside.any():
        raise InvalidInputError("offsets: expected clips that overlap in time, got none in common")
    return numbers[inside], times[inside]
