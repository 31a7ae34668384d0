"""Multi-view video: a textured mesh an instant, or one model of a rigid target from all of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..config import Config
from ..errors import require
from ..geometry.cameras import Calibration, Camera
from ..geometry.local_frame import LocalFrame
from ..io.clips import Clips, Source, load_video
from ..io.images import find_pictures, read_image, undistort
from ..io.media import Clip, image_turn
from ..pipeline.checks import as_box
from ..pipeline.cluster import Cluster
from ..pipeline.preflight import preflight_clips
from ..pipeline.result import Reconstruction
from ..types import Image, Track, no_track
from .run import ClipRun, Job
from .tracking import split_targets
from .writer import SequenceWriter


@dataclass
class VideoReconstruction:
    """The instants of a clip, reconstructed as they are asked for; iterate once over it, or call `save`.

    model : after the last instant of a rigid target, one `Reconstruction` of all instants in the first one's frame.
    trajectory : (T, 4, 4) float64, which bring the model into the world at each instant, NaN where the target is not seen.
    times : (T,) seconds; names : of the cameras.
    seconds : wall seconds of each instant, the first with what is learnt once a clip.
    warnings : what the clips, the calibration and the run had to say.
    """

    times: NDArray[np.float64]
    names: list[str]
    warnings: list[str]
    _instants: Iterator[Reconstruction]
    model: Reconstruction | None = None
    trajectory: NDArray[np.float64] | None = None
    seconds: list[float] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.times)

    def __iter__(self) -> Iterator[Reconstruction]:
        return self._instants

    def save(self, folder: str | Path) -> None:
        """Write what is still to come into a folder; nothing of it stays in memory.

        A GLB an instant and target, pictures of depth maps, for a rigid target the model, still and animated, and at last ``index.json``.
        """
        writer = SequenceWriter(folder)
        for result in self:
            writer.add(result, split_targets(result), self.names)
        writer.finish(self.warnings, self.model, self.trajectory)


def reconstruct_video(
    clips: Clips,
    calib: Calibration | Sequence[Camera] | str | Path | None = None,
    *,
    masks: str | Path | Mapping[str, Source] | None = None,
    background: str | Path | Mapping[str, Any] | bool | None = None,
    regions: Mapping[str, Any] | None = None,
    bounds: ArrayLike | None = None,
    target: str = "free",
    config: Config | Mapping[str, Any] | None = None,
    executor: Executor | None = None,
    scheduler: str | Cluster | None = None,
    workdir: str | Path | None = None,
    max_memory: int | None = None,
    track: Track | None = None,
) -> VideoReconstruction:
    """Synchronised clips in, a textured mesh an instant out.

    Parameters
    ----------
    clips : of `mvcore.load_video`.
    calib : other cameras than the clips' own, in their order, or a path that `mvcore.load` reads.
    masks : clips of masks (bright on the target) by camera, or the folder of them; by default the target is found.
    background : clean plates by camera (path or array), or a folder of them; by default those beside the frames, else what a background
        model learns over the clip. False reconstructs the whole scene, without a target.
    regions : by camera an image, non-zero where targets may be (a road).
    bounds : ((x0, y0, z0), (x1, y1, z1)) in the world, in which targets are.
    target : ``free``, or ``rigid``: the target's poses are found and all instants fuse into one model.
    executor : where the work runs, any concurrent.futures executor; by default local threads.
    scheduler : address of a dask.distributed scheduler instead, ``tcp://host:port``, or a `Cluster` with TLS;
        ``workdir`` must then be a folder that all share.
    workdir : keeps results by content; the same call goes on there after an interruption. By default a temporary folder.
    max_memory : bytes that the process may take beyond what it takes idle.

    Returns
    -------
    VideoReconstruction
        Iterate over it for a `Reconstruction` an instant, in order. Without a target at an instant its mesh is empty and says so.

    Raises
    ------
    InvalidInputError
        Arguments that do not fit each other.
    ReconstructionError
        Nothing moves and no masks are given, or the calibration does not fit.
    """
    require(executor is None or scheduler is None, "executor, scheduler", "one of them", "both")
    settings = config if isinstance(config, Config) else Config.from_dict(config or {})
    job = _job(clips, calib, masks, background, regions, bounds, settings)
    require(target in ("free", "rigid"), "target", "free or rigid", repr(target))
    require(target == "free" or not job.whole, "background", "a target for target='rigid'", "False: the whole scene")
    remote = executor is not None or scheduler is not None
    before = preflight_clips(job.clips, bounds, settings, workdir=workdir, max_memory=max_memory, remote=remote)
    before.require_good()
    names = [c.name for c in job.clips.clips]
    run = VideoReconstruction(job.clips.times, names, before.warnings, iter(()))
    clip_run = ClipRun(job, run, target == "rigid", executor, scheduler, workdir, max_memory, track or no_track)
    run._instants = clip_run.frames()
    return run


def _job(clips: Any, calib: Any, masks: Any, background: Any, regions: Any, bounds: ArrayLike | None, config: Config) -> Job:
    """What a caller asks for, checked, in the local frame."""
    require(isinstance(clips, Clips), "clips", "what mvcore.load_video returns", type(clips).__name__)
    if calib is not None:
        clips = with_calibration(clips, calib)
    clips.calib.check_baselines()
    plates = [None] * len(clips.clips) if background is False else _plates(clips, background)
    frame, box = LocalFrame.of(clips.calib), as_box(bounds)
    return Job(
        clips,
        None if masks is None else _mask_clips(masks, clips),
        plates,
        _regions(regions or {}, clips),
        background is False and masks is None,
        None if box is None else frame.box_inwards(box),
        config,
        frame,
    )


def with_calibration(clips: Clips, calib: Calibration | Sequence[Camera] | str | Path) -> Clips:
    """The same clips with other cameras."""
    from ..io import load

    cameras = load(calib, images=False).calib if isinstance(calib, str | Path) else calib
    require(len(cameras) == len(clips.clips), "calib", f"{len(clips.clips)} cameras, one a clip", len(cameras))
    for clip, camera in zip(clips.clips, cameras, strict=True):
        same = (clip.width, clip.height) == (camera.width, camera.height)
        require(same, f"calib of {clip.name}", f"{clip.width} x {clip.height} pixels", f"{camera.width} x {camera.height}")
    mirrored = isinstance(cameras, Calibration) and cameras.mirrored
    return replace(clips, calib=Calibration(tuple(cameras), mirrored=mirrored))


def _mask_clips(masks: str | Path | Mapping[str, Source], clips: Clips) -> Clips:
    if isinstance(masks, Mapping):
        masks = {name: _three_channels(source) for name, source in masks.items()}
    found = load_video(masks, clips.calib)
    frames = int(clips.numbers.max()) + 1
    short = [c.name for c in found.clips if c.frames < frames]
    require(not short, "masks", f"at least {frames} frames a camera, as the clips", f"fewer of {', '.join(short)}")
    return replace(found, numbers=clips.numbers, times=clips.times)


def _three_channels(source: Any) -> Any:
    if not isinstance(source, np.ndarray) or source.ndim != 3:
        return source
    bright = (source > (0 if source.dtype == np.bool_ or source.max(initial=0) <= 1 else 127)).astype(np.uint8) * np.uint8(255)
    return np.broadcast_to(bright[..., None], (*bright.shape, 3))


def _picture(value: Any, clip: Clip, camera: Camera, label: str) -> Image:
    image = _turned(value, clip) if isinstance(value, str | Path) else np.asarray(value)
    if image.ndim == 2:
        image = np.repeat(image.astype(np.uint8)[..., None], 3, 2)
    require(image.shape == (camera.height, camera.width, 3), label, f"{camera.width} x {camera.height} pixels", image.shape)
    return undistort(np.ascontiguousarray(image, np.uint8), camera)


def _turned(path: str | Path, clip: Clip) -> Image:
    """A picture of a clip's camera at the size of its frames: turned as they are if it lies beside them, else as its EXIF says."""
    image, own = read_image(path), image_turn(Path(path))
    turns = (clip.turn, own, 0) if clip.plate == path else (own, 0, clip.turn)
    shapes = {t: (image.shape[:2], image.shape[1::-1])[t % 2] for t in turns}
    return np.ascontiguousarray(np.rot90(image, next((t for t in turns if shapes[t] == (clip.height, clip.width)), 0)))


def _by_camera(mapping: Mapping[str, Any], clips: Clips, label: str) -> list[Any]:
    names = [c.name for c in clips.clips]
    unknown = sorted(set(mapping) - set(names))
    require(not unknown, label, f"camera names ({', '.join(names)})", ", ".join(unknown))
    return [mapping.get(n) for n in names]


def _plates(clips: Clips, background: Any) -> list[Image | None]:
    if isinstance(background, str | Path):
        background = find_pictures(background, [c.name for c in clips.clips])
    given = [c.plate for c in clips.clips] if not isinstance(background, Mapping) else _by_camera(background, clips, "background")
    pictures = zip(given, clips.clips, clips.calib, strict=True)
    return [None if g is None else _picture(g, clip, camera, f"background of {clip.name}") for g, clip, camera in pictures]


def _regions(regions: Mapping[str, Any], clips: Clips) -> list[NDArray[np.uint8] | None]:
    given = zip(_by_camera(regions, clips, "regions"), clips.clips, clips.calib, strict=True)
    return [None if r is None else _picture(r, clip, camera, f"region of {clip.name}").max(2) for r, clip, camera in given]


__all__ = ["VideoReconstruction", "reconstruct_video"]
