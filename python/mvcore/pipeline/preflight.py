"""What can be known of a run before any work: does the input fit together, can the output be written, what will it take.

Images are opened for their headers alone. `check` looks at a path as the commands do; `preflight` at what `reconstruct` takes.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..config import Config
from ..errors import FormatError, InvalidInputError, MvcoreError
from ..geometry.cameras import Calibration, Camera
from ..geometry.rig import convergence
from ..io.clips import Clips, find_sources, load_video
from ..io.formats.detect import load
from ..io.selection import select_views
from ..types import Frame
from .checks import (
    Finding,
    Findings,
    available_memory,
    check_bounds,
    check_calibration,
    check_device,
    check_frames,
    check_installation,
    check_masks,
    check_places,
)
from .executors import local_workers
from .session import CACHE, TASK_BYTES, TASK_LEAST, memory_settings

VIEW_SECONDS = 1.0
"""CPU seconds that a view takes whatever its size: the sweep runs on a small image."""
PIXEL_SECONDS = {"sgm": 25.0, "dcnn": 50.0}
"""CPU seconds a megapixel of a view, by matcher. Both measured on the bundled sample; good to a factor of two."""
VIEW_BYTES = 60
"""Bytes a pixel and view of results that are kept in memory where there is room."""
BASE_BYTES = 250 << 20
"""Bytes of a process with its libraries before any image."""


@dataclass(frozen=True)
class Outlook:
    """What a run will do.

    views : cameras. frames : moments of a clip, 1 for photographs. width, height : pixels of the largest view as it is matched.
    sources : of each view, the others that see the scene's middle from a useful angle, nearest first, by the poses alone.
    cores : processors. minutes : expected wall time. memory : expected bytes at the peak, beside the volume's ``volume.max_memory``:
    of the idle process, of the tasks at a time, and of the results that are kept in memory; the others lie on disk.
    """

    views: int
    frames: int
    width: int
    height: int
    sources: tuple[tuple[int, ...], ...]
    cores: int
    minutes: float
    memory: int


@dataclass(frozen=True)
class Preflight:
    """What was noticed, and the outlook where the cameras allow one."""

    findings: tuple[Finding, ...] = ()
    outlook: Outlook | None = None
    format: str = ""

    @property
    def errors(self) -> list[str]:
        """What a run would be refused for."""
        return [str(f) for f in self.findings if f.level == "error"]

    @property
    def warnings(self) -> list[str]:
        """What is doubtful."""
        return [str(f) for f in self.findings if f.level == "warning"]

    def require_good(self) -> None:
        """Raise `InvalidInputError` with the first error, and the number of the others, if there is any."""
        if self.errors:
            more = len(self.errors) - 1
            raise InvalidInputError(self.errors[0] + (f" (and {more} more: see 'mvcore check')" if more else ""))

    def as_dict(self) -> dict[str, Any]:
        """Plain values that JSON can hold."""
        outlook = None if self.outlook is None else {**vars(self.outlook), "sources": [list(s) for s in self.outlook.sources]}
        findings = [vars(f) for f in self.findings]
        return {"good": not self.errors, "format": self.format, "findings": findings, "outlook": outlook}


def preflight(
    frames: Sequence[Frame] | None,
    calib: Calibration | Sequence[Camera],
    masks: Sequence[Frame | None] | str | Path | None = None,
    bounds: ArrayLike | None = None,
    config: Config | Mapping[str, Any] | None = None,
    *,
    outputs: Sequence[str | Path] = (),
    folders: Sequence[str | Path] = (),
    workdir: str | Path | None = None,
    max_memory: int | None = None,
    moments: int = 1,
    remote: bool = False,
    decode_masks: bool = True,
) -> Preflight:
    """Check what `reconstruct` would be called with; nothing is decoded but masks, nothing is written that stays.

    Parameters
    ----------
    frames, calib, masks, bounds, config : as `reconstruct` takes them; frames None where cameras know their sizes (clips).
    outputs, folders : files and folders that are to be written.
    workdir : where results are kept.
    max_memory : bytes that the run may take.
    moments : of a clip, each of which is a reconstruction.
    remote : the work runs elsewhere: this machine's device and memory do not matter.
    decode_masks : False looks at the headers of masks alone, as for images.

    Returns
    -------
    Preflight
        It never raises for what is wrong with its arguments' values: that is what it tells.
    """
    notes = Findings()
    settings = _settings(config, notes)
    cameras = list(calib)
    check_calibration(cameras, notes)
    if frames is not None:
        check_frames(frames, cameras, notes)
        if masks is not None:
            check_masks(masks, frames, cameras, notes, decode_masks)
    # A mirrored calibration's cameras are those of the reflected world, the caller's box is not.
    check_bounds(bounds, [] if getattr(calib, "mirrored", False) else cameras, notes)
    check_places(outputs, [*folders, *([workdir] if workdir is not None else [])], notes)
    if not remote:
        check_device(settings, notes)
    check_installation(notes)
    outlook = _outlook(cameras, settings, moments, max_memory) if len(cameras) >= 2 else None
    if outlook is not None:
        _check_sources(outlook, notes)
        try:
            memory_settings(settings, max_memory, cameras)
        except InvalidInputError as error:
            notes.error("max_memory", error)
    if outlook is not None and not remote:
        _check_memory(outlook, max_memory, notes)
    return Preflight(tuple(notes.items), outlook)


def preflight_clips(
    clips: Clips, bounds: ArrayLike | None = None, config: Config | Mapping[str, Any] | None = None, **arguments: Any
) -> Preflight:
    """The same of clips: their first and last frames are decoded, so that a missing one shows now.

    ``arguments`` are the others of `preflight`: outputs, folders, workdir, max_memory, remote.
    """
    notes = Findings()
    notes.warn_all(clips.warnings)
    for number, clip in enumerate(clips.clips):
        for moment in sorted({0, len(clips) - 1}):
            try:
                clip.frame(int(clips.numbers[moment, number]))
            except (MvcoreError, OSError) as error:
                notes.error(clip.name, error)
    rest = preflight(None, clips.calib, None, bounds, config, moments=len(clips), **arguments)
    return Preflight((*notes.items, *rest.findings), rest.outlook, "clips")


def check(
    path: str | Path,
    *,
    masks: str | Path | None = None,
    bounds: ArrayLike | None = None,
    config: Config | Mapping[str, Any] | None = None,
    only: str | None = None,
    exclude: str | None = None,
    images: str | Path | None = None,
    allow_outside: bool = False,
    outputs: Sequence[str | Path] = (),
    folders: Sequence[str | Path] = (),
    workdir: str | Path | None = None,
    max_memory: int | None = None,
) -> Preflight:
    """Check a folder of calibrated images or of clips before a run; what ``mvcore check`` prints.

    Parameters
    ----------
    path : a folder or calibration file.
    masks : folder of masks.
    bounds, config, max_memory : as `reconstruct` takes them.
    only, exclude : views by name, pattern or number, as on the command line: ``"cam*,0-3"``.
    images : folder of the images, where the calibration does not say.
    allow_outside : follow paths in the calibration that lead out of the folder.
    outputs, folders, workdir : what is to be written.

    Returns
    -------
    Preflight
        It tells what is wrong; nothing is raised for it.

    Examples
    --------
    >>> check("nowhere").errors  # doctest: +ELLIPSIS
    ['input: .../nowhere: no such file or folder']
    """
    places: dict[str, Any] = {"outputs": outputs, "folders": folders, "workdir": workdir, "max_memory": max_memory}
    try:
        try:
            scene = load(path, images=images if images is not None else True, allow_outside=allow_outside)
        except (FormatError, FileNotFoundError):
            if not has_clips(path):
                raise
            return preflight_clips(load_video(path), bounds, config, **places)
        chosen = select_views([c.name for c in scene.calib], only, exclude)
        scene = scene.subset(chosen)
    except (MvcoreError, OSError) as error:
        notes = Findings()
        notes.error("input", error)
        check_places(outputs, folders if workdir is None else [*folders, workdir], notes)
        return Preflight(tuple(notes.items))
    notes = Findings()
    notes.warn_all(scene.warnings)
    kept = masks if masks is not None else scene.masks if scene.alpha else None
    done = preflight(scene.frames, scene.calib, kept, scene.bounds if bounds is None else bounds, config, **places)
    return Preflight((*notes.items, *done.findings), done.outlook, scene.format)


def has_clips(path: str | Path) -> bool:
    """Whether a folder holds clips rather than images of one moment."""
    try:
        return any(Path(str(s)).is_file() or len(list(Path(str(s)).iterdir())) > 1 for s in find_sources(Path(path)).values())
    except (MvcoreError, OSError):
        return False


def _settings(config: Config | Mapping[str, Any] | None, notes: Findings) -> Config:
    try:
        return config if isinstance(config, Config) else Config.from_dict(config or {})
    except InvalidInputError as error:
        notes.error("settings", error)
        return Config()


def _outlook(cameras: Sequence[Camera], config: Config, moments: int, max_memory: int | None) -> Outlook:
    limit = config.depth.max_image_size
    scales = [min(1.0, limit / max(c.width, c.height)) for c in cameras]
    sizes = [(round(c.width * s), round(c.height * s)) for c, s in zip(cameras, scales, strict=True)]
    pixels = np.array([w * h for w, h in sizes], float)
    sources = candidate_sources(cameras, config)
    used = [p / 1e6 for p, s in zip(pixels, sources, strict=True) if s]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    seconds = VIEW_SECONDS * len(used) + PIXEL_SECONDS[config.matcher] * float(sum(used))
    results = min(CACHE, int(VIEW_BYTES * pixels.sum()))
    work = results + local_workers() * int(TASK_BYTES * pixels.max() + TASK_LEAST)
    memory = BASE_BYTES + (work if max_memory is None else min(work, max_memory))
    width, height = sizes[int(pixels.argmax())]
    return Outlook(len(cameras), moments, width, height, sources, cores, round(seconds * moments / cores / 60, 2), memory)


def candidate_sources(cameras: Sequence[Camera], config: Config) -> tuple[tuple[int, ...], ...]:
    """Of each view, the others that look the same way and see the scene's middle from a useful angle, the best angles first."""
    middle = convergence(cameras)
    rays = np.array([middle - c.center for c in cameras])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True).clip(1e-300)
    axes = np.array([c.axis for c in cameras])
    angles = np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1)))
    turns = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    out = []
    for n in range(len(cameras)):
        near = [j for j in range(len(cameras)) if j != n and angles[n, j] <= config.depth.max_angle and turns[n, j] <= 90]
        near.sort(key=lambda j: abs(angles[n, j] - config.depth.best_angle))
        out.append(tuple(near[: config.depth.sources]))
    return tuple(out)


def _check_memory(outlook: Outlook, max_memory: int | None, notes: Findings) -> None:
    free = available_memory()
    if max_memory is not None and free is not None and max_memory > free:
        notes.warn("max_memory", f"{max_memory / 2**30:.1f} GiB are allowed, {free / 2**30:.1f} GiB are free")
    if max_memory is None and free is not None and outlook.memory > free:
        text = f"about {outlook.memory / 2**30:.1f} GiB are needed, {free / 2**30:.1f} GiB are free"
        notes.warn("memory", f"{text}: a smaller max_image_size, a max_memory or fewer views help")


def _check_sources(outlook: Outlook, notes: Findings) -> None:
    if not any(outlook.sources):
        notes.warn("calib", "by the poses alone no two views see the same surface from a useful angle")
